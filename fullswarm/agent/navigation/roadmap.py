"""Builds the graph of ways on a map, and on it the shortest ways to a goal.

Nodes are the centres of a grid's cells and points on the axes of narrow passages, so that a passage is found wherever
it lies between the cells. Each edge is a straight way whose clearance is checked exactly. The graph belongs to a map, a
body's size and nothing else; a field of ways belongs to a goal.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.navigation.geometry import Bounds, free_ways, gaps, way_gaps, with_edges
from fullswarm.agent.navigation.passages import Passages, find
from fullswarm.errors import MissingExtra
from fullswarm.kernels import Array, Index, kernel

CELL_M = 0.2
MOST_CELLS = 250_000
"""A larger arena gets coarser cells."""
NOWHERE = -1
TIGHT_COST = 3.0
"""A metre at the least clearance counts as so many with the preferred one."""
AXIS_STEP_M = 0.15
APPROACH_M = 0.6
"""How far a passage's axis reaches beyond its mouths: a robot shall be aligned with it before it enters."""
AXIS_WIDEST_M = 1.5
LINK_M = 0.35
"""Points on axes are joined with all nodes that are nearer."""
SPAN_M = 3.0
_STEPS = [(dx, dy) for dx in range(-2, 3) for dy in range(-2, 3) if math.gcd(dx, dy) == 1 and (dy, dx) > (0, 0)]


class Clearance(NamedTuple):
    """Distances of a robot's centre from obstacles, m: the least allowed, and beyond which more has no advantage."""

    least_m: float
    preferred_m: float


class Ways(NamedTuple):
    """What :func:`fullswarm.agent.navigation.route.follow` needs of a field.

    `x`, `y`, `clear_m`: (m,) the nodes and their clearance, m. `following`: (m,) the next node, `NOWHERE` at the goal
    and where no way leads there; `way_clear_m`: (m,) the least clearance on the way to it, exact below the preferred
    one. `cost_m`, `length_m`: (m,) to the goal, m. `gate`: (m,) which passage is crossed on
    the way to the next node: its place in `Passages` plus 1, negative against its axis, 0 for none. `first`: (cells +
    1,), `nodes`: the nodes in cell c are ``nodes[first[c]:first[c + 1]]``. `obstacles`: (k, 6) with the edges.
    `passages`: (p, 6) as the columns of :class:`Passages`.
    """

    x: Array
    y: Array
    clear_m: Array
    following: Index
    way_clear_m: Array
    cost_m: Array
    length_m: Array
    gate: Index
    first: Index
    nodes: Index
    obstacles: Array
    passages: Array


class Grid(NamedTuple):
    """Where the cells lie: the lower left corner and size in m, columns and rows."""

    x_min: float
    y_min: float
    cell_m: float
    columns: int
    rows: int


@dataclass(frozen=True, slots=True)
class Roadmap:
    """The graph of ways on a map.

    Attributes
    ----------
    points : (m, 2) m, the nodes
    clear_m : (m,) their distance from the nearest obstacle, `SPAN_M` at most
    start, end, weight_m : (e,) the edges, each once
    """

    grid: Grid
    clearance: Clearance
    obstacles: Array
    passages: Passages
    points: Array
    clear_m: Array
    start: Index
    end: Index
    weight_m: Array
    first: Index
    nodes: Index


@kernel
def way_from(
    x: float, y: float, node_x: Array, node_y: Array, length_m: Array, first: Index, nodes: Index, x_min: float,
    y_min: float, cell_m: float, columns: int, rows: int,
) -> float:  # fmt: skip
    """Return the length of the shortest way from (x, y) by a node in the cells around it, m; inf: there is none."""
    row = int(math.floor((y - y_min) / cell_m))
    column = int(math.floor((x - x_min) / cell_m))
    shortest_m = math.inf
    for each in range(max(0, row - 1), min(rows, row + 2)):
        low = first[each * columns + min(max(0, column - 1), columns)]
        high = first[each * columns + max(min(columns - 1, column + 1), -1) + 1]
        for place in range(low, high):
            node = nodes[place]
            shortest_m = min(shortest_m, length_m[node] + math.hypot(node_x[node] - x, node_y[node] - y))
    return shortest_m


