"""Ways around known obstacles: a grid of the arena, the distance to the goal from every free cell, the next waypoint.

Dijkstra on a 16-neighbour grid (SciPy), then the robot aims at the farthest point of its way that it sees in a
straight line, so that the grid's angles do not show. Computed anew when the goal or the known obstacles change.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import MissingExtra
from fullswarm.kernels import Array, Index, kernel

Grid = NDArray[np.bool_]

CELL_M = 0.2
MOST_CELLS = 250_000
"""A larger arena gets coarser cells."""
NOWHERE = -9999
_STEPS = [(dx, dy) for dx in range(-2, 3) for dy in range(-2, 3) if math.gcd(dx, dy) == 1]


@dataclass(frozen=True, slots=True)
class Field:
    """The ways to one goal.

    Attributes
    ----------
    free : (rows, columns) a robot's centre may be there
    next_cell : (rows * columns,) the next cell on the way; `NOWHERE` at the goal and where none leads there
    """

    x_min: float
    y_min: float
    cell_m: float
    free: Grid
    next_cell: Index
    distance_m: Array

    def way_m(self, x: float, y: float) -> float:
        """Return how long the way from a place to the goal is; infinite where no way is known."""
        row, column = math.floor((y - self.y_min) / self.cell_m), math.floor((x - self.x_min) / self.cell_m)
        rows, columns = self.free.shape
        inside = 0 <= row < rows and 0 <= column < columns
        return float(self.distance_m[row * columns + column]) if inside else math.inf


def build(
    goal: tuple[float, float], obstacles: Array, bounds_m: tuple[float, float, float, float], clearance_m: float
) -> Field:
    """Return the ways to `goal` around `obstacles` (k, 6), centres at least `clearance_m` from them.

    Raises
    ------
    MissingExtra
        SciPy is not installed.
    """
    try:
        from scipy.sparse import csr_array
        from scipy.sparse.csgraph import dijkstra
    except ImportError as error:
        raise MissingExtra("navigating needs SciPy", hint="pip install 'fullswarm[core]'") from error
    x_min, y_min, x_max, y_max = bounds_m
    cell_m = max(CELL_M, math.sqrt((x_max - x_min) * (y_max - y_min) / MOST_CELLS))
    columns, rows = (max(1, round((high - low) / cell_m)) for low, high in ((x_min, x_max), (y_min, y_max)))
    x: Array = x_min + (np.arange(columns, dtype=np.float64) + 0.5) * cell_m
    y: Array = y_min + (np.arange(rows, dtype=np.float64) + 0.5) * cell_m
    inside = np.minimum(np.minimum(x - x_min, x_max - x)[None, :], np.minimum(y - y_min, y_max - y)[:, None])
    free = np.minimum(inside, _gaps(x, y, obstacles)) >= clearance_m
    goal_cell = _nearest(free, (goal[1] - y_min) / cell_m - 0.5, (goal[0] - x_min) / cell_m - 0.5)
    count = rows * columns
    numbers = np.arange(count).reshape(rows, columns)
    starts, ends, lengths = [], [], []
    for dx, dy in _STEPS:
        here, there = _shifted(free, dx, dy), _shifted(free, -dx, -dy)
        both = free[here] & free[there]
        if max(abs(dx), abs(dy)) == 2:  # a knight's move passes between two cells: both must be free
            ax, ay = int(math.trunc(dx / 2)), int(math.trunc(dy / 2))
            bx, by = dx - ax, dy - ay
            both &= _neighbour(free, here, ax, ay) & _neighbour(free, here, bx, by)
        elif dx and dy:
            both &= _neighbour(free, here, dx, 0) & _neighbour(free, here, 0, dy)
        starts.append(numbers[here][both])
        ends.append(numbers[there][both])
        lengths.append(np.full(len(starts[-1]), math.hypot(dx, dy) * cell_m))
    graph = csr_array((np.concatenate(lengths), (np.concatenate(starts), np.concatenate(ends))), shape=(count, count))
    distance, before = dijkstra(graph, directed=False, indices=goal_cell, return_predecessors=True)
    return Field(x_min, y_min, cell_m, free, before.astype(np.int64), distance)


def _gaps(x: Array, y: Array, obstacles: Array) -> Array:
    """Return the distance from each cell centre to the nearest obstacle, (rows, columns) m."""
    nearest = np.full((len(y), len(x)), math.inf)
    for centre_x, centre_y, half_x, half_y, yaw, corner_m in obstacles:
        c, s = math.cos(yaw), math.sin(yaw)
        dx, dy = x[None, :] - centre_x, y[:, None] - centre_y
        out_x = np.maximum(np.abs(c * dx + s * dy) - half_x, 0.0)
        out_y = np.maximum(np.abs(-s * dx + c * dy) - half_y, 0.0)
        nearest = np.minimum(nearest, np.hypot(out_x, out_y) - corner_m)
    return nearest


def _shifted(free: Grid, dx: int, dy: int) -> tuple[slice, slice]:
    """Return the part of the grid from which a step (dx, dy) stays inside."""
    rows, columns = free.shape
    return slice(max(0, -dy), rows - max(0, dy)), slice(max(0, -dx), columns - max(0, dx))


def _neighbour(free: Grid, here: tuple[slice, slice], dx: int, dy: int) -> Grid:
    return free[here[0].start + dy : here[0].stop + dy, here[1].start + dx : here[1].stop + dx]


def _nearest(free: Grid, row: float, column: float) -> int:
    rows, columns = np.nonzero(free)
    if not len(rows):
        return 0
    best = int(np.argmin((rows - row) ** 2 + (columns - column) ** 2))
    return int(rows[best] * free.shape[1] + columns[best])


@kernel
def sees(x: float, y: float, to_x: float, to_y: float, x_min: float, y_min: float, cell_m: float, free: Grid) -> bool:
    """Tell whether the straight way between two points only touches free cells."""
    steps = int(math.hypot(to_x - x, to_y - y) / (0.5 * cell_m)) + 1
    for k in range(steps + 1):
        part = k / steps
        column = int(math.floor((x + part * (to_x - x) - x_min) / cell_m))
        row = int(math.floor((y + part * (to_y - y) - y_min) / cell_m))
        if row < 0 or column < 0 or row >= free.shape[0] or column >= free.shape[1] or not free[row, column]:
            return False
    return True


@kernel
def waypoint(
    x: float, y: float, x_min: float, y_min: float, cell_m: float, free: Grid, next_cell: Index, distance_m: Array,
    goal_x: float, goal_y: float, look_m: float,
) -> tuple[float, float]:  # fmt: skip
    """Return the farthest point of the way to the goal that is seen from (x, y), at most `look_m` along it.

    A robot too close to an obstacle to have a cell of its own goes as from that near one from which the way is
    shortest: going back to the nearest one, against those who follow, is how a passage jams. Where no way is known it
    returns the robot's own place.
    """
    columns = free.shape[1]
    rows = free.shape[0]
    column = min(max(int(math.floor((x - x_min) / cell_m)), 0), columns - 1)
    row = min(max(int(math.floor((y - y_min) / cell_m)), 0), rows - 1)
    from_x = x
    from_y = y
    if not free[row, column] or not math.isfinite(distance_m[row * columns + column]):
        best = math.inf
        near_row = row
        near_column = column
        for reach in (2, 5):
            for r in range(max(0, row - reach), min(rows, row + reach + 1)):
                for c in range(max(0, column - reach), min(columns, column + reach + 1)):
                    if free[r, c] and math.isfinite(distance_m[r * columns + c]):
                        way = distance_m[r * columns + c] if reach == 2 else 0.0
                        way += math.hypot(x_min + (c + 0.5) * cell_m - x, y_min + (r + 0.5) * cell_m - y)
                        if way < best:
                            best = way
                            near_row = r
                            near_column = c
            if best < math.inf:
                break
        if best == math.inf:
            return x, y
        row = near_row
        column = near_column
        from_x = x_min + (column + 0.5) * cell_m
        from_y = y_min + (row + 0.5) * cell_m
    cell = row * columns + column
    at_x = from_x
    at_y = from_y
    for step in range(int(look_m / cell_m) + 1):
        following = next_cell[cell]
        if following < 0:
            if sees(from_x, from_y, goal_x, goal_y, x_min, y_min, cell_m, free):
                return goal_x, goal_y
            break
        cell = following
        to_x = x_min + (cell % columns + 0.5) * cell_m
        to_y = y_min + (cell // columns + 0.5) * cell_m
        if step > 0 and not sees(from_x, from_y, to_x, to_y, x_min, y_min, cell_m, free):
            break
        at_x = to_x
        at_y = to_y
    return at_x, at_y
