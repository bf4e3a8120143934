"""Defines the port through which a trial uses a swarm, and collects what a swarm reports of itself.

``lockstep_swarm.py``, ``live_swarm.py`` and ``fleet_swarm.py`` implement the port: each holds the swarm and the
function that runs one trial on it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fullswarm.bus.base import Bus
from fullswarm.config import SwarmConfig
from fullswarm.errors import FullswarmError
from fullswarm.fitness import ANYTHING
from fullswarm.keys import Keys
from fullswarm.messages import BehaviourMemory, CoverageMeasurement, Needs, RequestStatus, Summary, Value
from fullswarm.perf.coverage import GridFrame, unpack_bits
from fullswarm.perf.metrics import METRICS

CHECK_PERIOD_S = 0.1
"""How often it is checked whether the trial is over."""
SAMPLE_S = 0.2
"""Between two rows of the trajectory."""

ALL_ENDED = "behaviour ended"
"""Why a trial is over when the behaviour has ended itself on all robots that ran it."""

Numbers = Mapping[str, float]
Coverage = tuple[GridFrame, NDArray[np.uint8]]
"""A grid, and its cells (rows, columns) of 0 and 1."""


MOST_REMEMBERED = 1_000_000
"""Numbers in a recording of memories at most; what comes later is left out."""


@dataclass(frozen=True, slots=True)
class Memories:
    """What control laws remembered during a trial: one row per number and report.

    Attributes
    ----------
    time_s : (k,) by the clock of the robot's host, since its first report
    robot, behaviour, name : (k,) whose it is; a field with several numbers is ``name.0``, ``name.1``, ...
    value : (k,) flags are 0 and 1
    """

    time_s: NDArray[np.float64]
    robot: NDArray[np.str_]
    behaviour: NDArray[np.str_]
    name: NDArray[np.str_]
    value: NDArray[np.float64]


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
    memories : what control laws remembered, each second; None: nothing
    deadlocks, deadlock_s : how often robots stepped aside, and for how long in all
    """

    onboard: Numbers
    per_robot: Mapping[str, Numbers]
    coverage: Coverage | None
    memories: Memories | None
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
        """Time since the request, rounded to the resolution of the swarm's clock."""
        ...

    @property
    def seen_s(self) -> float:
        """Time since the request of the bodies' newest state."""
        ...

    def settle(self) -> None:
        """Return when every robot is ready for a request."""
        ...

    def request(
        self, behaviour: str, parameters: Mapping[str, Value], *, team: str = "", needs: Needs = ANYTHING,
        roles: Mapping[str, Sequence[str]] | None = None,
    ) -> None:  # fmt: skip
        """Request a behaviour of all robots; time counts from here."""
        ...

    def watch(self, on_step: Callable[[], None]) -> None:
        """Call `on_step` from now on whenever the bodies may have moved: after each step of a simulated world."""
        ...

    def advance(self, stopped: Callable[[], bool]) -> bool:
        """Let `CHECK_PERIOD_S` pass, less at the end of the trial; return whether `stopped` holds."""
        ...

    def end_reason(self) -> str:
        """Return the termination condition that has been met since the request, `ALL_ENDED` or a summarizer's."""
        ...

    def settled(self) -> NDArray[np.bool_]:
        """Return which robots report that they are as near to their goals as they can get, (n,)."""
        ...

    def left_out(self) -> NDArray[np.bool_]:
        """Return which robots do not take part because they are unfit for the request, (n,)."""
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


def left_out_of(robots: Sequence[str], statuses: Sequence[RequestStatus]) -> NDArray[np.bool_]:
    """Return which of `robots` the newest status of a request leaves out, (n,)."""
    names = statuses[-1].left_out if statuses else ()
    return np.array([robot in names for robot in robots], bool)


ROBOT_QUANTITY = {
    "coverage": "area_m2",
    **{name: metric.per_robot for name, metric in METRICS.items() if metric.per_robot},
}
"""What a summary's numbers per robot are, by its metric."""


