"""Navigate: to a goal around the obstacles that are known, where a proportional law is caught (paper IV.A, scenario 4).

What is known is up to the request: the map that the robot was given, what it has seen itself, or what the swarm has
seen and shared. The way is a shortest one on a grid; the velocity points at the farthest point of it
that is in sight.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.safety.barrier import box_gap
from fullswarm.agent.view import Params, View
from fullswarm.errors import MissingExtra
from fullswarm.kernels import Array, Index, kernel

LOOK_M = 6.0
SLACK_M = 0.12
"""Free space that a way leaves beyond the robot's own radius: the filter keeps a margin, and grids are coarse."""
LANES_M = (SLACK_M, 0.4, 0.8, 1.2)
CROWD_M = 0.7
DETOUR = 1.6
FIELDS = 128
PUSH = 0.5
"""How much a way at an obstacle's edge is bent off it: along the filter's border a robot crawls for ever."""

_fields: OrderedDict[tuple[object, ...], Field] = OrderedDict()


def velocity(view: View, params: Params) -> Array:
    """Return velocities towards the next waypoints, ``K`` times the way that is left at most, (n, 2) m/s."""
    desired = np.zeros_like(view.position)
    near = view.distance < CROWD_M
    crowd = np.bincount(view.of[near], minlength=len(desired)).tolist()
    for row in range(len(desired)):
        x, y = view.position[row].tolist()
        goal_x, goal_y = params.goal[row].tolist()
        left_m = math.hypot(goal_x - x, goal_y - y)
        if left_m <= float(params.arrive_radius_m[row, 0]):
            continue
        field = _lane(view, row, (goal_x, goal_y), str(params.map), crowd[row])
        to_x, to_y = waypoint.run(
            x, y, field.x_min, field.y_min, field.cell_m, field.free, field.next_cell, field.distance_m,
            goal_x, goal_y, LOOK_M,
        )  # fmt: skip
        ahead_m = math.hypot(to_x - x, to_y - y)
        if ahead_m > 1e-9:
            speed = float(params.gain[row, 0]) * left_m / ahead_m
            vx, vy = speed * (to_x - x), speed * (to_y - y)
            desired[row] = bend.run(x, y, vx, vy, float(view.radius[row]), view.known(row, str(params.map)))
    return desired


@kernel
def bend(x: float, y: float, vx: float, vy: float, radius_m: float, obstacles: Array) -> tuple[float, float]:
    """Turn a velocity off the obstacles that are nearer than the slack, the more the nearer; its size is kept."""
    size = math.hypot(vx, vy)
    bent_x = vx
    bent_y = vy
    for row in range(obstacles.shape[0]):
        gap, nx, ny = box_gap(x, y, obstacles, row)
        nearness = min(1.0, 1.0 - (gap - radius_m) / SLACK_M)
        if nearness > 0.0:
            bent_x -= PUSH * nearness * size * nx
            bent_y -= PUSH * nearness * size * ny
    bent = math.hypot(bent_x, bent_y)
    if bent < 1e-9:
        return vx, vy
    return bent_x * size / bent, bent_y * size / bent


def _lane(view: View, row: int, goal: tuple[float, float], source: str, crowd: int) -> Field:
    """Return the ways for a robot; in a crowd they keep farther off the obstacles, or all would queue at one corner."""
    known, radius_m = view.known(row, source), float(view.radius[row])
    x, y = view.position[row].tolist()
    shortest = _field(goal, known, view.bounds_m, radius_m + LANES_M[0])
    longest_m = DETOUR * shortest.way_m(x, y) + CROWD_M
    for lane in range(min(crowd, len(LANES_M) - 1), 0, -1):
        field = _field(goal, known, view.bounds_m, radius_m + LANES_M[lane])
        if field.way_m(x, y) <= longest_m < math.inf:
            return field
    return shortest


def _field(
    goal: tuple[float, float], obstacles: Array, bounds_m: tuple[float, float, float, float], clearance_m: float
) -> Field:
    """Return the field for a goal and a state of knowledge; the newest few are kept."""
    key = (goal, bounds_m, clearance_m, obstacles.tobytes())
    field = _fields.get(key)
    if field is None:
        field = _fields[key] = build(goal, obstacles, bounds_m, clearance_m)
        while len(_fields) > FIELDS:
            _fields.popitem(last=False)
    else:
        _fields.move_to_end(key)
    return field


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
    shortest: going back to the nearest one, against those that follow, is how a passage jams. Where no way is known it
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
