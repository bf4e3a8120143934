"""Takes each scan of the range sensors once: points of the world, without the robots of the fleet.

A point within the disc of another robot, as large as its place is uncertain, is that robot. All others go into the
grid. What lies where all was free moves: it is enclosed in a disc and handed to the tracker of objects. Obstacles of
the safety filter are the occupied cells around each robot and the cells of its newest scan, whatever the grid says of
them: something that has just come in front of a robot counts at once. They are where the robot saw them from, so the
error of its pose cancels; the filter's margin counts it nevertheless.

A ray of a sensor with a wide field of view (``RangeScan.cone_rad``) says how far the nearest thing in its cone is, not
where in the cone. The whole arc at that distance counts as occupied, so that nothing at the edge of a cone is lost;
only the middle half of the cone frees cells, because the sensor may miss what covers little of its field of view. What
such a ray hits is not tracked as a moving body: the arc moves with the robot.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fullswarm.agent.mapping.clusters import merged, moving_bodies
from fullswarm.agent.mapping.grid import OCCUPIED_ABOVE, OccupancyGrid
from fullswarm.agent.neighbours.estimates import Neighbours
from fullswarm.drivers.base import NO_OBSTACLES, Description, RangeScan
from fullswarm.kernels import Array, Flags, Index
from fullswarm.maps.tiles import GridPlace

NEAR_M = 1.2
"""Obstacles of the safety filter are taken from so far around a robot: well beyond its braking distance."""
ROBOT_SPARE_M = 0.05
"""A point so near the disc of a received robot is that robot, besides the errors of both places."""
CONFIDENCE = 3.0
WIDEST_SPREAD_M = 0.5
"""A robot whose place is less certain than this hides no more than that."""
MOVING_RANGE_M = 4.0
"""Bodies farther away are not tracked: too few rays hit them."""
KEPT_S = 1.0
"""Cells of a scan count for so long when the sensor is silent."""
CORE = 0.5
"""Share of a cone's angle, around its axis, in which a measurement frees cells."""
NO_BODIES: Array = np.zeros((0, 3))
NO_CELLS: Index = np.zeros(0, np.int64)