@dataclass(frozen=True, slots=True)
class Field:
    """The ways to one goal.

    Attributes
    ----------
    goal_m : where they end: the goal, or the node nearest to it where it is too near an obstacle
    short_m : by how much they end short of the goal
    """

    grid: Grid
    preferred_m: float
    goal_m: tuple[float, float]
    short_m: float
    ways: Ways

    def way_m(self, x: float, y: float) -> float:
        """Return how long the way from a place to the goal is; infinite where no way is known."""
        ways = self.ways
        return way_from.run(x, y, ways.x, ways.y, ways.length_m, ways.first, ways.nodes, *self.grid)


def build_roadmap(obstacles: Array, bounds_m: Bounds, clearance: Clearance) -> Roadmap:
    """Return the graph of ways around `obstacles` (k, 6) within the arena.

    Raises
    ------
    MissingExtra
        SciPy is not installed: a robot that does not navigate needs none.
    """
    try:
        import scipy.sparse.csgraph
        import scipy.spatial  # noqa: F401  (slow to load: here, where it is not yet urgent)
    except ImportError as error:
        raise MissingExtra("navigating needs SciPy", hint="pip install 'fullswarm[core]'") from error
    x_min, y_min, x_max, y_max = bounds_m
    cell_m = max(CELL_M, math.sqrt((x_max - x_min) * (y_max - y_min) / MOST_CELLS))
    columns, rows = (max(1, round((high - low) / cell_m)) for low, high in ((x_min, x_max), (y_min, y_max)))
    grid, solid = Grid(x_min, y_min, cell_m, columns, rows), with_edges(obstacles, bounds_m)
    x, y = np.meshgrid(x_min + (np.arange(columns) + 0.5) * cell_m, y_min + (np.arange(rows) + 0.5) * cell_m)
    centres = np.column_stack([x.ravel(), y.ravel()])
    centre_clear_m = gaps(centres, solid, SPAN_M)
    number = np.full(rows * columns, -1, np.int64)
    cells = np.flatnonzero(centre_clear_m >= clearance.least_m)
    number[cells] = np.arange(len(cells))
    passages = find(solid)
    axes = _axis_points(passages, solid, clearance.least_m)
    points = np.vstack([centres[cells], axes])
    clear_m = np.concatenate([centre_clear_m[cells], gaps(axes, solid, SPAN_M)])
    start, end = _grid_edges(number.reshape(rows, columns))
    more_start, more_end = _links(points, len(cells))
    start, end = np.concatenate([start, more_start]), np.concatenate([end, more_end])
    length_m = np.hypot(*(points[end] - points[start]).T)
    fits = _way_clearances(points, clear_m, start, end, length_m, clearance.least_m, solid) >= clearance.least_m
    start, end, length_m = start[fits], end[fits], length_m[fits]
    cell = _cells(points, grid)
    first = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=columns * rows))]).astype(np.int64)
    nodes = np.argsort(cell, kind="stable").astype(np.int64)
    weight_m = length_m * _cost(np.minimum(clear_m[start], clear_m[end]), clearance)
    return Roadmap(grid, clearance, solid, passages, points, clear_m, start, end, weight_m, first, nodes)


def _cost(clear_m: Array, clearance: Clearance) -> Array:
    span_m = clearance.preferred_m - clearance.least_m
    if span_m <= 0.0:
        return np.ones(len(clear_m))
    share = np.clip((clearance.preferred_m - clear_m) / span_m, 0.0, 1.0)
    return 1.0 + (TIGHT_COST - 1.0) * share


def _axis_points(passages: Passages, solid: Array, least_m: float) -> Array:
    """Return free points (a, 2) on the axes of narrow passages, and where the axes cross."""
    places = [np.zeros((0, 2))]
    rows = np.flatnonzero((passages.width_m >= 2.0 * least_m) & (passages.width_m < AXIS_WIDEST_M))
    for row in rows.tolist():
        reach_m = float(passages.half_m[row]) + APPROACH_M
        along = np.linspace(-reach_m, reach_m, 2 * math.ceil(reach_m / AXIS_STEP_M) + 1)
        x, y = passages.x[row] + along * passages.axis_x[row], passages.y[row] + along * passages.axis_y[row]
        places.append(np.column_stack([x, y]))
    points = np.vstack([*places, _crossings(passages, rows)])
    return points[gaps(points, solid, SPAN_M) >= least_m]


