"""Sends pages the range scans of the robots that they look at, and asks robots for them only meanwhile."""

from __future__ import annotations

import base64
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any

from fullswarm.bus.base import Bus
from fullswarm.keys import Keys
from fullswarm.maps.scans import pack, sensor_at, thinned, unpack
from fullswarm.messages import RangeReport, SensorScan
from fullswarm.operator.console import frames
from fullswarm.operator.console.sessions import Listener
from fullswarm.operator.scans import DEFAULT_HZ, ScanWatch
from fullswarm.runtime import Scheduler

MOST_ROBOTS = 16
"""Robots that are asked for all pages together; a page names at most `frames.MOST_SCANNED`."""
PAGE_RAYS = 360
"""Rays of a scan that a page draws; of more, the nearest of neighbours."""
FRESH_S = 1.0
"""A scan that was older when it was sent is not shown: its sensor is silent."""


class Scans:
    """The scans that pages look at. Of a report that several pages look at, the frame is encoded once.

    Parameters
    ----------
    source : unique to this console
    drawing : keeps what cannot be shown from ending the process, given its name
    """

    def __init__(
        self,
        bus: Bus,
        keys: Keys,
        scheduler: Scheduler,
        source: str,
        drawing: Callable[[str], AbstractContextManager[object]],
    ) -> None:
        self._drawing = drawing
        self._shown: dict[Listener, tuple[str, ...]] = {}
        self._watch = ScanWatch(bus, keys, scheduler, source, self._on_report)

    def show(self, listener: Listener, robots: tuple[str, ...]) -> None:
        """Send a page the scans of these robots from now on; of none: no more."""
        if robots:
            self._shown[listener] = robots
        else:
            self._shown.pop(listener, None)
        # Those that most pages look at first, if they are too many.
        wanted: dict[str, int] = {}
        for each in self._shown.values():
            for robot in each:
                wanted[robot] = wanted.get(robot, 0) + 1
        self._watch.ask(sorted(wanted, key=lambda robot: (-wanted[robot], robot))[:MOST_ROBOTS], DEFAULT_HZ)

    def _on_report(self, report: RangeReport) -> None:
        listeners = [listener for listener, robots in self._shown.items() if report.robot in robots]
        if not listeners:
            return
        with self._drawing("scans"):
            self._send(report, listeners)

    def _send(self, report: RangeReport, listeners: list[Listener]) -> None:
        shown = [each for each in (_scan(report, scan) for scan in report.scans) if each is not None]
        text = frames.encode({"t": "scans", "robot": report.robot, "scans": shown})
        for listener in listeners:
            listener.put(f"scans {report.robot}", text)

    def close(self) -> None:
        """Ask robots no more. Closing twice is fine."""
        self._shown.clear()
        self._watch.close()


def _scan(report: RangeReport, scan: SensorScan) -> dict[str, Any] | None:
    """Return what a page draws of a scan; None: it is old, or its robot does not know where it is."""
    at, age_s = sensor_at(scan), report.stamp_s - scan.stamp_s
    if at is None or age_s > FRESH_S:
        return None
    bins = thinned(unpack(scan), PAGE_RAYS)
    return {
        "at": [round(value, 4) for value in at],
        "first_rad": round(bins.first_rad, 6),
        "step_rad": round(bins.step_rad, 8),
        "cone_rad": round(scan.cone_rad, 4),
        "max_m": scan.max_m,
        "age_s": round(max(age_s, 0.0), 3),
        "mm": base64.b64encode(pack(bins.distances_m)).decode("ascii"),
    }
