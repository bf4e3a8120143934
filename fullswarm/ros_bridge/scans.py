"""The scans of one robot's range sensors as topics of ROS: ``scan``, or one for each of several sensors."""

from __future__ import annotations

import re
from collections.abc import Callable

from fullswarm.bus.lanes import Bucket
from fullswarm.messages import MOST_SENSORS, RangeReport, SensorScan
from fullswarm.ros_bridge import codec as types
from fullswarm.ros_bridge import values as v
from fullswarm.ros_bridge.link import Topic, Values

MOST_HZ = 25.0
"""Of the reports of one robot at most; none that is as it should be sends so many."""
LONGEST_S = 1.0
"""A scan is stamped no earlier than this before its arrival, whatever its robot states."""
_STRANGE = re.compile(r"[^A-Za-z0-9_]")
_TAKEN = ("odom", "base_link")


class ScanTopics:
    """The topics and frames of one robot's range sensors; a robot with none has none.

    Parameters
    ----------
    name : of the robot in ROS

    Attributes
    ----------
    mounts : frame of a sensor → where it is on the robot, x, y in m and heading in rad
    """

    def __init__(
        self, name: str, advertise: Callable[[Topic], None], withdraw: Callable[[Topic], None],
        publish: Callable[[Topic, Values], None], now_s: float,
    ) -> None:  # fmt: skip
        self._name, self._advertise, self._withdraw, self._publish = name, advertise, withdraw, publish
        self.mounts: dict[str, tuple[float, float, float]] = {}
        self._topics: dict[str, Topic] = {}  # by frame
        self._stamps: dict[str, float] = {}
        self._several = False
        self._bucket = Bucket(MOST_HZ, now_s)

    def update(self, report: RangeReport, now_s: float, stamp_ns: int) -> bool:
        """Publish the scans that are new; tell whether a frame is new or has moved.

        Parameters
        ----------
        stamp_ns : nanoseconds since 1970 now
        """
        if not self._bucket.take(now_s):
            return False
        if len(report.scans) > 1 and not self._several:
            self._several = True
            self.close()  # the one topic of a robot of which only one sensor had measured
        moved = False
        for scan in report.scans:
            frame = self._frame(scan.sensor)
            topic = self._topic(frame)
            if topic is None or self._stamps.get(frame) == scan.stamp_s:
                continue
            self._stamps[frame] = scan.stamp_s
            moved |= self.mounts.get(frame) != scan.mount
            self.mounts[frame] = scan.mount
            self._publish(topic, v.laser_scan(frame, scan, stamp_ns - _age_ns(report, scan)))
        return moved

    def _frame(self, sensor: str) -> str:
        name = _STRANGE.sub("_", sensor) or "ranges"
        return f"{self._name}/{name}_sensor" if name in _TAKEN else f"{self._name}/{name}"

    def _topic(self, frame: str) -> Topic | None:
        """Return the topic of a sensor, offered from its first scan on; None: too many sensors."""
        topic = self._topics.get(frame)
        if topic is None and len(self._topics) < MOST_SENSORS:
            last = f"scan_{frame.rpartition('/')[2]}" if self._several else "scan"
            topic = self._topics[frame] = Topic(f"{self._name}/{last}", types.SCAN)
            self._advertise(topic)
        return topic

    def close(self) -> None:
        """Withdraw all topics."""
        for topic in self._topics.values():
            self._withdraw(topic)
        self._topics.clear()
        self._stamps.clear()


def _age_ns(report: RangeReport, scan: SensorScan) -> int:
    return round(1e9 * min(max(report.stamp_s - scan.stamp_s, 0.0), LONGEST_S))
