"""Draws the faults of an episode from its seed: what goes wrong, when, for how long, and for whom."""

from __future__ import annotations

import random
from collections.abc import Sequence
from dataclasses import dataclass

from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.rehearse.driver import LIES

CORE, CENTRALISED, HUB = "core", "centralised", "hub"


@dataclass(frozen=True, slots=True)
class Fault:
    """One fault of an episode.

    Attributes
    ----------
    index : its place in the episode's plan, by which it can be left out
    at_s, lasts_s : simulated seconds; of a crash until the process is started again
    targets : names of processes or robots
    value : a share, a delay in s, a rate or a jump in s, by kind
    """

    index: int
    kind: str
    at_s: float
    lasts_s: float
    targets: tuple[str, ...]
    value: float = 0.0
    detail: str = ""


@dataclass(frozen=True, slots=True)
class Kind:
    """One kind of fault: seconds between two of it on average, how long it lasts, and its value."""

    every_s: float
    lasts_s: tuple[float, float]
    value: tuple[float, float] = (0.0, 0.0)


KINDS: dict[str, Kind] = {
    "agent-crash": Kind(20.0, (0.3, 2.5)),
    "core-crash": Kind(40.0, (0.2, 2.5)),
    "centralised-crash": Kind(25.0, (0.2, 2.5)),
    "operator-crash": Kind(90.0, (0.5, 3.0)),
    "hub-crash": Kind(60.0, (0.2, 2.5)),
    "hub-freeze": Kind(80.0, (0.2, 2.0)),
    "power-cut": Kind(45.0, (0.5, 3.0)),
    "disk-full": Kind(45.0, (2.0, 15.0)),
    "disk-slow": Kind(60.0, (2.0, 8.0), (0.01, 0.3)),
    "partition": Kind(30.0, (0.5, 5.0)),
    "one-way": Kind(35.0, (0.5, 5.0)),
    "loss": Kind(40.0, (1.0, 8.0), (0.05, 0.4)),
    "delay": Kind(40.0, (1.0, 8.0), (0.02, 0.3)),
    "reorder": Kind(40.0, (1.0, 8.0), (0.1, 0.5)),
    "duplicate": Kind(40.0, (1.0, 8.0), (0.1, 0.5)),
    "clock-skew": Kind(60.0, (5.0, 30.0), (-0.005, 0.005)),
    "clock-jump": Kind(60.0, (0.0, 0.0), (0.05, 30.0)),
    "suspend": Kind(25.0, (0.1, 3.0)),
    "slow-process": Kind(50.0, (1.0, 6.0), (0.005, 0.08)),
    "driver-lies": Kind(25.0, (0.3, 3.0)),
}
"""Every kind of fault, by its name in ``--only``."""

FIRST_S = 4.0
"""The swarm has this long to start."""


def check_kinds(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names of ``--only``, all when there are none.

    Raises
    ------
    ConfigError
        There is no such kind.
    """
    for name in names:
        if name not in KINDS:
            raise ConfigError(f"'{name}' is not a kind of fault", where="--only", hint=did_you_mean(name, KINDS))
    return tuple(names) or tuple(KINDS)


def plan(
    seed: str, robots: Sequence[str], operators: Sequence[str], seconds: float, only: Sequence[str] = ()
) -> tuple[Fault, ...]:
    """Return the faults of the first `seconds` of an episode, in the order of their times.

    Each kind has a random stream of its own, so that leaving one kind out changes no other; all end in time.
    """
    found: list[Fault] = []
    for name in check_kinds(only):
        kind, chance = KINDS[name], random.Random(f"{seed}:{name}")  # noqa: S311  (must repeat, keeps no secret)
        at_s = FIRST_S + chance.expovariate(1.0 / kind.every_s)
        while at_s < seconds:
            lasts_s, value = chance.uniform(*kind.lasts_s), chance.uniform(*kind.value)
            targets, detail = _targets(name, chance, robots, operators)
            found.append(Fault(0, name, at_s, min(lasts_s, seconds - at_s), targets, value, detail))
            at_s += chance.expovariate(1.0 / kind.every_s)
    found.sort(key=lambda each: (each.at_s, each.kind))
    numbered = enumerate(found)
    return tuple(
        Fault(index, each.kind, each.at_s, each.lasts_s, each.targets, each.value, each.detail)
        for index, each in numbered
    )


def _targets(
    name: str, chance: random.Random, robots: Sequence[str], operators: Sequence[str]
) -> tuple[tuple[str, ...], str]:
    """Draw whom a fault of this kind concerns, and what else it needs."""
    base = (CORE, CENTRALISED, *operators)
    if name in ("core-crash", "centralised-crash", "hub-crash", "hub-freeze"):
        return (name.partition("-")[0],), ""
    if name == "operator-crash":
        return (chance.choice(operators),), ""
    if name == "agent-crash":
        return (chance.choice(robots),), ""
    if name == "driver-lies":
        return (chance.choice(robots),), chance.choice(LIES)
    if name in ("power-cut", "disk-full", "disk-slow", "clock-skew", "clock-jump"):
        return (chance.choice((*robots, *robots, "base")),), ""
    if name in ("suspend", "slow-process"):
        return (chance.choice((*robots, *robots, *base)),), ""
    if name in ("partition", "one-way"):
        count = chance.randint(1, max(1, len(robots) // 2))
        names = (*robots, *robots, *base) if name == "one-way" else (*robots, CORE)
        return tuple(dict.fromkeys(chance.choice(names) for _ in range(count))), chance.choice(("in", "out"))
    count = chance.randint(1, len(robots))
    return tuple(chance.sample([*robots, *base], count)), ""
