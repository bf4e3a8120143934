"""What a swarm of real processes says of itself: the newest summary of each metric, and the coverage grids."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fullswarm.bus.base import Bus
from fullswarm.evaluate.trial_watch import ROBOT_QUANTITY, finite
from fullswarm.keys import Keys
from fullswarm.messages import CoverageMeasurement, Summary
from fullswarm.perf.coverage import GridFrame, unpack_bits


class LiveSummaries:
    """Hears summaries and the robots' own coverage grids."""

    def __init__(self, bus: Bus, keys: Keys) -> None:
        self._newest: dict[str, Summary] = {}
        self._grids: dict[str, CoverageMeasurement] = {}
        self._subscriptions = [
            bus.subscribe(keys.summary(), Summary, self._on_summary),
            bus.subscribe(keys.measurement("coverage"), CoverageMeasurement, self._on_grid),
        ]

    def close(self) -> None:
        """Hear no more."""
        for subscription in self._subscriptions:
            subscription.close()

    def finished(self) -> frozenset[str]:
        """Return the metrics whose summarizer has met a termination condition."""
        return frozenset(metric for metric, each in self._newest.items() if each.finished)

    def reason(self, metric: str) -> str:
        """Return which condition it was."""
        return self._newest[metric].reason

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

    def coverage(self) -> tuple[GridFrame, NDArray[np.uint8]] | None:
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

    def _on_grid(self, grid: CoverageMeasurement) -> None:
        self._grids[grid.host] = grid