class RangeSense:
    """The range sensors of one agent's robots.

    Parameters
    ----------
    bounds_m : of the arena
    radius_m : (n,) footprints

    Attributes
    ----------
    any : a robot has a range sensor
    blind : (n,) it has one, and no newer scan for longer than its description allows
    grid : what they have measured
    obstacles : (k, 6) around the robots, as in ``Reading.obstacles``; the same array until it changes
    bodies : (k, 3) that move, x, y, radius in m, seen by the newest scans
    stamp_s : when those were taken
    points : by robot, what its newest scans saw that is no robot, (k, 2) m, world frame
    """

    def __init__(
        self, descriptions: Sequence[Description], neighbours: Neighbours, bounds_m: Sequence[float], cell_m: float,
        radius_m: Array,
    ) -> None:  # fmt: skip
        self.any = any(each.ranges_max_m > 0.0 for each in descriptions)
        self.range_m = min(max((each.ranges_max_m for each in descriptions), default=0.0), MOVING_RANGE_M)
        self.grid = OccupancyGrid(GridPlace.over(bounds_m, cell_m) if self.any else GridPlace(0.0, 0.0, 1.0, 32, 32))
        self.obstacles = NO_OBSTACLES
        self.bodies = NO_BODIES
        self.stamp_s = -math.inf
        self._neighbours, self._radius_m = neighbours, radius_m
        self.blind: Flags = np.array([each.ranges_max_m > 0.0 for each in descriptions])
        self._has_one, self._timeout_s = self.blind.copy(), np.array([each.ranges_timeout_s for each in descriptions])
        self._oldest_s = np.full(len(descriptions), -math.inf)
        self._last: tuple[tuple[int, RangeScan], ...] = ()
        self._stamps: dict[tuple[int, str], float] = {}
        self._cells: dict[tuple[int, str], tuple[float, Index]] = {}
        self._boxes: dict[int, Array] = {}

    def update(
        self, now_s: float, pose: Array, sigma: Array, twist: Array, ranges: tuple[tuple[int, RangeScan], ...]
    ) -> bool:
        """Take in the scans that are new; tell whether there was one.

        Parameters
        ----------
        pose, sigma, twist : (n, 3), (n, 2), (n, 2) of the robots now; a scan from an unknown pose is left out
        """
        news = ranges is not self._last
        if news:
            self._oldest_s[[row for row, _ in ranges]] = math.inf
            for row, scan in ranges:
                self._oldest_s[row] = min(self._oldest_s[row], scan.stamp_s)
        np.logical_and(self._has_one, now_s - self._oldest_s > self._timeout_s, out=self.blind)
        if not news:
            return False
        self._last = ranges
        new = [
            (row, scan) for row, scan in ranges
            if scan.stamp_s > self._stamps.get((row, scan.name), -math.inf) and math.isfinite(pose[row].sum())
        ]  # fmt: skip
        if not new:
            return False
        self._neighbours.refresh(now_s)
        self.grid.keep(now_s)
        received, own = self._received(now_s), self._own(pose, sigma)
        seen = []
        for row, scan in new:
            self._stamps[row, scan.name] = self.stamp_s = scan.stamp_s
            others = np.vstack([received, np.delete(own, row, axis=0)])
            seen.append(self._take(now_s, row, scan, pose[row], float(sigma[row, 0]), twist[row], others))
        self.bodies = merged(np.vstack(seen))
        for x, y, radius_m in self._stood(now_s, pose, sigma):
            self.grid.clear(x, y, radius_m)
        for row in {row for row, _ in new}:
            self._boxes[row] = self._around(now_s, row, pose[row])
        self.obstacles = np.vstack(list(self._boxes.values()))
        return True

    def _received(self, now_s: float) -> Array:
        """Return the discs (m, 3) within which a point is a robot of another agent."""
        table = self._neighbours
        heard = np.flatnonzero(table.heard(now_s))
        spread_m = np.minimum(table.spread_m[heard], WIDEST_SPREAD_M) + table.states[heard, 5]
        return np.column_stack([table.places[heard], spread_m])

    def _own(self, pose: Array, sigma: Array) -> Array:
        """Return the discs (n, 3) within which a point is a robot of this agent; NaN: its place is not known."""
        spread_m = np.minimum(CONFIDENCE * sigma[:, 0], WIDEST_SPREAD_M) + self._radius_m
        return np.column_stack([pose[:, :2], spread_m])

    def _stood(self, now_s: float, pose: Array, sigma: Array) -> list[list[float]]:
        """Return x, y and radius of where robots stand for sure: nothing else can be there."""
        table = self._neighbours
        heard = np.flatnonzero(table.heard(now_s))
        sure_m = table.states[heard, 5] - table.spread_m[heard] - self.grid.place.cell_m
        own_m = self._radius_m - CONFIDENCE * sigma[:, 0] - self.grid.place.cell_m
        own = np.column_stack([pose[:, :2], own_m])
        both = np.vstack([np.column_stack([table.places[heard], sure_m]), own[np.isfinite(pose[:, 0])]])
        found: list[list[float]] = both.tolist()
        return found

    def _take(
        self, now_s: float, row: int, scan: RangeScan, pose: Array, sigma_m: float, twist: Array, robots: Array
    ) -> Array:
        """Take in one scan; return the bodies (k, 3) that it saw moving."""
        cones = len(scan.distances_m)
        scan, core = spread(scan, self.grid.place.cell_m)
        origins, ends, hits, order = points_of(scan, pose, twist, now_s)
        if not len(origins):
            return NO_BODIES  # nothing was measured
        spare_m = ROBOT_SPARE_M + CONFIDENCE * (sigma_m + scan.sigma_m)
        reached = np.flatnonzero(hits)
        away_m = np.hypot(ends[reached, None, 0] - robots[None, :, 0], ends[reached, None, 1] - robots[None, :, 1])
        strange = ~(away_m <= robots[:, 2] + spare_m).any(axis=1)
        if core is not None:  # a robot anywhere on a cone's arc is what the cone has measured
            cone = order[reached] // (len(core) // cones)
            strange &= np.bincount(cone, ~strange, cones)[cone] == 0.0
        strange &= np.hypot(*(ends[reached] - pose[:2]).T) > self._radius_m[row]
        hits[reached[~strange]] = False
        reached = reached[strange]
        points = ends[reached]
        origin = origins.mean(axis=0)
        close = np.hypot(*(points - origin).T) <= self.range_m
        moving = np.zeros(len(hits), bool)
        bodies = NO_BODIES
        if not scan.cone_rad:
            appeared = self.grid.appeared(points[close], now_s)
            bodies, moved = moving_bodies(origin, points[close], order[reached[close]], appeared)
            moving[reached[close][moved]] = True
        self.grid.add(origin, ends, hits, moving, None if core is None else core[order])
        cells = self.grid.place.cells(points)
        self._cells[row, scan.name] = now_s, cells[cells >= 0]
        return bodies

    def _around(self, now_s: float, row: int, pose: Array) -> Array:
        newest = [cells for (each, _), (at_s, cells) in self._cells.items() if each == row and now_s - at_s < KEPT_S]
        also = np.concatenate([NO_CELLS, *newest])
        return self.grid.near(float(pose[0]), float(pose[1]), NEAR_M, also)

    def occupied(self) -> Flags:
        """Return which cells of the grid are occupied, (rows, columns)."""
        found: Flags = self.grid.odds > OCCUPIED_ABOVE
        return found


