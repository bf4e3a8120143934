"""The tally of everything that is a number per robot: joins `RobotMeasurement`s by the table in ``metrics.py``.

Taking one in costs little more than keeping it: a core hears a thousand robots twice a second, and reports seldom.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import MessageError
from fullswarm.messages import LARGEST, RobotMeasurement
from fullswarm.perf import shape
from fullswarm.perf.coverage import Bounds
from fullswarm.perf.metrics import COLUMNS, METRICS, SHAPE, Metric, Restart, Rule
from fullswarm.perf.tallies import Result, Results, Values
from fullswarm.perf.termination import Progress

Array = NDArray[np.float64]

RULES: dict[Rule, Callable[[Array], float]] = {
    "sum": lambda values: math.fsum(values.tolist()),
    "mean": lambda values: math.fsum(values.tolist()) / len(values),
    "max": lambda values: float(values.max()),
    "min": lambda values: float(values.min()),
    "rms": lambda values: math.sqrt(math.fsum((values * values).tolist()) / len(values)),
    "share": lambda values: float(len(values)),
}
"""How the values that are there, at least one, become one number; a share is yet to be divided by all robots."""

EMPTY: dict[Rule, float] = {"sum": 0.0, "share": 0.0}
"""What is said of no values at all; nothing by the other rules."""

JOIN: dict[Restart, Callable[[float, float], float]] = {
    "add": lambda before, now: before + now,
    "least": min,
    "most": max,
    "newest": lambda _, now: now,
}


class RobotTally:
    """Numbers per robot, of all hosts.

    Parameters
    ----------
    robots
        Robots expected: all of them must arrive; those that are heard when empty.
    bounds_m
        The arena, for Lloyd's cost.
    """

    def __init__(self, robots: Sequence[str], bounds_m: Bounds) -> None:
        self._expected, self._bounds_m = frozenset(robots), bounds_m
        self._newest: dict[str, RobotMeasurement] = {}  # host → message
        self._kept: dict[str, Values] = {}  # column → robot or host → from processes that are gone
        self._arrived: dict[str, set[str]] = {}  # host → robots that have arrived, of hosts that report it
        self._still_s: dict[str, float] = {}  # host → since its last robot moved, of those with a task

    def add(self, message: RobotMeasurement) -> None:
        """Keep one host's numbers.

        Raises
        ------
        MessageError
            Columns of different length.
        """
        robots, columns = message.robots, message.columns
        if any(len(column) != len(robots) for column in columns.values()):
            raise MessageError("columns that are no measurement", where=message.host)
        before = self._newest.get(message.host)
        if before is not None and before.process != message.process:
            self._keep(before)
        self._newest[message.host] = message
        if "arrived_s" in columns:  # a number that is not NaN equals itself
            pairs = zip(robots, columns["arrived_s"], strict=True)
            self._arrived[message.host] = {robot for robot, arrived_s in pairs if arrived_s == arrived_s}
        still_s = [each for each in columns.get("still_s", ()) if each == each]
        self._still_s[message.host] = min(still_s, default=math.inf)

    def progress(self, elapsed_s: float) -> Progress:
        """Return the time, whether all have arrived, and for how long no robot has moved."""
        still_s = min(self._still_s.values(), default=math.inf)
        return Progress(
            elapsed_s=elapsed_s,
            all_arrived=self._all_in() if self._arrived else None,
            still_s=still_s if math.isfinite(still_s) else None,
        )

    def results(self) -> Results:
        """Return all metrics; a quantity without any number is left out."""
        robots = [robot for message in self._newest.values() for robot in message.robots]
        told = {name for message in self._newest.values() for name in (*message.columns, *message.totals)}
        columns = {name: self._column(name) for name in COLUMNS if name in told}
        count = max(len(robots), len(self._expected))
        order = [(robots[row], row) for row in sorted(range(len(robots)), key=robots.__getitem__)]
        results = {name: self._result(metric, order, columns, count) for name, metric in METRICS.items()}
        results[SHAPE] = Result(self._shape(columns), {})
        return results

    def _all_in(self) -> bool:
        count = sum(map(len, self._arrived.values()))
        if not count or count < len(self._expected):  # names are compared only when it may be true
            return False
        heard = (robot for message in self._newest.values() for robot in message.robots)
        return set().union(*self._arrived.values()).issuperset(self._expected or heard)

    def _keep(self, gone: RobotMeasurement) -> None:
        for name, values in self._named(gone).items():
            restart = COLUMNS[name].restart
            if restart == "newest":
                continue
            kept = self._kept.setdefault(name, {})
            for who, value in values.items():
                kept[who] = JOIN[restart](kept[who], value) if who in kept else value

    def _named(self, message: RobotMeasurement) -> dict[str, Values]:
        """Return what of a message is known here, by column, then robot or host."""
        named = {
            name: dict(zip(message.robots, column, strict=True))
            for name, column in message.columns.items()
            if name in COLUMNS
        }
        return named | {name: {message.host: value} for name, value in message.totals.items() if name in COLUMNS}

    def _column(self, name: str) -> Array:
        """Return a value per robot in the order of the messages, or per host; NaN where there is none."""
        parts: list[float] = []
        kept, join = self._kept.get(name), JOIN[COLUMNS[name].restart]
        for host, message in self._newest.items():
            who: tuple[str, ...]
            values: tuple[float, ...]
            if COLUMNS[name].per_host:
                who, values = (host,), (message.totals.get(name, math.nan),)
            else:
                who = message.robots
                values = message.columns.get(name) or (math.nan,) * len(who)
            if kept:
                values = tuple(
                    join(kept[each], value) if each in kept else value for each, value in zip(who, values, strict=True)
                )
            parts.extend(values)
        return np.array(parts)

    def _result(self, metric: Metric, order: list[tuple[str, int]], columns: dict[str, Array], count: int) -> Result:
        values: Values = {}
        for quantity, (rule, name) in metric.quantities.items():
            column = columns.get(name)
            if column is None:
                continue
            there = column[_known(column)]
            if len(there):
                values[quantity] = RULES[rule](there) / (count if rule == "share" else 1)
            elif rule in EMPTY:
                values[quantity] = EMPTY[rule]
        per_robot: Values = {}
        if metric.per_robot in columns:
            column = columns[metric.per_robot]
            numbers, there = column.tolist(), _known(column).tolist()
            per_robot = {robot: numbers[row] for robot, row in order if there[row]}
        return Result(values, per_robot)

    def _shape(self, columns: dict[str, Array]) -> Values:
        wanted = ("x_m", "y_m", "heading_rad")
        if not columns.keys() >= set(wanted):
            return {}
        table = np.stack([columns[name] for name in wanted])
        x_m, y_m, heading_rad = table[:, _known(table).all(axis=0)]
        return shape.values(x_m, y_m, heading_rad, self._bounds_m)


def _known(values: Array) -> NDArray[np.bool_]:
    """Return which values are there: neither NaN nor so large that a sum of them would not be finite."""
    known: NDArray[np.bool_] = np.abs(values) <= LARGEST
    return known
