"""Collects what a swarm reports of itself: the newest summary of each metric, and the coverage grids."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np

from fullswarm.bus.base import Bus
from fullswarm.evaluate.swarm import Coverage, Numbers
from fullswarm.keys import Keys
from fullswarm.messages import CoverageMeasurement, Summary
from fullswarm.perf.coverage import GridFrame, unpack_bits
from fullswarm.perf.metrics import METRICS

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
        self._subscriptions = [
            bus.subscribe(keys.summary(), Summary, self._on_summary),
            bus.subscribe(keys.measurement("coverage"), CoverageMeasurement, self._on_grid),
        ]

    def begin(self) -> None:
        """Ignore the conditions that are met already."""
        self._before, self.reason = frozenset(metric for metric, each in self._newest.items() if each.finished), ""

    def close(self) -> None:
        """Subscribe to nothing more."""
        for subscription in self._subscriptions:
            subscription.close()

    def later_than(self, time_s: float) -> bool:
        """Tell whether all that can still change is of a later time, by this machine's clock."""
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

    def _on_grid(self, grid: CoverageMeasurement) -> None:
        self._grids[grid.host] = grid


def finite(values: Numbers) -> dict[str, float]:
    """Return the values without those that JSON cannot hold."""
    return {name: value for name, value in values.items() if math.isfinite(value)}


def joined(onboard: Mapping[str, Numbers], truth: Mapping[str, Numbers]) -> dict[str, dict[str, float]]:
    """Return both tables in one, by ``onboard <name>`` and ``truth <name>``."""
    tables = (("onboard", onboard), ("truth", truth))
    return {f"{who} {name}": finite(values) for who, table in tables for name, values in table.items()}