def _crossings(passages: Passages, rows: Index) -> Array:
    """Return where the axes of passages cross, (c, 2): the way around a bend between two of them leads there."""
    if len(rows) < 2:
        return np.zeros((0, 2))
    one, other = (rows[each] for each in np.triu_indices(len(rows), 1))
    dx, dy = passages.x[other] - passages.x[one], passages.y[other] - passages.y[one]
    ax, ay, bx, by = passages.axis_x[one], passages.axis_y[one], passages.axis_x[other], passages.axis_y[other]
    across = ax * by - ay * bx
    square = np.abs(across) > 0.2
    divisor = np.where(square, across, 1.0)
    along_one, along_other = (dx * by - dy * bx) / divisor, (dx * ay - dy * ax) / divisor
    near = square & (np.abs(along_one) < passages.half_m[one] + APPROACH_M)
    near &= np.abs(along_other) < passages.half_m[other] + APPROACH_M
    return np.column_stack([passages.x[one] + along_one * ax, passages.y[one] + along_one * ay])[near]


def _grid_edges(number: Index) -> tuple[Index, Index]:
    """Return the pairs of free cells one or two cells apart; `number` (rows, columns) of each, -1 where it is none."""
    rows, columns = number.shape
    starts, ends = [], []
    for dx, dy in _STEPS:
        here = number[max(0, -dy) : rows - max(0, dy), max(0, -dx) : columns - max(0, dx)]
        there = number[max(0, dy) : rows - max(0, -dy), max(0, dx) : columns - max(0, -dx)]
        both = (here >= 0) & (there >= 0)
        starts.append(here[both])
        ends.append(there[both])
    return np.concatenate(starts), np.concatenate(ends)


def _links(points: Array, cells: int) -> tuple[Index, Index]:
    """Return the pairs of points on axes, the nodes from `cells` on, and other nodes near them."""
    axes = points[cells:]
    if not len(axes):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    from scipy.spatial import cKDTree

    near = cKDTree(axes).sparse_distance_matrix(cKDTree(points), LINK_M, output_type="coo_matrix")
    start, end = near.row.astype(np.int64) + cells, near.col.astype(np.int64)
    once = end < start
    return start[once], end[once]


def _cells(points: Array, grid: Grid) -> Index:
    """Return in which cell each point (p, 2) lies, row by row, (p,); outside the grid the nearest one counts."""
    column = np.clip(np.floor((points[:, 0] - grid.x_min) / grid.cell_m), 0, grid.columns - 1)
    row = np.clip(np.floor((points[:, 1] - grid.y_min) / grid.cell_m), 0, grid.rows - 1)
    cells: Index = (row * grid.columns + column).astype(np.int64)
    return cells