class Summaries:
    """Subscribes to summaries and to the robots' own coverage grids.

    Parameters
    ----------
    on_finished : called when the first termination condition is met

    Attributes
    ----------
    reason : the first condition that was met since `begin`; empty: none
    """

    def __init__(self, bus: Bus, keys: Keys, on_finished: Callable[[], None] | None = None) -> None:
        self.reason = ""
        self._on_finished = on_finished
        self._newest: dict[str, Summary] = {}
        self._grids: dict[str, CoverageMeasurement] = {}
        self._before: frozenset[str] = frozenset()
        self._memories: list[tuple[float, str, str, str, float]] = []
        self._began_s: dict[str, float] = {}  # by host, on its clock
        self._subscriptions = [
            bus.subscribe(keys.summary(), Summary, self._on_summary),
            bus.subscribe(keys.measurement("coverage"), CoverageMeasurement, self._on_grid),
            bus.subscribe(keys.memory(), BehaviourMemory, self._on_memory),
        ]

    def begin(self) -> None:
        """Ignore the conditions that are met already, and what was remembered before."""
        self._memories.clear()
        self._began_s.clear()
        self._before, self.reason = frozenset(metric for metric, each in self._newest.items() if each.finished), ""

    def close(self) -> None:
        """Subscribe to nothing more."""
        for subscription in self._subscriptions:
            subscription.close()

    def later_than(self, time_s: float) -> bool:
        """Return whether all that can still change is of a later time, by this machine's clock."""
        return all(each.finished or each.stamp_s >= time_s for each in self._newest.values())

    def onboard(self) -> dict[str, float]:
        """Return all numbers, by names like ``work.total_m``."""
        return finite(
            {
                f"{metric}.{name}": value
                for metric, each in sorted(self._newest.items())
                for name, value in each.values.items()
            }
        )

    def per_robot(self) -> dict[str, dict[str, float]]:
        """Return the same by robot: ``work.distance_m`` → robot → value."""
        return {
            f"{metric}.{ROBOT_QUANTITY[metric]}" if metric in ROBOT_QUANTITY else metric: finite(each.per_robot)
            for metric, each in sorted(self._newest.items())
            if each.per_robot
        }

    def coverage(self) -> Coverage | None:
        """Return the grid that the robots have covered together; None when none has reported."""
        if not self._grids:
            return None
        messages = list(self._grids.values())
        frame = GridFrame.of(messages[0])
        bits = np.bitwise_or.reduce(
            [unpack_bits(each.cells, frame) for each in messages if GridFrame.of(each) == frame]
        )
        return frame, np.unpackbits(bits, count=frame.cells).reshape(frame.rows, frame.columns)

    def _on_summary(self, summary: Summary) -> None:
        self._newest[summary.metric] = summary
        if summary.finished and not self.reason and summary.metric not in self._before:
            self.reason = summary.reason
            if self._on_finished is not None:
                self._on_finished()

    def memories(self) -> Memories | None:
        """Return what control laws have remembered since `begin`; None: nothing."""
        if not self._memories:
            return None
        time_s, robot, behaviour, name, value = zip(*self._memories, strict=True)
        return Memories(
            np.array(time_s), np.array(robot, np.str_), np.array(behaviour, np.str_), np.array(name, np.str_),
            np.array(value),
        )  # fmt: skip

    def _on_memory(self, message: BehaviourMemory) -> None:
        began_s = self._began_s.setdefault(message.host, message.stamp_s)
        time_s = round(message.stamp_s - began_s, 3)
        for each in message.robots if len(self._memories) < MOST_REMEMBERED else ():
            for field, values in each.fields.items():
                for place, value in enumerate(values):
                    name = field if len(values) == 1 else f"{field}.{place}"
                    number = math.nan if value is None else value
                    self._memories.append((time_s, each.robot, each.behaviour, name, number))

    def _on_grid(self, grid: CoverageMeasurement) -> None:
        self._grids[grid.host] = grid


def finite(values: Numbers) -> dict[str, float]:
    """Return the values without those that JSON cannot hold."""
    return {name: value for name, value in values.items() if math.isfinite(value)}


def joined(onboard: Mapping[str, Numbers], truth: Mapping[str, Numbers]) -> dict[str, dict[str, float]]:
    """Return both tables in one, by ``onboard <name>`` and ``truth <name>``."""
    tables = (("onboard", onboard), ("truth", truth))
    return {f"{source} {name}": finite(values) for source, table in tables for name, values in table.items()}
