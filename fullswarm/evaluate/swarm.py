"""The port through which a trial uses a swarm, whatever carries it: lockstep, live processes, real robots.

``lockstep_swarm.py`` and ``live_swarm.py`` implement it; a fleet of real robots is a live swarm without a world.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fullswarm.config import SwarmConfig
from fullswarm.errors import FullswarmError
from fullswarm.messages import Value
from fullswarm.perf.coverage import GridFrame

LOOK_S = 0.1
"""How often it is checked whether the trial is over."""
SAMPLE_S = 0.2
"""Between two rows of the trajectory."""

Numbers = Mapping[str, float]
Coverage = tuple[GridFrame, NDArray[np.uint8]]
"""A grid, and its cells (rows, columns) of 0 and 1."""


class TrialFailed(FullswarmError):
    """A trial that measured nothing."""


class TrialHeld(TrialFailed):
    """A robot is held by an e-stop: nothing may go on by itself."""


class TrialStopped(FullswarmError):
    """The trial was ended from outside before it was over."""


@dataclass(frozen=True, slots=True)
class Report:
    """What a swarm reports of itself after a trial.

    Attributes
    ----------
    onboard : the summaries' numbers, by names like ``work.total_m``
    per_robot : the same by robot
    deadlocks, deadlock_s : how often robots stepped aside, and for how long in all
    """

    onboard: Numbers
    per_robot: Mapping[str, Numbers]
    coverage: Coverage | None
    deadlocks: int
    deadlock_s: float


class Swarm(Protocol):
    """A swarm of robots that are started and stand in their places.

    Every method may raise `TrialFailed`: a robot or process failed or does not do what was requested.
    """

    @property
    def config(self) -> SwarmConfig:
        """The settings that the swarm runs with."""
        ...

    @property
    def passed_s(self) -> float:
        """Time since the request, rounded to what the swarm's clock can tell."""
        ...

    @property
    def seen_s(self) -> float:
        """Time since the request of the bodies' newest state."""
        ...

    def settle(self) -> None:
        """Return when every robot is ready for a request."""
        ...

    def request(self, behaviour: str, parameters: Mapping[str, Value]) -> None:
        """Request a behaviour of all robots; time counts from here."""
        ...

    def watch(self, look: Callable[[], None]) -> None:
        """Call `look` from now on whenever the bodies may have moved: after each step of a simulated world."""
        ...

    def advance(self, stopped: Callable[[], bool]) -> bool:
        """Let `LOOK_S` pass, less at the end of the trial; return whether `stopped` holds."""
        ...

    def end_reason(self) -> str:
        """Return the termination condition that a summarizer has met since the request; empty: none."""
        ...

    def stop(self) -> None:
        """Return when the robots are at standstill, or do not come to it in time."""
        ...

    def report(self) -> Report:
        """Return what the swarm measured of itself until now."""
        ...

    def close(self) -> None:
        """End the swarm."""
        ...
