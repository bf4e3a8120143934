"""Publishes the newest scans of the robots' range sensors, while there is a query for them."""

from __future__ import annotations

import math
from collections.abc import Sequence

from fullswarm.agent.state import AgentState
from fullswarm.bus.base import Bus
from fullswarm.drivers.base import RangeScan
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.maps.scans import even, pack
from fullswarm.messages import MOST_SENSORS, RangeQuery, RangeReport, SensorScan
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler, Timer

ASKED_S = 3.0
"""A query counts for so long."""
LOOK_S = 0.05
"""How often scans are looked at while there is a query: at the highest rate of one."""
MOST_ASKERS = 16
"""Queries that count at a time; they name their senders themselves."""
LONGEST_S = 60.0
"""Of a scan's duration, as a message can state it."""


class ScanReporter:
    """Publishes one report per robot and period. Without a query it has no timer, and nothing is computed.

    Parameters
    ----------
    ids : names of the n robots
    state : of the robots; its `pose` is that of the last tick, one control period old at most
    """

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, ids: Sequence[str], state: AgentState) -> None:
        self._bus, self._keys, self._scheduler, self._ids, self._state = bus, keys, scheduler, tuple(ids), state
        self._queries: Recent[str, tuple[float, RangeQuery]] = Recent(MOST_ASKERS)  # asker → when it expires
        self._sent: dict[int, tuple[float, tuple[float, ...]]] = {}  # row → when, stamps of the scans
        self._timer: Timer | None = None
        self._subscription = bus.subscribe(keys.range_query, RangeQuery, self._on_query)

    def _on_query(self, query: RangeQuery) -> None:
        if query.robots and not set(self._ids) & set(query.robots):
            self._queries.pop(query.source, None)
            return
        self._queries[query.source] = self._scheduler.now_s() + ASKED_S, query
        if self._timer is None:
            self._timer = self._scheduler.every(LOOK_S, self._look, first_s=0.0)

    def _look(self) -> None:
        now_s = self._scheduler.now_s()
        for source in [source for source, (until_s, _) in self._queries.items() if until_s <= now_s]:
            del self._queries[source]
        if not self._queries and self._timer is not None:
            self._timer.cancel()
            self._timer = None
            self._sent.clear()
            return
        reading = self._state.reading
        if reading is None:
            return
        for row, robot in enumerate(self._ids):
            rate_hz = max((each.rate_hz for _, each in self._queries.values() if _names(each, robot)), default=0.0)
            if rate_hz > 0.0:
                self._report(now_s, row, rate_hz, [scan for each, scan in reading.ranges if each == row])

    def _report(self, now_s: float, row: int, rate_hz: float, scans: list[RangeScan]) -> None:
        """Publish the scans of a robot if they are due and one of them is new."""
        sent_s, before = self._sent.get(row, (-math.inf, ()))
        stamps = tuple(scan.stamp_s for scan in scans)
        # A timer's period is added up: half of it is the tolerance.
        if not scans or stamps == before or now_s - sent_s < 1.0 / rate_hz - 0.5 * LOOK_S:
            return
        self._sent[row] = now_s, stamps
        pose, twist = self._state.pose[row], self._state.twist[row]
        packed = tuple(_packed(scan, pose, twist, now_s) for scan in scans[:MOST_SENSORS] if scan.max_m > 0.0)
        report = RangeReport(robot=self._ids[row], scans=packed, stamp_s=now_s)
        self._bus.publish(self._keys.range_report(self._ids[row]), report)

    def close(self) -> None:
        """Report no more. Closing twice is fine."""
        self._subscription.close()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None


def _names(query: RangeQuery, robot: str) -> bool:
    return not query.robots or robot in query.robots


def _packed(scan: RangeScan, pose: Array, twist: Array, now_s: float) -> SensorScan:
    bins = even(scan.angles_rad, scan.distances_m)
    return SensorScan(
        sensor=scan.name[:64],
        mount=(scan.mount.x_m, scan.mount.y_m, scan.mount.heading_rad),
        robot_at=_pose_before(pose, twist, now_s - scan.stamp_s),
        first_rad=bins.first_rad,
        step_rad=bins.step_rad,
        distances=pack(bins.distances_m),
        max_m=min(scan.max_m, 1e5),
        cone_rad=scan.cone_rad,
        duration_s=min(max(scan.duration_s, 0.0), LONGEST_S),
        stamp_s=scan.stamp_s,
    )


def _pose_before(pose: Array, twist: Array, ago_s: float) -> tuple[float, float, float] | None:
    """Return a pose (3,) `ago_s` earlier, as the robot drives with `twist` (2,); None: it is not known."""
    x_m, y_m, heading_rad = pose.tolist()
    if not math.isfinite(x_m + y_m + heading_rad):
        return None
    speed_m_s, turn_rad_s = twist.tolist()
    middle_rad = heading_rad - 0.5 * turn_rad_s * ago_s
    return (
        x_m - speed_m_s * ago_s * math.cos(middle_rad),
        y_m - speed_m_s * ago_s * math.sin(middle_rad),
        heading_rad - turn_rad_s * ago_s,
    )
