"""Tallies: how each metric's measurements of many hosts become one result. Pure bookkeeping, no clock, no bus.

Agents count from their own start. When one is restarted its counters begin again at zero; what it had counted
before is kept.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import MessageError
from fullswarm.messages import CollisionMeasurement, CoverageMeasurement, Message, WorkMeasurement
from fullswarm.perf.coverage import GridFrame, count_bits, unpack_bits
from fullswarm.perf.termination import Progress

Values = dict[str, float]
M = TypeVar("M", bound=Message)
M_contra = TypeVar("M_contra", bound=Message, contravariant=True)


class Result(NamedTuple):
    """What came of one metric."""

    values: Values  # of the swarm, by quantity
    per_robot: Values  # in the order of the names


Results = dict[str, Result]
"""By metric."""


class Tally(Protocol[M_contra]):
    """What a summarizer needs."""

    def add(self, message: M_contra) -> None:
        """Take in one measurement.

        Raises
        ------
        MessageError
            It makes no sense; nothing was taken in.
        """
        ...

    def progress(self, elapsed_s: float) -> Progress:
        """Return what the termination conditions look at; cheap, called for each measurement."""
        ...

    def results(self) -> Results:
        """Return the swarm's results."""
        ...


class One(Protocol[M_contra]):
    """The tally of a single metric."""

    def add(self, message: M_contra) -> None:
        """Take in one measurement.

        Raises
        ------
        MessageError
            It makes no sense; nothing was taken in.
        """
        ...

    def progress(self, elapsed_s: float) -> Progress:
        """Return what the termination conditions look at; cheap, called for each measurement."""
        ...

    def values(self) -> Values:
        """Return the swarm's result."""
        ...

    def per_robot(self) -> Values:
        """Return the result per robot, in the order of the names."""
        ...


class Alone(Generic[M]):
    """Makes the tally of a single metric one that a summarizer can use."""

    def __init__(self, metric: str, tally: One[M]) -> None:
        self._metric, self._tally = metric, tally
        self.add, self.progress = tally.add, tally.progress

    def results(self) -> Results:
        """Return the metric's result."""
        return {self._metric: Result(self._tally.values(), self._tally.per_robot())}


class Totals:
    """Cumulative counters of many hosts, kept across restarts of their agents."""

    def __init__(self) -> None:
        self._kept: Values = {}  # per robot, from agents that are gone
        self._last: dict[str, Values] = {}  # host → robot → newest counter
        self._columns: dict[str, tuple[Sequence[str], Sequence[float]]] = {}  # host → as received
        self._sum: Values | None = None

    def add(self, host: str, robots: Sequence[str], counters: Sequence[float]) -> None:
        """Take in the columns of one message.

        Raises
        ------
        MessageError
            Columns of different length, or a counter that is negative or not finite.
        """
        told, before = self._columns.get(host, ((), ()))
        if before == counters and told == robots:  # robots that stand, or touch nothing
            return
        fits = len(robots) == len(counters) and math.isfinite(sum(counters))
        if not fits or min(counters, default=0.0) < 0.0:
            raise MessageError("columns that are no measurement", where=host)
        last = self._last.setdefault(host, {})
        # The counters of one agent start again together, also those that have overtaken their old value.
        if told == robots:
            fallen = any(map(operator.lt, counters, before))
        else:
            fallen = any(count < last.get(robot, 0.0) for robot, count in zip(robots, counters, strict=True))
        if fallen:
            for robot, count in last.items():
                self._kept[robot] = self._kept.get(robot, 0.0) + count
            last.clear()
        last.update(zip(robots, counters, strict=True))
        self._columns[host], self._sum = (robots, counters), None

    def per_robot(self) -> Values:
        """Return the totals in the order of the robots' names."""
        if self._sum is None:
            totals = dict(self._kept)
            for last in self._last.values():
                for robot, count in last.items():
                    totals[robot] = totals.get(robot, 0.0) + count
            self._sum = dict(sorted(totals.items()))
        return self._sum