def spread(scan: RangeScan, cell_m: float) -> tuple[RangeScan, Flags | None]:
    """Return a scan whose cones are rays side by side, all of the cone's distance, and which of them may free cells.

    The rays are at most `cell_m` apart at `max_m`. A scan of narrow rays is returned as it is, with None: all may.
    """
    if not scan.cone_rad > 0.0:
        return scan, None
    half = math.ceil(0.5 * scan.cone_rad * scan.max_m / cell_m)
    off_rad = np.linspace(-0.5 * scan.cone_rad, 0.5 * scan.cone_rad, 2 * half + 1)
    core = np.abs(off_rad) <= 0.5 * CORE * scan.cone_rad + 1e-9
    angles_rad = (scan.angles_rad[:, None] + off_rad[None, :]).ravel()
    distances_m = np.repeat(scan.distances_m, len(off_rad))
    return replace(scan, angles_rad=angles_rad, distances_m=distances_m), np.tile(core, len(scan.distances_m))


def points_of(scan: RangeScan, pose: Array, twist: Array, now_s: float) -> tuple[Array, Array, Flags, Index]:
    """Return where the rays of a scan began and ended in the world, as the robot moved meanwhile.

    Parameters
    ----------
    pose, twist : (3,) and (2,) of the robot at `now_s`

    Returns
    -------
    tuple
        origins and ends (k, 2) m, which of them ended at something (k,), and the number of each ray (k,); rays that
        measured nothing are left out.
    """
    order = np.flatnonzero(~np.isnan(scan.distances_m))
    distances_m = scan.distances_m[order]
    hits = distances_m < scan.max_m
    length_m = np.where(hits, distances_m, scan.max_m)
    count = max(1, len(scan.distances_m) - 1)
    # How long ago each ray was measured: the last one at the stamp.
    ago_s = (now_s - scan.stamp_s) + scan.duration_s * (1.0 - order / count)
    heading = pose[2] - twist[1] * ago_s
    middle = pose[2] - 0.5 * twist[1] * ago_s
    x, y = pose[0] - twist[0] * ago_s * np.cos(middle), pose[1] - twist[0] * ago_s * np.sin(middle)
    c, s = np.cos(heading), np.sin(heading)
    mount = scan.mount
    origins = np.column_stack([x + c * mount.x_m - s * mount.y_m, y + s * mount.x_m + c * mount.y_m])
    towards = heading + mount.heading_rad + scan.angles_rad[order]
    ends = origins + length_m[:, None] * np.column_stack([np.cos(towards), np.sin(towards)])
    return origins, ends, np.asarray(hits, bool), order
