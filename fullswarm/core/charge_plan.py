"""Decides which robots must go to charge now, so that no dock is needed by more robots than it has room for; pure.

Backward scheduling by deadlines: beginning with the robot that can work longest, each gets the slot in which it can
begin latest, at its own deadline or before the robots that come after it there. A robot whose latest begin has come is
due. So robots that would all need a dock at the same hour are sent one after the other before it, and the fleet keeps
working meanwhile.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Candidate:
    """A robot that works and will have to charge."""

    robot: str
    lasts_s: float  # until it must go at the latest
    stays_s: float  # from then on until its slot is free again
    slots: tuple[str, ...]  # that it may use


def latest_begins(candidates: Iterable[Candidate], slots: Sequence[str]) -> dict[str, float]:
    """Return in how many seconds each robot must begin at the latest, the most urgent one first.

    Parameters
    ----------
    slots : that can be used; minus infinity for a robot that may use none of them
    """
    limit_s = dict.fromkeys(slots, math.inf)
    found: dict[str, float] = {}
    for each in sorted(candidates, key=lambda one: (-one.lasts_s, one.robot)):
        best_s, best = -math.inf, ""
        for slot in each.slots:
            if slot in limit_s:
                begin_s = min(each.lasts_s, limit_s[slot] - each.stays_s)
                if begin_s > best_s:
                    best_s, best = begin_s, slot
        found[each.robot] = best_s
        if best:
            limit_s[best] = best_s
    return dict(sorted(found.items(), key=lambda item: item[1]))


def nearest_free(slots: Iterable[str], free: Mapping[str, float]) -> str:
    """Return the slot of `slots` that is free and nearest; `free`: slot → distance in m; "": none is."""
    return min((slot for slot in slots if slot in free), key=lambda slot: (free[slot], slot), default="")
