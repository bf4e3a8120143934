"""Asks robots for the scans of their range sensors while they are looked at, and receives the reports."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass

import numpy as np

from fullswarm.bus.base import Bus
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.maps.scans import sensor_at, unpack
from fullswarm.messages import RangeQuery, RangeReport
from fullswarm.recent import Recent
from fullswarm.runtime import Scheduler

RENEW_S = 1.0
"""How often a query is repeated: it counts for three times as long."""
DEFAULT_HZ, MOST_HZ = 5.0, 20.0
MOST_KEPT = 1000
"""Robots whose scans wait for a program, at most."""
NO_ROBOT = "-"
"""A query for it ends the one before at once."""


class ScanWatch:
    """Receives the scans of some robots, or of all. Asks for none before :meth:`ask`.

    Parameters
    ----------
    source : unique to this asker, 64 characters at most
    on_report : called with each report on the bus, also with those that others have asked for
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, source: str, on_report: Callable[[RangeReport], None]
    ) -> None:
        self._bus, self._keys, self._source = bus, keys, source[-64:]
        self._query: RangeQuery | None = None
        self._subscription = bus.subscribe(keys.range_report(), RangeReport, on_report, latest=True)
        self._timer = scheduler.every(RENEW_S, self._renew)

    def ask(self, robots: Collection[str] | None, rate_hz: float = DEFAULT_HZ) -> None:
        """Ask from now on for the scans of `robots` at `rate_hz`, 20 at most; None: of all robots, empty: of none."""
        before = self._query
        if robots is not None and not robots:
            self._query = None
            if before is not None:
                self._bus.publish(self._keys.range_query, RangeQuery(source=self._source, robots=(NO_ROBOT,)))
            return
        named = () if robots is None else tuple(sorted(robots))
        self._query = RangeQuery(source=self._source, robots=named, rate_hz=min(rate_hz, MOST_HZ))
        if self._query != before:
            self._renew()

    def _renew(self) -> None:
        if self._query is not None:
            self._bus.publish(self._keys.range_query, self._query)

    def close(self) -> None:
        """Ask and receive no more. Closing twice is fine."""
        self.ask(())
        self._timer.cancel()
        self._subscription.close()


@dataclass(frozen=True, slots=True)
class Scan:
    """One scan of a robot's range sensor.

    Attributes
    ----------
    sensor : tells the sensors of a robot apart
    angles_rad, distances_m : (k,) rays from the sensor's own x axis, counter-clockwise; a distance is infinite where
        nothing is within `max_m`, NaN where nothing was measured
    mount : where the sensor is on the robot: x forward and y left in m, and where its x axis points in rad
    at : where the sensor was in the world when it measured its last ray: x and y in m, heading in rad; None: the robot
        did not know
    cone_rad : full field of view of each ray; 0: a narrow ray
    stamp_s : when the last ray was measured, on the robot's own clock
    """

    robot: str
    sensor: str
    angles_rad: Array
    distances_m: Array
    mount: tuple[float, float, float]
    at: tuple[float, float, float] | None
    max_m: float
    cone_rad: float
    stamp_s: float

    @property
    def points_m(self) -> Array:
        """Where rays ended at something, (m, 2) in the world; none if the robot did not know where it was."""
        hits = np.isfinite(self.distances_m)
        if self.at is None or not hits.any():
            return np.zeros((0, 2))
        angles_rad = self.at[2] + self.angles_rad[hits]
        away = np.column_stack([np.cos(angles_rad), np.sin(angles_rad)])
        found: Array = np.array(self.at[:2]) + self.distances_m[hits, None] * away
        return found


def scans_in(report: RangeReport) -> list[Scan]:
    """Return the scans of a report."""
    found = []
    for each in report.scans:
        bins = unpack(each)
        angles_rad: Array = bins.first_rad + bins.step_rad * np.arange(len(bins.distances_m), dtype=np.float64)
        found.append(Scan(
            report.robot, each.sensor, angles_rad, bins.distances_m, each.mount, sensor_at(each), each.max_m,
            each.cone_rad, each.stamp_s,
        ))  # fmt: skip
    return found


class ScanFeed:
    """Keeps the newest scans of robots until they are taken. Of a slow reader's robots each has its newest ones alone.

    Parameters
    ----------
    robots : whose; none: of all robots
    rate_hz : how often they are asked, 20 at most
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, source: str, robots: tuple[str, ...], rate_hz: float
    ) -> None:
        self._robots = robots
        self._newest: Recent[str, RangeReport] = Recent(MOST_KEPT)
        self._watch = ScanWatch(bus, keys, scheduler, source, self._on_report)
        self._watch.ask(robots or None, rate_hz)

    def _on_report(self, report: RangeReport) -> None:
        if not self._robots or report.robot in self._robots:
            self._newest[report.robot] = report

    def take(self) -> list[Scan] | None:
        """Return what has come since the last call; None: nothing has."""
        found = [scan for report in self._newest.values() for scan in scans_in(report)]
        self._newest.clear()
        return found or None

    def close(self) -> None:
        """Ask no more. Closing twice is fine."""
        self._watch.close()