def build_field(roadmap: Roadmap, goal: tuple[float, float]) -> Field:
    """Return the ways to `goal`."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import dijkstra

    clearance, solid = roadmap.clearance, roadmap.obstacles
    there = np.array([goal], float)
    goal_clear_m = float(gaps(there, solid, SPAN_M)[0])
    short_m, count = 0.0, len(roadmap.points)
    if goal_clear_m < clearance.least_m and count:
        away_m = np.hypot(*(roadmap.points - there[0]).T)
        nearest = int(np.argmin(away_m))
        there, short_m, goal_clear_m = (
            roadmap.points[[nearest]],
            float(away_m[nearest]),
            float(roadmap.clear_m[nearest]),
        )
    points, clear_m = np.vstack([roadmap.points, there]), np.append(roadmap.clear_m, goal_clear_m)
    near = np.flatnonzero(np.hypot(*(roadmap.points - there[0]).T) < 2.0 * roadmap.grid.cell_m)
    near = near[free_ways(points[near], np.repeat(there, len(near), axis=0), clearance.least_m, solid)]
    link_m = np.hypot(*(points[near] - there[0]).T) * _cost(np.minimum(clear_m[near], goal_clear_m), clearance)
    start = np.concatenate([roadmap.start, near])
    end = np.concatenate([roadmap.end, np.full(len(near), count)])
    # A weight of zero would be no edge: a node may lie on the goal.
    weight_m = np.maximum(np.concatenate([roadmap.weight_m, link_m]), 1e-6)
    graph = csr_array((weight_m, (start, end)), shape=(count + 1, count + 1))
    cost_m, before = dijkstra(graph, directed=False, indices=count, return_predecessors=True)
    following = np.where(before >= 0, before, NOWHERE).astype(np.int64)
    length_m = _lengths(points, following, cost_m)
    going = np.flatnonzero(following >= 0)
    then = following[going]
    way_clear_m = clear_m.copy()
    way_clear_m[going] = _way_clearances(
        points, clear_m, going, then, np.hypot(*(points[then] - points[going]).T), clearance.preferred_m, solid
    )
    ways = Ways(
        np.ascontiguousarray(points[:, 0]), np.ascontiguousarray(points[:, 1]), clear_m, following,
        way_clear_m, cost_m, length_m,
        _gates(points, following, roadmap.passages), *_with_goal(roadmap, there[0]), solid,
        np.column_stack(roadmap.passages),
    )  # fmt: skip
    end_m = (float(there[0, 0]), float(there[0, 1]))
    return Field(roadmap.grid, clearance.preferred_m, end_m, short_m, ways)


def _with_goal(roadmap: Roadmap, goal: Array) -> tuple[Index, Index]:
    """Return the nodes by cell with the goal, the last node, among them."""
    cell = int(_cells(goal[None], roadmap.grid)[0])
    first = roadmap.first.copy()
    nodes = np.insert(roadmap.nodes, int(first[cell + 1]), len(roadmap.points))
    first[cell + 1 :] += 1
    return first, nodes


def _way_clearances(
    points: Array, clear_m: Array, start: Index, end: Index, length_m: Array, exact_m: float, solid: Array
) -> Array:
    """Return the least clearance on straight ways between nodes, (w,) m; exact below `exact_m`."""
    # Clearance falls by a metre per metre at most, so most ways need no closer look.
    found_m: Array = 0.5 * (clear_m[start] + clear_m[end] - length_m)
    near = np.flatnonzero(found_m < exact_m)
    found_m[near] = way_gaps(points[start[near]], points[end[near]], solid, exact_m)
    return found_m


def _lengths(points: Array, following: Index, cost_m: Array) -> Array:
    """Return the lengths of the ways from the nodes to the goal, (m,) m, by pointer doubling."""
    jump = np.where(following >= 0, following, np.arange(len(following)))
    length_m: NDArray[np.float64] = np.hypot(*(points - points[jump]).T)
    while True:
        further = jump[jump]
        if (further == jump).all():
            return np.where(np.isfinite(cost_m), length_m, math.inf)
        length_m = length_m + length_m[jump]
        jump = further


def _gates(points: Array, following: Index, passages: Passages) -> Index:
    """Return which passage's middle is crossed between each node and the next, see :class:`Ways`."""
    gate = np.zeros(len(points), np.int64)
    going = np.flatnonzero(following >= 0)
    x, y = points[going].T
    for row in range(len(passages.x) - 1, -1, -1):  # the narrowest last: it counts where two are crossed at once
        middle_x, middle_y, width_m = passages.x[row], passages.y[row], passages.width_m[row]
        near = (np.abs(x - middle_x) < width_m + 1.0) & (np.abs(y - middle_y) < width_m + 1.0)
        rows = going[near]
        offset = points[rows] - (middle_x, middle_y)
        further = points[following[rows]] - (middle_x, middle_y)
        axis = np.array([passages.axis_x[row], passages.axis_y[row]])
        before, after = offset @ axis, further @ axis
        part = np.divide(before, before - after, out=np.zeros(len(rows)), where=before != after)
        across = (offset + part[:, None] * (further - offset)) @ np.array([-axis[1], axis[0]])
        crossed = ((before < 0.0) != (after < 0.0)) & (np.abs(across) < 0.5 * width_m)
        gate[rows[crossed]] = np.where(after[crossed] > before[crossed], row + 1, -row - 1)
    return gate
