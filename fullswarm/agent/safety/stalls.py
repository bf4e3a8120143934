"""How long the control loop may hang: a robot drives on meanwhile, which the safety filter must leave room for.

On a computer that is overloaded, swaps or is too slow, ticks come late. The certificate holds for the control period;
during a longer one the last command stays in force, until the driver's own time limit ends it.
"""

from __future__ import annotations

import math

LONGEST_S = 0.5
"""The drivers have ended a set-point that is not renewed by then."""
FADES_S = 10.0
"""Time constant with which a stall is forgotten."""
NONE_S = 0.02
"""A shorter one does not count: the last part of an approach is slower than the filter's proof needs."""


class Stalls:
    """The longest delay of a tick lately, in s; zero while ticks come in time."""

    def __init__(self, period_s: float) -> None:
        self._period_s, self._longest_s = period_s, 0.0

    def note(self, gap_s: float) -> float:
        """Take the time since the last tick; return by how much a tick may come late."""
        faded_s = self._longest_s * math.exp(-gap_s / FADES_S)
        self._longest_s = min(max(faded_s, gap_s - self._period_s, 0.0), LONGEST_S)
        return self._longest_s if self._longest_s > NONE_S else 0.0
