"""Finds the passages of a map: places where two obstacles leave a gap between them.

The nearest points of two convex obstacles lie on two parallel lines, square to the gap, and each obstacle lies behind
its own: between the lines there is a free strip as wide as the gap. The middle of the strip is the passage's axis, on
which the clearance from both is half the width, however thick they are. Every bottleneck of a map of convex obstacles
is such a gap, because there the nearest obstacle points lie opposite each other.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fullswarm.agent.navigation.geometry import gaps
from fullswarm.kernels import Array, Index

WIDEST_M = 2.5
"""Wider gaps are open ground."""
SAME_M = 0.05
"""Passages whose middles are so near each other, with one direction, are one."""


class Passages(NamedTuple):
    """The passages of a map, (p,) each.

    `x`, `y`: the middle; `axis_x`, `axis_y`: unit vector along it, the one that points to +x, or to +y; `half_m`: half
    the length over which the two obstacles face each other, 0 for two corners; `width_m`.
    """

    x: Array
    y: Array
    axis_x: Array
    axis_y: Array
    half_m: Array
    width_m: Array


NO_PASSAGES = Passages(*(np.zeros(0) for _ in Passages._fields))


def find(obstacles: Array, widest_m: float = WIDEST_M) -> Passages:
    """Return the passages between obstacles (k, 6) that no third one closes, the narrowest first."""
    first, second = _near_pairs(obstacles, widest_m)
    if not len(first):
        return NO_PASSAGES
    corners = _corners(obstacles)
    one, other, distance_m = _nearest_points(obstacles, corners, first, second)
    width_m = distance_m - obstacles[first, 5] - obstacles[second, 5]
    keep = np.flatnonzero((width_m > 1e-3) & (width_m < widest_m) & (distance_m > 1e-9))
    first, second, one, other, width_m = first[keep], second[keep], one[keep], other[keep], width_m[keep]
    normal = (other - one) / distance_m[keep, None]
    axis = np.column_stack([-normal[:, 1], normal[:, 0]])
    flip = (axis[:, 0] < -1e-9) | ((np.abs(axis[:, 0]) <= 1e-9) & (axis[:, 1] < 0.0))
    axis[flip] *= -1.0
    low, high = _facing(corners[first], corners[second], normal, axis, one)
    middle = one + normal * (obstacles[first, 5] + 0.5 * width_m)[:, None] + axis * (0.5 * (low + high))[:, None]
    # A third obstacle in the gap makes two narrower ones of it, or closes it.
    open_ = gaps(middle, obstacles, widest_m) >= 0.5 * width_m - 1e-3
    order = np.flatnonzero(open_)[np.argsort(width_m[open_], kind="stable")]
    chosen = _distinct(middle[order], axis[order])
    kept = order[chosen]
    half_m = 0.5 * (high - low)
    return Passages(
        middle[kept, 0], middle[kept, 1], axis[kept, 0], axis[kept, 1], half_m[kept], width_m[kept]
    )  # fmt: skip


def _near_pairs(obstacles: Array, widest_m: float) -> tuple[Index, Index]:
    """Return the pairs whose bounding boxes are nearer than the widest passage."""
    c, s = np.abs(np.cos(obstacles[:, 4])), np.abs(np.sin(obstacles[:, 4]))
    half_x = c * obstacles[:, 2] + s * obstacles[:, 3] + obstacles[:, 5]
    half_y = s * obstacles[:, 2] + c * obstacles[:, 3] + obstacles[:, 5]
    firsts, seconds = [], []
    for row in range(len(obstacles) - 1):
        rest = slice(row + 1, None)
        apart_x = np.abs(obstacles[rest, 0] - obstacles[row, 0]) - half_x[rest] - half_x[row]
        apart_y = np.abs(obstacles[rest, 1] - obstacles[row, 1]) - half_y[rest] - half_y[row]
        near = np.flatnonzero(np.hypot(np.maximum(apart_x, 0.0), np.maximum(apart_y, 0.0)) < widest_m)
        firsts.append(np.full(len(near), row, np.int64))
        seconds.append(near.astype(np.int64) + row + 1)
    if not firsts:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.concatenate(firsts), np.concatenate(seconds)


def _corners(obstacles: Array) -> Array:
    """Return the corners of the boxes without their rounding, (k, 4, 2)."""
    signs = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, 1.0], [-1.0, -1.0]])
    local = signs[None] * obstacles[:, None, 2:4]
    c, s = np.cos(obstacles[:, 4])[:, None], np.sin(obstacles[:, 4])[:, None]
    x, y = local[..., 0], local[..., 1]
    return np.stack([obstacles[:, 0, None] + c * x - s * y, obstacles[:, 1, None] + s * x + c * y], axis=-1)


def _nearest_points(obstacles: Array, corners: Array, first: Index, second: Index) -> tuple[Array, Array, Array]:
    """Return the nearest points of pairs of boxes, (q, 2) each, and their distance (q,): one of them is a corner."""
    best_one = np.zeros((len(first), 2))
    best_other = np.zeros((len(first), 2))
    best_m = np.full(len(first), math.inf)
    for here, there, swapped in ((first, second, False), (second, first, True)):
        c, s = np.cos(obstacles[there, 4]), np.sin(obstacles[there, 4])
        for corner in range(4):
            point = corners[here, corner]
            dx, dy = (point - obstacles[there, :2]).T
            near_x = np.clip(c * dx + s * dy, -obstacles[there, 2], obstacles[there, 2])
            near_y = np.clip(-s * dx + c * dy, -obstacles[there, 3], obstacles[there, 3])
            nearest = obstacles[there, :2] + np.column_stack([c * near_x - s * near_y, s * near_x + c * near_y])
            distance_m = np.hypot(*(point - nearest).T)
            better = distance_m < best_m - 1e-12
            best_m = np.where(better, distance_m, best_m)
            one, other = (nearest, point) if swapped else (point, nearest)
            best_one = np.where(better[:, None], one, best_one)
            best_other = np.where(better[:, None], other, best_other)
    return best_one, best_other, best_m


def _facing(first: Array, second: Array, normal: Array, axis: Array, origin: Array) -> tuple[Array, Array]:
    """Return between which places along the axis, counted from `origin`, both obstacles border the strip, (q,) each."""

    def support(corners: Array, towards: Array) -> tuple[Array, Array]:
        reach = np.einsum("qcd,qd->qc", corners, towards)
        along = np.einsum("qcd,qd->qc", corners - origin[:, None], axis)
        front = reach >= reach.max(axis=1, keepdims=True) - 1e-6
        return np.where(front, along, math.inf).min(axis=1), np.where(front, along, -math.inf).max(axis=1)

    low_one, high_one = support(first, normal)
    low_other, high_other = support(second, -normal)
    low, high = np.maximum(low_one, low_other), np.minimum(high_one, high_other)
    middle = 0.5 * (low + high)
    return np.where(low <= high, low, middle), np.where(low <= high, high, middle)


def _distinct(middle: Array, axis: Array) -> list[int]:
    """Return the places of passages of which none is another one again: walls may be made of boxes that overlap."""
    chosen: list[int] = []
    for row in range(len(middle)):
        near = np.hypot(*(middle[chosen] - middle[row]).T) < SAME_M if chosen else np.zeros(0, bool)
        if not (near & (np.abs(axis[chosen] @ axis[row]) > 0.99)).any():
            chosen.append(row)
    return chosen
