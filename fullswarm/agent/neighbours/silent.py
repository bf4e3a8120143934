"""Looks for silent robots: their discs shrink to what no robot of this agent has seen to be empty.

A silent robot is somewhere in a disc (see ``estimates.predict``), and at standstill once the disc has stopped growing.
From then on its disc is divided into cells no wider than its radius. Wherever its centre is within a cell, its body
covers the middle of the cell; so a cell whose middle is in sight, `LOOKS` times, while no body is reported that covers
it, does not hold the robot. Neither does a cell in which it would overlap something solid: a body that is seen, a
wall. (A body that is seen may *be* the silent robot: it is avoided as such, see ``objects.py``.) What remains is
enclosed in a disc, which the filter keeps off; when nothing remains, there is no disc any more.

Agents tell each other what remains, because each sees another side: a cell that is in none of another agent's discs
does not hold the robot. Bodies that may be it are told as discs too, so that a robot that has not seen them keeps off.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.neighbours.estimates import Neighbours
from fullswarm.bus.base import Bus
from fullswarm.kernels import Array, Flags
from fullswarm.keys import Keys
from fullswarm.messages import SearchedDiscs

LOOKS = 3
"""So often a cell must be seen empty: a sense may miss a body once."""
MOST_CELLS = 4096
"""A larger disc is not searched: it is kept as it is."""
MOST_SEEN = 16
SHARE_S = 0.5
SPARE_M = 0.05
"""What hides a cell is taken for so much wider, and a range for so much shorter."""
OVERLAP_M = 0.02
"""Solid bodies are reported to overlap by less than this."""


class _Search:
    """The cells of one silent robot: (k, 2) middles, and how often each was found empty."""

    def __init__(self, arrival_s: float, place: Array, radius_m: float, spread_m: float) -> None:
        self.arrival_s, self.radius_m = arrival_s, radius_m
        self.half_m = radius_m / math.sqrt(2.0)  # from a cell's middle to its corner
        steps = np.arange(-math.ceil(spread_m / radius_m), math.ceil(spread_m / radius_m) + 1) * radius_m
        x, y = (each.ravel() for each in np.meshgrid(steps, steps))
        inside = np.hypot(x, y) <= spread_m + self.half_m
        self.cells = np.stack([place[0] + x[inside], place[1] + y[inside]], axis=1)
        self.looks = np.zeros(len(self.cells), np.int64)
        self.place, self.spread_m = place, spread_m
        self.seen: list[tuple[float, float]] = []  # bodies that may be this robot

    @classmethod
    def cell_count(cls, radius_m: float, spread_m: float) -> float:
        across = spread_m / radius_m + 1.0
        return math.pi * across * across  # a power would raise where a radius is all but nothing

    def drop(self, empty: NDArray[np.bool_], looks: int = 1) -> None:
        """Count a look at cells that were found `empty`; those seen often enough are gone."""
        self.looks[empty] += looks
        kept = self.looks < LOOKS
        if not kept.all():
            self.cells, self.looks = self.cells[kept], self.looks[kept]

    def note(self, x_m: float, y_m: float) -> None:
        """Take note of a body that is no received robot, if it may be this one."""
        if math.hypot(x_m - self.place[0], y_m - self.place[1]) > self.spread_m + self.half_m:
            return
        if all(math.hypot(x_m - x, y_m - y) > self.radius_m for x, y in self.seen) and len(self.seen) < MOST_SEEN:
            self.seen.append((x_m, y_m))

    def keep(self, discs: Array) -> None:
        """Drop the cells that are in none of the `discs` (k, 3) of another agent."""
        x, y, radius = discs.T
        away_m = np.hypot(self.cells[:, None, 0] - x, self.cells[:, None, 1] - y)
        self.drop(~(away_m <= radius + self.half_m).any(axis=1), LOOKS)

    def discs(self) -> list[tuple[float, float, float]]:
        """Return what other agents are told: the disc of what remains, and the bodies that may be the robot."""
        found = [(x, y, self.half_m) for x, y in self.seen]
        return [self.disc(), *found] if len(self.cells) else found

    def disc(self) -> tuple[float, float, float]:
        """Return centre and radius of a disc that holds all cells; NaN when there are none."""
        if not len(self.cells):
            return math.nan, math.nan, 0.0
        middle = 0.5 * (self.cells.min(axis=0) + self.cells.max(axis=0))
        return float(middle[0]), float(middle[1]), float(np.hypot(*(self.cells - middle).T).max()) + self.half_m


class SilentSearch:
    """Searches the discs of all robots that fell silent, for one agent.

    Parameters
    ----------
    range_m : how far the agent's robots see bodies
    radius_m : (n,) footprints of the agent's robots
    """

    def __init__(
        self, bus: Bus, keys: Keys, host: str, neighbours: Neighbours, range_m: float, radius_m: Array
    ) -> None:  # fmt: skip
        self._bus, self._keys, self._host = bus, keys, host
        self._neighbours, self._range_m, self._radius_m = neighbours, range_m, radius_m
        self._searches: dict[int, _Search] = {}
        self._share_at_s = -math.inf
        self._subscription = bus.subscribe(keys.searched(), SearchedDiscs, self._on_searched, latest=True)

    def look(self, now_s: float, position: Array, bodies: Array, strange: Flags, obstacles: Array) -> None:
        """Use one look of the robots at `position` (n, 2).

        Parameters
        ----------
        bodies, strange : (k, 3) what they see, and which of it is no received robot (k,)
        obstacles : (b, 6) what hides bodies
        """
        table = self._neighbours
        if not table.silent:
            self._searches.clear()
            return
        rows = np.flatnonzero(table.at_rest(now_s))
        for row in [row for row in self._searches if row not in set(rows.tolist())]:
            del self._searches[row]
        if not len(rows):
            return
        heard = np.flatnonzero(table.heard(now_s))
        discs = np.vstack([bodies, np.column_stack([table.places[heard], table.states[heard, 5]])])
        for row in rows.tolist():
            away_m = np.hypot(*(position - table.places[row]).T).min(initial=math.inf)
            if not away_m - table.spread_m[row] <= self._range_m:
                continue
            search = self._search(row, obstacles)
            if search is not None and len(search.cells):
                self._use(search, position, discs, bodies, obstacles)
                for x_m, y_m, _ in bodies[strange].tolist():
                    search.note(x_m, y_m)
                table.confine(row, *search.disc())
        if now_s >= self._share_at_s and self._searches:
            self._share_at_s = now_s + SHARE_S
            self._share(now_s)

    def _share(self, now_s: float) -> None:
        robots = tuple(self._neighbours.names[row] for row in self._searches)
        discs = tuple((at, *disc) for at, search in enumerate(self._searches.values()) for disc in search.discs())
        message = SearchedDiscs(host=self._host, robots=robots, discs=discs, stamp_s=now_s)
        self._bus.publish(self._keys.searched(self._host), message)

    def _on_searched(self, told: SearchedDiscs) -> None:
        if told.host == self._host or not self._searches:
            return
        names = self._neighbours.names
        for row, search in self._searches.items():
            if names[row] in told.robots and len(search.cells):
                at = told.robots.index(names[row])
                search.keep(np.array([disc[1:] for disc in told.discs if disc[0] == at]).reshape(-1, 3))
                self._neighbours.confine(row, *search.disc())

    def close(self) -> None:
        """Drop the subscription."""
        self._subscription.close()

    def _search(self, row: int, obstacles: Array) -> _Search | None:
        table = self._neighbours
        arrival_s = float(table.arrival_s[row])
        found = self._searches.get(row)
        if found is None or found.arrival_s != arrival_s:
            radius_m, spread_m = float(table.states[row, 5]), float(table.spread_m[row])
            if _Search.cell_count(radius_m, spread_m) > MOST_CELLS:
                return None
            found = self._searches[row] = _Search(arrival_s, table.places[row].copy(), radius_m, spread_m)
            solid = np.zeros(len(found.cells), bool)
            for box in obstacles:
                solid |= _gap(found.cells, box) < found.radius_m - found.half_m - OVERLAP_M
            found.drop(solid, LOOKS)
        return found

    def _use(self, search: _Search, position: Array, discs: Array, bodies: Array, obstacles: Array) -> None:
        empty = np.zeros(len(search.cells), bool)
        for eye, own_m in zip(position, self._radius_m.tolist(), strict=True):
            if np.isfinite(eye).all():
                empty |= in_sight(eye, search.cells, self._range_m - SPARE_M, discs, obstacles)
                empty |= np.hypot(*(search.cells - eye).T) < own_m + search.radius_m - search.half_m - OVERLAP_M
        for x, y, radius_m in bodies.tolist():
            apart_m = np.hypot(search.cells[:, 0] - x, search.cells[:, 1] - y)
            empty |= apart_m < radius_m + search.radius_m - search.half_m - OVERLAP_M
        search.drop(empty)


def in_sight(eye: Array, points: Array, range_m: float, discs: Array, obstacles: Array) -> NDArray[np.bool_]:
    """Tell which points (k, 2) are in range of `eye` (2,) with nothing in between.

    Parameters
    ----------
    discs, obstacles : (m, 3) and (b, 6) what hides points, each taken for `SPARE_M` wider
    """
    way = points - eye
    length = np.hypot(*way.T)
    free: NDArray[np.bool_] = length <= range_m
    for x, y, radius in discs.tolist():
        if not free.any():
            return free
        off_x, off_y = x - eye[0], y - eye[1]
        part = np.clip((way[:, 0] * off_x + way[:, 1] * off_y) / np.maximum(length, 1e-9) ** 2, 0.0, 1.0)
        free &= np.hypot(off_x - part * way[:, 0], off_y - part * way[:, 1]) >= radius + SPARE_M
    for box in obstacles:
        if not free.any():
            return free
        free &= ~_crosses(eye, way, box)
    return free


def _local(x: Array, y: Array, yaw: float) -> tuple[Array, Array]:
    c, s = math.cos(yaw), math.sin(yaw)
    return c * x + s * y, c * y - s * x


def _crosses(eye: Array, way: Array, box: Array) -> NDArray[np.bool_]:
    """Tell which lines from `eye` along `way` (k, 2) meet a box."""
    at = _local(eye[0] - box[0], eye[1] - box[1], box[4])
    along = _local(way[:, 0], way[:, 1], box[4])
    low, high = np.zeros(len(way)), np.ones(len(way))
    for axis in range(2):
        half = box[2 + axis] + box[5] + SPARE_M
        step = np.where(np.abs(along[axis]) < 1e-12, 1e-12, along[axis])
        first, last = (-half - at[axis]) / step, (half - at[axis]) / step
        low, high = np.maximum(low, np.minimum(first, last)), np.minimum(high, np.maximum(first, last))
    crossed: NDArray[np.bool_] = low <= high
    return crossed


def _gap(points: Array, box: Array) -> Array:
    """Return the distance of points (k, 2) to a box; zero inside."""
    x, y = _local(points[:, 0] - box[0], points[:, 1] - box[1], box[4])
    out = np.hypot(np.maximum(np.abs(x) - box[2], 0.0), np.maximum(np.abs(y) - box[3], 0.0))
    found: Array = np.maximum(out - box[5], 0.0)
    return found
