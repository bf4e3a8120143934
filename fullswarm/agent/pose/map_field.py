"""Tells how far each place of a known map is from the nearest surface: its likelihood field.

Thrun, Burgard, Fox, *Probabilistic Robotics*, 2005, 6.4.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fullswarm.kernels import Array, Flags

CELL_M = 0.05
MOST_CELLS = 2_000_000
FARTHEST_M = 0.5
"""Distances count up to this."""
WALL_M = 0.5
"""Half the thickness that the arena's walls are given."""


class MapField:
    """Distances from the surfaces of a map.

    Parameters
    ----------
    boxes : (k, 6) rows as in ``Reading.obstacles``
    bounds_m : x_min, y_min, x_max, y_max of the arena
    walls : its edge is a wall
    """

    def __init__(self, boxes: Array, bounds_m: Sequence[float], *, walls: bool) -> None:
        x_min, y_min, x_max, y_max = bounds_m
        area_m2 = (x_max - x_min + 2.0) * (y_max - y_min + 2.0)
        self.cell_m = max(CELL_M, math.sqrt(area_m2 / MOST_CELLS))
        self.bounds_m = tuple(bounds_m)
        self._x_min, self._y_min = x_min - 1.0, y_min - 1.0
        columns, rows = (math.ceil((high - low + 2.0) / self.cell_m) for low, high in ((x_min, x_max), (y_min, y_max)))
        # Signed: below zero inside.
        self._gap_m = np.full((rows, columns), FARTHEST_M, np.float32)
        for box in boxes:
            self._add(box)
        if walls:
            middle_x, middle_y, half_x, half_y = (x_min + x_max) / 2, (y_min + y_max) / 2, x_max - x_min, y_max - y_min
            for x, y, wide, high in (
                (x_min - WALL_M, middle_y, WALL_M, half_y), (x_max + WALL_M, middle_y, WALL_M, half_y),
                (middle_x, y_min - WALL_M, half_x, WALL_M), (middle_x, y_max + WALL_M, half_x, WALL_M),
            ):  # fmt: skip
                self._add(np.array([x, y, wide, high, 0.0, 0.0]))
        self._surface_m = np.abs(self._gap_m)

    def _add(self, box: Array) -> None:
        x, y, half_x, half_y, yaw, corner = box.tolist()
        c, s = math.cos(yaw), math.sin(yaw)
        reach_x = abs(c) * half_x + abs(s) * half_y + corner + FARTHEST_M
        reach_y = abs(s) * half_x + abs(c) * half_y + corner + FARTHEST_M
        rows, columns = self._gap_m.shape
        first, last = (int((x + sign * reach_x - self._x_min) / self.cell_m) for sign in (-1.0, 1.0))
        low, high = (int((y + sign * reach_y - self._y_min) / self.cell_m) for sign in (-1.0, 1.0))
        across = slice(max(0, first), max(0, min(columns, last + 2)))
        along = slice(max(0, low), max(0, min(rows, high + 2)))
        dx = self._x_min + np.arange(across.start, across.stop) * self.cell_m - x
        dy = (self._y_min + np.arange(along.start, along.stop) * self.cell_m - y)[:, None]
        off_x, off_y = np.abs(c * dx + s * dy) - half_x, np.abs(c * dy - s * dx) - half_y
        outside = np.hypot(np.maximum(off_x, 0.0), np.maximum(off_y, 0.0))
        gap = outside + np.minimum(np.maximum(off_x, off_y), 0.0) - corner
        part = self._gap_m[along, across]
        np.minimum(part, gap, out=part, casting="same_kind")

    def surface_m(self, x: Array, y: Array) -> Array:
        """Return how far points are from the nearest surface, `FARTHEST_M` at most, between lattice points linearly."""
        rows, columns = self._surface_m.shape
        at_x, at_y = (x - self._x_min) / self.cell_m, (y - self._y_min) / self.cell_m
        outside = ~((at_x >= 0.0) & (at_x < columns - 1) & (at_y >= 0.0) & (at_y < rows - 1))
        at_x, at_y = np.where(outside, 0.0, at_x), np.where(outside, 0.0, at_y)
        column, row = at_x.astype(np.int64), at_y.astype(np.int64)
        part_x, part_y = at_x - column, at_y - row
        flat, at = self._surface_m.reshape(-1), row * columns + column
        lower = flat[at] + part_x * (flat[at + 1] - flat[at])
        upper = flat[at + columns] + part_x * (flat[at + columns + 1] - flat[at + columns])
        found: Array = np.where(outside, FARTHEST_M, lower + part_y * (upper - lower))
        return found

    def inside(self, x: Array, y: Array) -> Flags:
        """Tell which points are inside an obstacle, by more than a cell, or off the map."""
        rows, columns = self._gap_m.shape
        column = np.floor((x - self._x_min) / self.cell_m + 0.5).astype(np.int64)
        row = np.floor((y - self._y_min) / self.cell_m + 0.5).astype(np.int64)
        known = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        found: Flags = ~known | (self._gap_m[np.where(known, row, 0), np.where(known, column, 0)] < -self.cell_m)
        return found

    def free_places(self, count: int, radius_m: float, rng: np.random.Generator) -> Array:
        """Return random places (count, 2) within the arena that a disc fits in; fewer where there are few."""
        x_min, y_min, x_max, y_max = self.bounds_m
        drawn = rng.uniform((x_min, y_min), (x_max, y_max), (3 * count, 2))
        column = ((drawn[:, 0] - self._x_min) / self.cell_m).astype(np.int64)
        row = ((drawn[:, 1] - self._y_min) / self.cell_m).astype(np.int64)
        free: Array = drawn[self._gap_m[row, column] > min(radius_m, 0.9 * FARTHEST_M)][:count]
        return free
