"""Looks for silent robots: their discs shrink to what no robot of this agent has seen to be empty.

A silent robot is somewhere in a disc (see ``estimates.predict``), and at standstill once the disc has stopped growing.
From then on its disc is divided into cells no wider than its radius. Wherever its centre is within a cell, its body
covers the middle of the cell; so a cell whose middle is in sight, `LOOKS` times, while no body is reported that covers
it, does not hold the robot. Neither does a cell in which it would overlap something solid: a body that is seen, a
wall. (A body that is seen may *be* the silent robot: it is avoided as such, see ``objects.py``.) What remains is
enclosed in a disc, which the filter keeps off; when nothing remains, there is no disc any more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.neighbours.estimates import Neighbours
from fullswarm.kernels import Array

LOOKS = 3
"""So often a cell must be seen empty: a sense may miss a body once."""
MOST_CELLS = 4096
"""A larger disc is not searched: it is kept as it is."""
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

    @classmethod
    def cell_count(cls, radius_m: float, spread_m: float) -> float:
        return math.pi * (spread_m / radius_m + 1.0) ** 2

    def drop(self, empty: NDArray[np.bool_], looks: int = 1) -> None:
        """Count a look at cells that were found `empty`; those seen often enough are gone."""
        self.looks[empty] += looks
        kept = self.looks < LOOKS
        if not kept.all():
            self.cells, self.looks = self.cells[kept], self.looks[kept]

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

    def __init__(self, neighbours: Neighbours, range_m: float, radius_m: Array) -> None:
        self._neighbours, self._range_m, self._radius_m = neighbours, range_m, radius_m
        self._searches: dict[int, _Search] = {}

    def look(self, now_s: float, position: Array, bodies: Array, obstacles: Array) -> None:
        """Use one look of the robots at `position` (n, 2): they see `bodies` (k, 3), and know `obstacles` (b, 6)."""
        table = self._neighbours
        if not table.silent:
            self._searches.clear()
            return
        rows = np.flatnonzero(table.at_rest(now_s))
        for row in [row for row in self._searches if row not in set(rows.tolist())]:
            del self._searches[row]
        if not len(rows):
            return
        heard = table.heard(now_s)
        discs = np.vstack([bodies, np.column_stack([table.places[heard], table.states[heard, 5]])])
        for row in rows.tolist():
            away_m = np.hypot(*(position - table.places[row]).T).min(initial=math.inf)
            if not away_m - table.spread_m[row] <= self._range_m:
                continue
            search = self._search(row, obstacles)
            if search is not None and len(search.cells):
                self._use(search, position, discs, bodies, obstacles)
                table.confine(row, *search.disc())

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


def names_of(names: Sequence[str], rows: Sequence[int]) -> str:
    """Return the names of rows in their order, separated by spaces."""
    return " ".join(names[row] for row in rows)
