"""Locates an agent's robots on the known map by their ranges, and hands the poses on as fixes, like any other source's.

A robot that does not know its place on the map, or whose measurements do not fit it, stands (``lost``).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from fullswarm.agent.mapping.sense import points_of
from fullswarm.agent.pose.map_field import MapField
from fullswarm.agent.pose.map_localizer import MapLocalizer
from fullswarm.agent.pose.pose_filter import OdometryNoise, between
from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import FleetReading, RangeScan
from fullswarm.geometry import wrap
from fullswarm.kernels import Array
from fullswarm.messages import PoseFix

SOURCE = "map"
LONG_S = 1.0
AGREES_M, AGREES_RAD = 0.2, 0.2
"""A robot that was lost drives again when its agent's pose is so near what the localizer has found: the first fixes of
one that was carried are outliers, and until they are believed its pose is the old one."""
FREE_RAYS, FREE_SHARES = 6, (0.4, 0.8)
"""Of every so many rays, at these shares of its way: points that are free."""


class MapPoses:
    """The localizers of an agent's n robots.

    Parameters
    ----------
    given : (k, 6) the map
    receive : takes a fix
    start : (n, 3) start poses; of those the fleet file does not place, the whole map is searched

    Attributes
    ----------
    lost : (n,) robots that must not drive: where they are on the map is not known, or not yet taken for their pose
    """

    def __init__(
        self, config: SwarmConfig, ids: Sequence[str], given: Array, radius_m: Array, start: Array,
        receive: Callable[[PoseFix], None],
    ) -> None:  # fmt: skip
        settings, world = config.agent, config.world_or_default
        field = MapField(given, config.bounds_m, walls=config.world is not None and world.walls)
        placed = {each.id for each in config.robot if each.pose is not None}
        noise = OdometryNoise(settings.odometry_sigma_m, settings.odometry_sigma_rad)
        self._ids, self._receive = tuple(ids), receive
        self._localizers = [
            MapLocalizer(
                field, float(radius_m[row]), noise, np.random.default_rng((world.seed, 4, row)),
                (start[row], settings.start_sigma_m, settings.start_sigma_rad) if robot in placed else None,
            )
            for row, robot in enumerate(ids)
        ]  # fmt: skip
        self.lost = np.array([each.lost for each in self._localizers], bool)
        self._odometry: list[list[float] | None] = [None] * len(self._ids)
        self._moved_s = [-math.inf] * len(self._ids)
        self._seen_s: dict[tuple[int, str], float] = {}
        self._last: tuple[tuple[int, RangeScan], ...] = ()

    def update(self, reading: FleetReading, pose: Array) -> None:
        """Take in the scans that are new; `pose` (n, 3) is what the agent takes for the robots' poses."""
        if reading.ranges is self._last:
            return
        self._last = reading.ranges
        for row, scan in reading.ranges:
            if scan.cone_rad > 0.0:
                continue  # where in its cone something is, is not known: it would not fit the map
            since_s = scan.stamp_s - self._seen_s.get((row, scan.name), scan.stamp_s)
            if (row, scan.name) in self._seen_s and since_s <= 0.0:
                continue
            self._seen_s[row, scan.name] = scan.stamp_s
            self._locate(row, scan, reading, pose[row], min(since_s, LONG_S))

    def _locate(self, row: int, scan: RangeScan, reading: FleetReading, pose: Array, since_s: float) -> None:
        localizer, odometry = self._localizers[row], reading.odometry[row].tolist()
        before, self._odometry[row] = self._odometry[row], odometry
        if before is not None:
            localizer.move(between(before, odometry, max(0.0, float(reading.stamp_s[row]) - self._moved_s[row])))
        self._moved_s[row] = float(reading.stamp_s[row])
        origins, ends, hits, _ = points_of(scan, np.zeros(3), reading.twist[row], float(reading.stamp_s[row]))
        passed = [origins[::FREE_RAYS] + share * (ends - origins)[::FREE_RAYS] for share in FREE_SHARES]
        found = localizer.see(ends[hits], np.vstack(passed), since_s)
        self.lost[row] |= localizer.lost
        if found is None:
            return
        x_m, y_m, heading_rad = found.pose
        near = math.hypot(x_m - pose[0], y_m - pose[1]) < AGREES_M  # NaN is not
        if near and abs(wrap(heading_rad - pose[2])) < AGREES_RAD:
            self.lost[row] = False
        xx, xy, yy = found.covariance_m2
        self._receive(
            PoseFix(
                robot=self._ids[row], x_m=x_m, y_m=y_m, heading_rad=heading_rad,
                position_sigma_m=math.sqrt(0.5 * (xx + yy)), covariance_m2=(xx, xy, yy),
                heading_sigma_rad=found.heading_sigma_rad, source=SOURCE, stamp_s=float(reading.stamp_s[row]),
            )
        )  # fmt: skip
