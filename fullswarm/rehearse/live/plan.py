"""Which faults happen in a live rehearsal, and when: a plan from a seed, made before the swarm starts."""

from __future__ import annotations

import random
from dataclasses import dataclass

DISK_FULL = "core's disk full"
DECK = (
    "agent killed", "agent killed", "agent killed", "agent paused", "agent paused", "core killed", "core paused",
    "centralised killed", "hub killed", "hub paused", "robots cut off", "operator killed", "e-stop", "late request",
    DISK_FULL,
)  # fmt: skip
"""One round; shuffled again for each."""
FIRST_S = 3.0


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault. Seconds since the first one may happen; `lasts_s` of a pause, a cut, an e-stop, a request's delay."""

    number: int
    at_s: float
    kind: str
    robots: tuple[str, ...]
    lasts_s: float


def plan(robots: tuple[str, ...], seconds: float, every_s: float, seed: int) -> tuple[Fault, ...]:
    """Return the faults of one run; the same for the same arguments."""
    chance = random.Random(seed)  # noqa: S311  (repeats, keeps no secret)
    faults: list[Fault] = []
    deck: list[str] = []
    while FIRST_S + every_s * len(faults) < seconds:
        if not deck:
            deck = list(DECK)
            chance.shuffle(deck)
        kind = deck.pop()
        if kind.startswith("agent"):
            count = 1
        elif kind in ("robots cut off", "e-stop", "late request"):
            count = chance.randint(1, max(1, len(robots) // 4))
        else:
            count = 0
        lasts_s = chance.uniform(6.5, 9.0) if kind == "late request" else chance.uniform(0.7, 3.5)
        at_s = FIRST_S + every_s * len(faults)
        faults.append(Fault(len(faults), at_s, kind, tuple(chance.sample(robots, count)), lasts_s))
    return tuple(faults)


def conditions(faults: tuple[Fault, ...], loss: float) -> str:
    """Return the ``--network`` of a plan: its partitions, and some loss all the time."""
    cuts = [
        f"partition={'+'.join(each.robots)}|*@{each.at_s:.3f}s-{each.at_s + each.lasts_s:.3f}s"
        for each in faults
        if each.kind == "robots cut off"
    ]
    return ",".join([f"loss={100.0 * loss:g}%", *cuts])
