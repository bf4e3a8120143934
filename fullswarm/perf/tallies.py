"""Join the measurements of many hosts to results: coverage, and by the table in ``metrics.py`` every number per robot.

Pure bookkeeping: no clock, no bus. Taking a measurement in costs little more than keeping it: a core receives those of
a thousand robots twice a second, and reports seldom.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import MessageError
from fullswarm.kernels import Array
from fullswarm.messages import LARGEST, CoverageMeasurement, Message, RobotMeasurement
from fullswarm.perf import shape
from fullswarm.perf.coverage import Bounds, GridFrame, count_bits, unpack_bits
from fullswarm.perf.metrics import COLUMNS, METRICS, SHAPE, Metric, Restart, Rule
from fullswarm.perf.termination import Progress
from fullswarm.recent import Recent

HOSTS, STRANGERS = 10_000, 1000
"""Hosts at most, and robots that are not of the fleet file: other processes choose their names."""

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
        self._newest: Recent[str, bytes] = Recent(HOSTS)  # host → grid as received, to skip what is known
        self._area_m2: Recent[str, float] = Recent(HOSTS)  # by robot
        self._refused_hosts: Recent[str, None] = Recent(HOSTS)

    def add(self, message: CoverageMeasurement) -> None:
        """Join one host's grid to the swarm's."""
        try:
            self._join(message)
        except MessageError:
            self._refused_hosts[message.host] = None
            raise
        self._refused_hosts.pop(message.host, None)

    def progress(self, elapsed_s: float) -> Progress:
        """Return the time and the fraction covered."""
        return Progress(elapsed_s=elapsed_s, coverage=self._fraction())

    def results(self) -> Results:
        """Return what the swarm has covered, and m² per robot that has a host of its own."""
        values = {
            "fraction": self._fraction(),
            "area_m2": self._covered * (self._frame.cell_area_m2 if self._frame else 0.0),
            "cells": float(self._covered),
            "refused_hosts": float(len(self._refused_hosts)),
        }
        return {"coverage": Result(values, dict(sorted(self._area_m2.items())))}

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


RULES: dict[Rule, Callable[[Sequence[float]], float]] = {
    "sum": math.fsum,
    "mean": lambda values: math.fsum(values) / len(values),
    "max": max,
    "min": min,
    "rms": lambda values: math.sqrt(math.fsum([value * value for value in values]) / len(values)),
    "share": lambda values: float(len(values)),
    "count": lambda values: float(len(values)),
    "positive": lambda values: float(sum([value > 0.0 for value in values])),
}
"""How the values that are there, at least one, become one number; a share is yet to be divided by all robots."""

EMPTY: dict[Rule, float] = {"sum": 0.0, "share": 0.0, "count": 0.0, "positive": 0.0}
"""The result for no values at all; none by the other rules."""

JOIN: dict[Restart, Callable[[Array, Array], Array]] = {
    "add": lambda before, now: before + np.where(np.isnan(now), 0.0, now),
    "least": np.fmin,
    "most": np.fmax,
    "newest": lambda _, now: now,
}
COUNTERS = tuple(name for name, column in COLUMNS.items() if column.restart == "add" and not column.per_host)
PLACE = "x_m", "y_m", "heading_rad"


class RobotTally:
    """Numbers per robot, of all hosts.

    Parameters
    ----------
    robots
        Robots expected: all of them must arrive; those that report when empty.
    bounds_m
        The arena, for Lloyd's cost.
    metrics
        Those to report, by name. Only a tally with ``collisions`` knows whether any robot has touched anything, only
        one with ``arrival`` whether all have arrived or none moves.
    """

    def __init__(self, robots: Sequence[str], bounds_m: Bounds, metrics: Mapping[str, Metric] = METRICS) -> None:
        self._expected, self._bounds_m, self._metrics = frozenset(robots), bounds_m, metrics
        self._wanted = {name for metric in metrics.values() for _, name in metric.quantities.values()}
        self._wanted |= {metric.per_robot for metric in metrics.values()}
        if SHAPE in metrics:
            self._wanted |= set(PLACE)
        self._touched: bool | None = None  # None: no host reports contacts
        self._newest: dict[str, RobotMeasurement] = {}  # host → message
        self._kept: dict[str, Values] = {}  # column → robot or host → from processes that are gone
        self._arrived: dict[str, set[str]] = {}  # host → robots that have arrived, of hosts that report it
        self._still_s: dict[str, float] = {}  # host → since its last robot moved, of those with a task

    def add(self, message: RobotMeasurement) -> None:
        """Keep one host's numbers.

        Raises
        ------
        MessageError
            Columns of different length, or a counter that is negative or infinite.
        """
        robots, columns = message.robots, message.columns
        self._refuse_strangers(message)
        if any(len(column) != len(robots) for column in columns.values()):
            raise MessageError("columns that are no measurement", where=message.host)
        for name in COUNTERS:
            if (column := columns.get(name)) and (min(column) < 0.0 or max(column) == math.inf):
                raise MessageError(f"column {name} is no counter", where=message.host)
        before = self._newest.get(message.host)
        if before is not None and before.process != message.process:
            self._keep(before)
        self._newest[message.host] = message
        if "collisions" in self._metrics and "events" in columns:
            self._touched = bool(self._touched) or any(count > 0.0 for count in columns["events"])
        if "arrival" in self._metrics:
            self._add_tasks(message)

    def _refuse_strangers(self, message: RobotMeasurement) -> None:
        """Raise for a host or robots for which there is no room: invented names must not fill the memory."""
        before = self._newest.get(message.host)
        if before is not None and before.robots == message.robots:
            return
        if before is None and len(self._newest) >= HOSTS:
            raise MessageError(f"more than {HOSTS} hosts", where=message.host)
        others = (each.robots for host, each in self._newest.items() if host != message.host)
        names = set(message.robots).union(*others)
        if len(names) > STRANGERS and len(names - self._expected) > STRANGERS:
            raise MessageError(f"more than {STRANGERS} robots that are not of the fleet file", where=message.host)

    def _add_tasks(self, message: RobotMeasurement) -> None:
        robots, columns = message.robots, message.columns
        if "arrived_s" in columns:  # a number that is not NaN equals itself
            pairs = zip(robots, columns["arrived_s"], strict=True)
            self._arrived[message.host] = {robot for robot, arrived_s in pairs if arrived_s == arrived_s}
        still_s = [each for each in columns.get("still_s", ()) if each == each]
        self._still_s[message.host] = min(still_s, default=math.inf)

    def progress(self, elapsed_s: float) -> Progress:
        """Return the time, whether any has touched, whether all have arrived, and for how long no robot has moved."""
        still_s = min(self._still_s.values(), default=math.inf)
        return Progress(
            elapsed_s=elapsed_s,
            collisions=None if self._touched is None else int(self._touched),
            all_arrived=self._all_in() if self._arrived else None,
            still_s=still_s if math.isfinite(still_s) else None,
        )

    def results(self) -> Results:
        """Return all metrics; a quantity without any number is left out."""
        messages = list(self._newest.values())
        rows: dict[str, int] = {}
        for message in messages:
            for robot in message.robots:
                rows.setdefault(robot, len(rows))
        count = max(len(rows), len(self._expected))
        # At once, unless a robot has moved from one host to another: then one after the other.
        once = len(rows) == sum(len(message.robots) for message in messages)
        batches = [messages] if once else [[message] for message in messages]
        for name, kept in self._kept.items():
            for robot in () if COLUMNS[name].per_host else kept:  # also of robots that their agent no longer carries
                rows.setdefault(robot, len(rows))
        reported = {name for message in messages for name in (*message.columns, *message.totals)} | self._kept.keys()
        columns = {name: self._column(name, rows, batches) for name in self._wanted & reported & COLUMNS.keys()}
        known = {name: [value for value in column if _is_known(value)] for name, column in columns.items()}
        order = sorted(rows.items())
        results = {name: self._result(metric, order, columns, known, count) for name, metric in self._metrics.items()}
        if SHAPE in results:
            results[SHAPE] = Result(self._shape(columns), {})
        return results

    def _all_in(self) -> bool:
        count = sum(map(len, self._arrived.values()))
        if not count or count < len(self._expected):  # names are compared only when it may be true
            return False
        reporting = (robot for message in self._newest.values() for robot in message.robots)
        return set().union(*self._arrived.values()).issuperset(self._expected or reporting)

    def _keep(self, gone: RobotMeasurement) -> None:
        """Keep what a process that is gone has counted."""
        for name in COLUMNS.keys() & {*gone.columns, *gone.totals}:
            column = COLUMNS[name]
            if column.restart == "newest":
                continue
            names, counted = _values_of(gone, name)
            kept = self._kept.setdefault(name, {})
            before = np.array([kept.get(each, math.nan) for each in names])
            joined = _joined(column.restart, before, np.array(counted)).tolist()
            for each, value in zip(names, joined, strict=True):
                if each in kept or each in self._expected or len(kept) < STRANGERS:
                    kept[each] = value

    def _column(self, name: str, rows: dict[str, int], batches: list[list[RobotMeasurement]]) -> list[float]:
        """Return a value per robot, in `rows`, or per host; NaN where there is none.

        Lists, not arrays: for the few robots of most swarms they take a quarter of the time.
        """
        if len(batches) == 1 and name not in self._kept:  # the rows are in the order of the messages
            reported = [float(value) for message in batches[0] for value in _values_of(message, name)[1]]
            # After them come robots that are kept in other columns.
            return reported if COLUMNS[name].per_host else reported + [math.nan] * (len(rows) - len(reported))
        if COLUMNS[name].per_host:
            rows = {host: row for row, host in enumerate(self._newest)}
        column = np.full(len(rows), math.nan)
        for each, value in self._kept.get(name, {}).items():
            column[rows[each]] = value
        for batch in batches:
            at: list[int] = []
            now: list[float] = []
            for message in batch:
                names, values = _values_of(message, name)
                at += [rows[each] for each in names]
                now += values
            column[at] = _joined(COLUMNS[name].restart, column[at], np.array(now))
        joined: list[float] = column.tolist()
        return joined

    def _result(
        self, metric: Metric, order: list[tuple[str, int]], columns: dict[str, list[float]],
        known: dict[str, list[float]], count: int,
    ) -> Result:  # fmt: skip
        values: Values = {}
        for quantity, (rule, name) in metric.quantities.items():
            there = known.get(name)
            if there is None:
                continue
            if there:
                values[quantity] = RULES[rule](there) / (count if rule == "share" else 1)
            elif rule in EMPTY:
                values[quantity] = EMPTY[rule]
        per_robot: Values = {}
        if metric.per_robot in columns:
            column = columns[metric.per_robot]
            per_robot = {robot: column[row] for robot, row in order if _is_known(column[row])}
        return Result(values, per_robot)

    def _shape(self, columns: dict[str, list[float]]) -> Values:
        if not columns.keys() >= set(PLACE):
            return {}
        table = np.array([columns[name] for name in PLACE])
        x_m, y_m, heading_rad = table[:, (np.abs(table) <= LARGEST).all(axis=0)]
        return shape.values(x_m, y_m, heading_rad, self._bounds_m)


def _is_known(value: float) -> bool:
    """Tell whether a value is there: neither NaN nor so large that a sum of them would not be finite."""
    return -LARGEST <= value <= LARGEST


def _values_of(message: RobotMeasurement, name: str) -> tuple[Sequence[str], Sequence[float]]:
    """Return the robots or host of a column of a message, and the values: NaN when the message does not have it."""
    if COLUMNS[name].per_host:
        return (message.host,), (message.totals.get(name, math.nan),)
    return message.robots, message.columns.get(name) or (math.nan,) * len(message.robots)


def _joined(restart: Restart, before: Array, now: Array) -> Array:
    """Join values by the column's rule, where there are any before."""
    joined: Array = np.where(np.isnan(before), now, JOIN[restart](before, now))
    return joined
