"""The occupancy grid of one agent: log odds of each cell, from rays that end in it or pass through it.

Bounded memory: one number per cell of the arena, a million cells at most (Moravec, Elfes, *High resolution maps from
wide angle sonar*, 1985; the increments are those of a lidar whose distances are good to a cell).
"""

from __future__ import annotations

from collections import deque

import numpy as np
from numpy.typing import NDArray

from fullswarm.kernels import Array, Flags, Index
from fullswarm.maps.boxes import boxes
from fullswarm.maps.tiles import FREE, OCCUPIED, UNKNOWN, GridPlace, States

HIT, MISS = 0.9, -0.5
MOVING_HIT = 0.25
"""Of a body that moves: where it stands for a second it becomes part of the map, what it passes through does not."""
LEAST, MOST = -2.0, 2.5
"""Bounds of the log odds: what was measured for an hour must be forgotten within a second once it is gone."""
OCCUPIED_ABOVE, FREE_BELOW = 0.5, -0.6
SETTLED_CELLS = 2
"""A point so near an occupied cell belongs to it: noise must not look like motion."""
PAST_S, SNAPSHOT_S = 0.6, 0.3
"""What was free at least so long ago, and is hit now, has moved; how often the grid is kept for that. What comes on by
less than `SETTLED_CELLS` per scan always lies beside cells that it has just made occupied."""
SHORT_CELLS = 1.5
"""A ray frees cells up to so far before its end."""