class WorkTally:
    """Distance travelled: `total_m`, `mean_m`, `max_m`, `robots`, and per robot in metres."""

    def __init__(self) -> None:
        self._totals = Totals()

    def add(self, message: WorkMeasurement) -> None:
        """Take in one host's distances."""
        self._totals.add(message.host, message.robots, message.distance_m)

    def progress(self, elapsed_s: float) -> Progress:
        """Return the time alone: no condition looks at distances."""
        return Progress(elapsed_s=elapsed_s)

    def values(self) -> Values:
        """Return the swarm's distances."""
        per_robot = self.per_robot()
        total, count = math.fsum(per_robot.values()), len(per_robot)
        return {
            "total_m": total,
            "mean_m": total / count if count else 0.0,
            "max_m": max(per_robot.values(), default=0.0),
            "robots": float(count),
        }

    def per_robot(self) -> Values:
        """Return metres per robot."""
        return self._totals.per_robot()


class CollisionTally:
    """Contact events: `events` (two robots that meet count one each), `robots_touched`, `max_events`, `robots`."""

    def __init__(self) -> None:
        self._totals = Totals()
        self._touched = False

    def add(self, message: CollisionMeasurement) -> None:
        """Take in one host's events."""
        self._totals.add(message.host, message.robots, message.events)
        self._touched = self._touched or any(message.events)

    def progress(self, elapsed_s: float) -> Progress:
        """Return the time, and 1 once any robot has touched anything."""
        return Progress(elapsed_s=elapsed_s, collisions=int(self._touched))

    def values(self) -> Values:
        """Return the swarm's events."""
        per_robot = self.per_robot()
        return {
            "events": math.fsum(per_robot.values()),
            "robots_touched": float(sum(count > 0 for count in per_robot.values())),
            "max_events": max(per_robot.values(), default=0.0),
            "robots": float(len(per_robot)),
        }

    def per_robot(self) -> Values:
        """Return events per robot."""
        return self._totals.per_robot()


class CoverageTally:
    """Arena covered by any robot so far: `fraction` of cells, `area_m2`, `cells`, `refused_hosts`.

    Cells once covered stay so when their agent restarts. The first measurement sets the grid; hosts that use
    another one cannot be joined and are counted in `refused_hosts`. Per robot: the area in m² that it covered
    since its agent started, for hosts that carry one robot (the robots of a host share a grid).
    """

    def __init__(self) -> None:
        self._frame: GridFrame | None = None
        self._union: NDArray[np.uint8] = np.zeros(0, np.uint8)  # packed, eight cells to a byte
        self._covered = 0
        self._newest: dict[str, bytes] = {}  # host → grid as received, to skip what is known
        self._area_m2: Values = {}
        self._refused_hosts: set[str] = set()

    def add(self, message: CoverageMeasurement) -> None:
        """Join one host's grid to the swarm's."""
        try:
            self._join(message)
        except MessageError:
            self._refused_hosts.add(message.host)
            raise
        self._refused_hosts.discard(message.host)

    def progress(self, elapsed_s: float) -> Progress:
        """Return the time and the fraction covered."""
        return Progress(elapsed_s=elapsed_s, coverage=self._fraction())

    def values(self) -> Values:
        """Return what the swarm has covered."""
        return {
            "fraction": self._fraction(),
            "area_m2": self._covered * (self._frame.cell_area_m2 if self._frame else 0.0),
            "cells": float(self._covered),
            "refused_hosts": float(len(self._refused_hosts)),
        }

    def per_robot(self) -> Values:
        """Return m² per robot that has a host of its own."""
        return dict(sorted(self._area_m2.items()))

    def _join(self, message: CoverageMeasurement) -> None:
        frame = GridFrame.of(message)
        if self._frame is not None and frame != self._frame:
            raise MessageError("another grid than the swarm's", where=message.host)
        if self._newest.get(message.host) == message.cells:
            return
        bits = unpack_bits(message.cells, frame)
        if self._frame is None:
            self._frame, self._union = frame, np.zeros_like(bits)
        self._newest[message.host] = message.cells
        self._union |= bits
        self._covered = count_bits(self._union)
        if len(message.robots) == 1:
            self._area_m2[message.robots[0]] = count_bits(bits) * frame.cell_area_m2

    def _fraction(self) -> float:
        return self._covered / self._frame.cells if self._frame else 0.0
