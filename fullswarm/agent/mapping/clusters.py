"""Groups the points of a scan that lie side by side, and encloses those that have moved in a disc.

A person's legs, a cart or a robot without an agent show an arc of points. A disc is fitted to it (Kåsa, *A circle
fitting procedure and its error analysis*, 1976); where the arc is too short for that, the disc holds the points.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from fullswarm.kernels import Array, Flags, Index

GAP_M = 0.12
"""Points of neighbouring rays that are so near each other belong together, at any distance."""
WIDEST_M = 1.2
"""What is wider is no body that moves by itself."""
SMALLEST_M, LARGEST_M = 0.08, 0.6
"""Radii of bodies."""
MOVED_SHARE = 0.5
"""So many of the points of a group must have appeared where all was free."""
SAME_M = 0.25
"""Two bodies whose middles are so near each other are one, seen by two robots."""


def groups(points: Array, order: Index) -> list[slice]:
    """Return which points (k, 2), in the order of their rays, belong together.

    Parameters
    ----------
    order : (k,) the number of each point's ray: a ray without a point in between parts no group, three do
    """
    if not len(points):
        return []
    apart = np.hypot(*np.diff(points, axis=0).T) > GAP_M
    apart |= np.diff(order) > 3
    edges = [0, *(np.flatnonzero(apart) + 1).tolist(), len(points)]
    return [slice(first, last) for first, last in pairwise(edges)]


def moving_bodies(origin: Array, points: Array, order: Index, appeared: Flags) -> tuple[Array, Flags]:
    """Return discs (k, 3) x, y, radius in m around the groups of points that have moved, and which points those are.

    Parameters
    ----------
    origin : (2,) m, the sensor
    points, order : see :func:`groups`
    appeared : (k,) which points lie where all was free before
    """
    found = []
    moved = np.zeros(len(points), bool)
    for group in groups(points, order):
        count = group.stop - group.start
        if count < 2 or appeared[group].mean() < MOVED_SHARE:
            continue
        part = points[group]
        if math.hypot(*np.ptp(part, axis=0)) <= WIDEST_M:
            found.append(disc_around(origin, part))
            moved[group] = True
    return np.array(found, float).reshape(-1, 3), moved


def disc_around(origin: Array, points: Array) -> tuple[float, float, float]:
    """Return x, y, radius in m of a disc of which the points (k, 2) are the side towards `origin`."""
    fitted = _fitted(points)
    middle = points.mean(axis=0)
    if fitted is not None:
        x, y, radius = fitted
        # The middle of a body lies behind what is seen of it.
        behind = math.hypot(x - origin[0], y - origin[1]) > math.hypot(*(middle - origin))
        if SMALLEST_M <= radius <= LARGEST_M and behind:
            return x, y, radius
    width_m = math.hypot(*(points[-1] - points[0]))
    radius = min(max(0.5 * width_m + 0.02, SMALLEST_M), LARGEST_M)
    way = middle - origin
    way /= max(math.hypot(*way), 1e-9)
    x, y = (middle + 0.5 * radius * way).tolist()
    radius = max(radius, float(np.hypot(*(points - (x, y)).T).max()))
    return x, y, radius


def _fitted(points: Array) -> tuple[float, float, float] | None:
    """Return the circle with the least algebraic error; None where the points do not determine one."""
    if len(points) < 5:
        return None
    middle = points.mean(axis=0)
    x, y = (points - middle).T
    matrix = np.column_stack([2.0 * x, 2.0 * y, np.ones(len(x))])
    solution, _, rank, _ = np.linalg.lstsq(matrix, x * x + y * y, rcond=None)
    if rank < 3:
        return None
    square = solution[2] + solution[0] ** 2 + solution[1] ** 2
    if not square > 0.0:
        return None
    return float(solution[0] + middle[0]), float(solution[1] + middle[1]), math.sqrt(square)


def merged(bodies: Array) -> Array:
    """Return discs (k, 3) with those that are one body seen twice joined: in the middle, with the greater radius."""
    left = bodies.tolist()
    found: list[list[float]] = []
    for x, y, radius in left:
        same = next((each for each in found if math.hypot(each[0] - x, each[1] - y) < SAME_M), None)
        if same is None:
            found.append([x, y, radius, 1.0])
            continue
        same[3] += 1.0
        same[0] += (x - same[0]) / same[3]
        same[1] += (y - same[1]) / same[3]
        same[2] = max(same[2], radius)
    return np.array([each[:3] for each in found], float).reshape(-1, 3)