class OccupancyGrid:
    """Log odds over the arena.

    Attributes
    ----------
    place : where the cells lie
    odds : (rows, columns) log odds of being occupied; 0: nothing is known
    changed : (tiles,) which tiles have got another state since the owner last reset this
    """

    def __init__(self, place: GridPlace) -> None:
        self.place = place
        self.odds = np.zeros((place.rows, place.columns), np.float32)
        self.changed = np.zeros(place.tiles, bool)
        self._past: deque[tuple[float, NDArray[np.float32]]] = deque()
        self._marks = np.zeros(place.rows * place.columns, bool)  # all false between two calls

    def keep(self, now_s: float) -> None:
        """Keep the grid as it is for :meth:`appeared`, once in `SNAPSHOT_S`."""
        past = self._past
        if past and now_s < past[-1][0]:
            past.clear()  # the clock was set back
        if past and now_s - past[-1][0] < SNAPSHOT_S:
            return
        while len(past) > 1 and now_s - past[1][0] >= PAST_S:
            past.popleft()
        past.append((now_s, self.odds.copy()))

    def add(self, origin: Array, ends: Array, hits: Flags, moving: Flags, frees: Flags | None = None) -> None:
        """Take in one scan.

        Parameters
        ----------
        origin : (2,) m, the sensor
        ends : (k, 2) m, where each ray ended or was lost
        hits : (k,) whether it ended at something; a ray that ended at a robot of the fleet only frees
        moving : (k,) whether what it hit moves
        frees : (k,) whether it frees the cells that it passed; None: all do
        """
        odds = self.odds.reshape(-1)
        none = np.empty(0, np.intp)
        firm = self._once(self.place.cells(ends[hits & ~moving]), none)
        loose = self._once(self.place.cells(ends[hits & moving]), firm)
        hit = np.concatenate([firm, loose])
        free = self._once(self._passed(origin, ends if frees is None else ends[frees]), hit)
        touched = np.concatenate([hit, free])
        before = _state(odds[touched])
        odds[firm] = np.minimum(odds[firm] + HIT, MOST)
        odds[loose] = np.minimum(odds[loose] + MOVING_HIT, MOST)
        odds[free] = np.maximum(odds[free] + MISS, LEAST)
        other = touched[_state(odds[touched]) != before]
        if len(other):
            across = self.place.tiles_across
            side = self.place.columns // across
            self.changed[other // (self.place.columns * side) * across + other % self.place.columns // side] = True

    def clear(self, x_m: float, y_m: float, radius_m: float) -> None:
        """Make the cells free whose middles are within a disc: a robot stands there."""
        place = self.place
        if not radius_m > 0.0:
            return
        reach = int(radius_m / place.cell_m) + 1
        row, column = (int((at - low) / place.cell_m) for at, low in ((y_m, place.y_min), (x_m, place.x_min)))
        rows = np.arange(max(0, row - reach), max(0, min(place.rows, row + reach + 1)))
        columns = np.arange(max(0, column - reach), max(0, min(place.columns, column + reach + 1)))
        off_x = place.x_min + (columns + 0.5) * place.cell_m - x_m
        off_y = place.y_min + (rows + 0.5) * place.cell_m - y_m
        inside = off_x[None, :] ** 2 + off_y[:, None] ** 2 <= radius_m * radius_m
        part = self.odds[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] if len(rows) and len(columns) else None
        if part is not None:
            part[inside] = LEAST

    def _once(self, cells: Index, without: Index) -> Index:
        """Return each of `cells` once that is in the grid (not negative) and none of `without`, in order.

        Marks in a grid take a tenth of the time of sorting: a scan passes through some 50,000 cells.
        """
        marks = self._marks
        marks[cells[cells >= 0]] = True
        marks[without] = False
        found = np.flatnonzero(marks)
        marks[found] = False
        return found

    def _passed(self, origin: Array, ends: Array) -> Index:
        """Return the cells that rays passed through, some of them several times."""
        place, cell_m = self.place, self.place.cell_m
        way = ends - origin
        length_m = np.hypot(way[:, 0], way[:, 1])
        steps = np.maximum(np.ceil(length_m / cell_m - SHORT_CELLS - 0.5), 0.0).astype(np.int64)
        before = np.cumsum(steps) - steps
        along_m = (np.arange(steps.sum()) - np.repeat(before, steps) + 0.5) * cell_m
        along = way / (np.maximum(length_m, 1e-9) * cell_m)[:, None]
        column = (origin[0] - place.x_min) / cell_m + along_m * np.repeat(along[:, 0], steps)
        row = (origin[1] - place.y_min) / cell_m + along_m * np.repeat(along[:, 1], steps)
        inside = (column >= 0.0) & (column < place.columns) & (row >= 0.0) & (row < place.rows)
        if not inside.all():
            column, row = column[inside], row[inside]
        cells: Index = row.astype(np.int64) * place.columns + column.astype(np.int64)
        return cells

    def appeared(self, points: Array, now_s: float) -> Flags:
        """Tell which points (k, 2) lie where all was free, with nothing occupied around: what is there has moved.

        Of the grid now, or of how it was `PAST_S` ago.
        """
        cells = self.place.cells(points)
        found = self._free_around(cells, self.odds)
        if self._past and now_s - self._past[0][0] >= PAST_S:
            found |= self._free_around(cells, self._past[0][1])
        return found

    def _free_around(self, cells: Index, grid: NDArray[np.float32]) -> Flags:
        found = np.zeros(len(cells), bool)
        odds, columns = grid.reshape(-1), self.place.columns
        known = np.flatnonzero(cells >= 0)
        free = known[odds[cells[known]] < FREE_BELOW]
        if not len(free):
            return found
        reach = np.arange(-SETTLED_CELLS, SETTLED_CELLS + 1)
        around = (reach[:, None] * columns + reach[None, :]).ravel()
        near = np.clip(cells[free, None] + around[None, :], 0, len(odds) - 1)
        found[free] = ~(odds[near] > OCCUPIED_ABOVE).any(axis=1)
        return found

    def states(self) -> States:
        """Return the state of each cell, (rows, columns)."""
        return _state(self.odds)

    def near(self, x_m: float, y_m: float, reach_m: float, also: Index) -> Array:
        """Return boxes (k, 6) that cover the occupied cells within a square around a place.

        Parameters
        ----------
        also : cells that count as occupied whatever the grid says
        """
        place, reach = self.place, int(reach_m / self.place.cell_m) + 1
        row, column = (int((at - low) / place.cell_m) for at, low in ((y_m, place.y_min), (x_m, place.x_min)))
        rows = slice(max(0, row - reach), max(0, min(place.rows, row + reach + 1)))
        columns = slice(max(0, column - reach), max(0, min(place.columns, column + reach + 1)))
        occupied = self.odds[rows, columns] > OCCUPIED_ABOVE
        also_rows, also_columns = also // place.columns - rows.start, also % place.columns - columns.start
        inside = (also_rows >= 0) & (also_rows < occupied.shape[0])
        inside &= (also_columns >= 0) & (also_columns < occupied.shape[1])
        occupied[also_rows[inside], also_columns[inside]] = True
        return boxes(
            occupied, place.x_min + columns.start * place.cell_m, place.y_min + rows.start * place.cell_m, place.cell_m
        )  # fmt: skip


def _state(odds: NDArray[np.float32]) -> States:
    found = np.full(odds.shape, UNKNOWN, np.uint8)
    found[odds < FREE_BELOW] = FREE
    found[odds > OCCUPIED_ABOVE] = OCCUPIED
    return found
