"""Keeps the roadmaps and fields that are in use, leads ways around robots that stand, and says why there is no way.

A roadmap belongs to a map and a body, a field to a goal on it: robots with one goal share both. Building is the only
slow part, some 10 ms for 10,000 cells, and happens once for each map, goal and robot that stands in a passage.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import TypeVar

import numpy as np

from fullswarm.agent.navigation.geometry import Bounds, gaps, way_gaps
from fullswarm.agent.navigation.passages import WIDEST_M
from fullswarm.agent.navigation.roadmap import SPAN_M, Clearance, Field, Roadmap, build_field, build_roadmap
from fullswarm.kernels import Array, Flags
from fullswarm.reasons import Code, Reason, reason

T = TypeVar("T")

ROADMAPS, FIELDS, ANSWERS = 24, 128, 64
THINNEST_M = 0.01
"""Ways narrower than twice this are not looked for when a robot asks how wide the widest one is."""

_roadmaps: OrderedDict[Hashable, Roadmap] = OrderedDict()
_fields: OrderedDict[Hashable, Field] = OrderedDict()
_answers: OrderedDict[Hashable, float] = OrderedDict()
_recent: dict[tuple[int, tuple[float, float], Clearance], tuple[Array, Bounds, Field]] = {}
_standing: OrderedDict[Hashable, Array] = OrderedDict()


def roadmap_of(obstacles: Array, bounds_m: Bounds, clearance: Clearance) -> Roadmap:
    """Return the roadmap of a map (k, 6); the newest few are kept."""
    key = obstacles.tobytes(), bounds_m, clearance
    return _kept(_roadmaps, key, ROADMAPS, lambda: build_roadmap(obstacles, bounds_m, clearance))


def field_of(goal: tuple[float, float], obstacles: Array, bounds_m: Bounds, clearance: Clearance) -> Field:
    """Return the ways to a goal on a map (k, 6); the newest few are kept."""
    # A robot asks with the same array in each period, and a thousand robots do: its content is compared once.
    same = id(obstacles), goal, clearance
    recent = _recent.get(same)
    if recent is not None and recent[0] is obstacles and recent[1] == bounds_m:
        return recent[2]
    key = goal, obstacles.tobytes(), bounds_m, clearance
    field = _kept(_fields, key, FIELDS, lambda: build_field(roadmap_of(obstacles, bounds_m, clearance), goal))
    if len(_recent) >= FIELDS:
        _recent.clear()
    _recent[same] = obstacles, bounds_m, field
    return field


def _kept(shelf: OrderedDict[Hashable, T], key: Hashable, most: int, build: Callable[[], T]) -> T:
    found = shelf.get(key)
    if found is None:
        found = shelf[key] = build()
        while len(shelf) > most:
            shelf.popitem(last=False)
    else:
        shelf.move_to_end(key)
    return found


def in_passages(discs: Array, obstacles: Array, bounds_m: Bounds, clearance: Clearance) -> Array:
    """Return those of the robots (k, 6) that stand in a passage of a map: elsewhere the others drive around anyway."""
    key = discs.tobytes(), obstacles.tobytes(), bounds_m, clearance
    return _kept(_standing, key, FIELDS, lambda: discs[_inside(discs, roadmap_of(obstacles, bounds_m, clearance))])


def _inside(discs: Array, roadmap: Roadmap) -> Flags:
    passages = roadmap.passages
    found = np.zeros(len(discs), bool)
    for row in range(len(passages.x)):
        dx, dy = discs[:, 0] - passages.x[row], discs[:, 1] - passages.y[row]
        along = passages.axis_x[row] * dx + passages.axis_y[row] * dy
        across = -passages.axis_y[row] * dx + passages.axis_x[row] * dy
        reach_m = passages.half_m[row] + discs[:, 5]
        found |= (np.abs(along) < reach_m + 0.3) & (np.abs(across) < 0.5 * passages.width_m[row] + discs[:, 5])
    return found


def no_way(x: float, y: float, goal: tuple[float, float], obstacles: Array, bounds_m: Bounds, least_m: float) -> Reason:
    """Return why there is no way from (x, y) to a goal, with the width that is needed and the widest that there is."""
    key = round(x, 1), round(y, 1), goal, obstacles.tobytes(), bounds_m
    widest_m = _kept(_answers, key, ANSWERS, lambda: widest_way_m((x, y), goal, obstacles, bounds_m))
    return reason(
        Code.NO_WAY, goal=_place(goal), needed_m=f"{2.0 * least_m:.2f}", widest_m=f"{min(widest_m, 2 * least_m):.2f}"
    )  # fmt: skip


def goal_closed(goal: tuple[float, float], obstacles: Array, least_m: float) -> Reason:
    """Return that a goal is too near an obstacle; `obstacles` with the edges."""
    available_m = max(0.0, float(gaps(np.array([goal]), obstacles, WIDEST_M)[0]))
    return reason(
        Code.GOAL_CLOSED, goal=_place(goal), needed_m=f"{least_m:.2f}", available_m=f"{available_m:.2f}"
    )  # fmt: skip


def widest_way_m(start: tuple[float, float], goal: tuple[float, float], obstacles: Array, bounds_m: Bounds) -> float:
    """Return the width of the widest way between two places, m; 0 where none is wider than `THINNEST_M`.

    On a maximum spanning tree of the clearances the way between two nodes is the widest one.
    """
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

    thin = build_roadmap(obstacles, bounds_m, Clearance(THINNEST_M, THINNEST_M))
    if not len(thin.points) or not len(thin.start):
        return 0.0
    from_node, to_node = (int(np.argmin(np.hypot(*(thin.points - place).T))) for place in (start, goal))
    edge_m = way_gaps(thin.points[thin.start], thin.points[thin.end], thin.obstacles, SPAN_M)
    narrowness = 1.0 + SPAN_M - edge_m
    count = len(thin.points)
    tree = minimum_spanning_tree(csr_array((narrowness, (thin.start, thin.end)), shape=(count, count)))
    _, before = breadth_first_order(tree, to_node, directed=False)
    way = [from_node]
    while way[-1] != to_node:
        if before[way[-1]] < 0:
            return 0.0
        way.append(int(before[way[-1]]))
    points = thin.points[way]
    return 2.0 * float(way_gaps(points[:-1], points[1:], thin.obstacles, SPAN_M).min(initial=SPAN_M))


def _place(point: tuple[float, float]) -> str:
    return f"({point[0]:.2f}, {point[1]:.2f})" if all(math.isfinite(each) for each in point) else str(point)
