"""Runs one episode: a swarm under seeded faults for some minutes, then quiet, and what the judge found."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from fullswarm.rehearse.faults import Fault, plan
from fullswarm.rehearse.judge import Violation
from fullswarm.rehearse.swarm import RehearsedSwarm, fleet

EPISODE_S = 180.0
"""Simulated seconds of an episode, the quiet time included."""
QUIET_S = 20.0
"""At its end there are no faults for so long: the swarm must come to what was asked last."""
STILL_S = 14.0
"""And operators do nothing new for so long."""
OPERATORS = ("ann", "bob", "eve")
MEMORY = Path("/dev/shm")  # noqa: S108  (a temporary folder of its own is made in it)
"""Disks are kept in memory where the system has that: episodes wait for no real disk."""


@dataclass(slots=True)
class Result:
    """What one episode tried and found; the same for the same arguments."""

    episode: int
    seconds: float
    faults: Counter[str] = field(default_factory=Counter)
    asked: Counter[str] = field(default_factory=Counter)
    messages: Counter[str] = field(default_factory=Counter)
    restarts: int = 0
    commands: int = 0
    excused_contacts: int = 0
    violations: tuple[Violation, ...] = ()


def faults_of(seed: int, episode: int, robots: int, seconds: float, only: Sequence[str] = ()) -> tuple[Fault, ...]:
    """Return the faults of an episode."""
    config = fleet(robots)
    return plan(f"{seed}:{episode}", config.robots, OPERATORS, seconds - QUIET_S, only)


def run(
    seed: int, episode: int, robots: int = 8, seconds: float = EPISODE_S, only: Sequence[str] = (),
    keep: Sequence[int] | None = None,
) -> Result:  # fmt: skip
    """Run an episode.

    Parameters
    ----------
    only : kinds of faults; empty: all
    keep : indices of the only faults that happen; None: all
    """
    faults = faults_of(seed, episode, robots, seconds, only)
    if keep is not None:
        faults = tuple(each for each in faults if each.index in keep)
    memory = MEMORY if MEMORY.is_dir() else None
    with tempfile.TemporaryDirectory(prefix="fullswarm-rehearse-", dir=memory) as folder:
        swarm = RehearsedSwarm(fleet(robots), Path(folder), f"{seed}:{episode}", OPERATORS, seconds - STILL_S)
        try:
            swarm.inject(faults)
            swarm.run(seconds)
            swarm.finish()
        finally:
            with suppress(OSError):
                swarm.close()
    judge, counts = swarm.judge, swarm.network.counts
    return Result(
        episode=episode,
        seconds=seconds,
        faults=Counter(each.kind for each in faults),
        asked=Counter(each.kind for each in judge.asks.values()),
        messages=Counter(
            carried=counts.carried, lost=counts.lost, cut=counts.cut, doubled=counts.doubled, reordered=counts.reordered
        ),
        restarts=swarm.restarts,
        commands=judge.commands,
        excused_contacts=judge.excused,
        violations=tuple(judge.violations),
    )
