"""Computes exact distances between points, straight ways and rounded boxes, one at a time and for many at once."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.safety.barrier import box_gap
from fullswarm.kernels import Array, Flags, kernel

OUTSIDE_M = 1000.0
"""Half thickness of the boxes that stand for the arena's edges."""

Bounds = tuple[float, float, float, float]


def with_edges(obstacles: Array, bounds_m: Bounds) -> Array:
    """Return obstacles (k, 6) and four boxes outside the arena's edges, (k + 4, 6): a robot stays inside."""
    x_min, y_min, x_max, y_max = bounds_m
    x, y = 0.5 * (x_min + x_max), 0.5 * (y_min + y_max)
    far_x, far_y = 0.5 * (x_max - x_min) + OUTSIDE_M, 0.5 * (y_max - y_min) + OUTSIDE_M
    half = 0.5 * OUTSIDE_M
    edges = [
        (x_min - half, y, half, far_y, 0.0, 0.0),
        (x, y_min - half, far_x, half, 0.0, 0.0),
        (x_max + half, y, half, far_y, 0.0, 0.0),
        (x, y_max + half, far_x, half, 0.0, 0.0),
    ]
    return np.vstack([obstacles.reshape(-1, 6), edges])


@kernel
def gap_to(x: float, y: float, obstacles: Array, most_m: float) -> float:
    """Return the distance from a point to the nearest of the obstacles (k, 6), `most_m` where all are farther."""
    nearest = most_m
    for row in range(obstacles.shape[0]):
        across = obstacles[row, 2] + obstacles[row, 3] + obstacles[row, 5] + nearest
        if math.fabs(obstacles[row, 0] - x) < across and math.fabs(obstacles[row, 1] - y) < across:
            nearest = min(nearest, box_gap(x, y, obstacles, row)[0])
    return nearest


@kernel
def crosses(x: float, y: float, dx: float, dy: float, half_x: float, half_y: float) -> bool:
    """Tell whether the segment from (x, y) by (dx, dy) enters the open rectangle of these half sizes around 0."""
    first = 0.0
    last = 1.0
    if math.fabs(dx) < 1e-12:
        if math.fabs(x) >= half_x:
            return False
    else:
        one = (-half_x - x) / dx
        other = (half_x - x) / dx
        first = max(first, min(one, other))
        last = min(last, max(one, other))
    if math.fabs(dy) < 1e-12:
        if math.fabs(y) >= half_y:
            return False
    else:
        one = (-half_y - y) / dy
        other = (half_y - y) / dy
        first = max(first, min(one, other))
        last = min(last, max(one, other))
    return first < last


@kernel
def is_free(x: float, y: float, to_x: float, to_y: float, clearance_m: float, obstacles: Array) -> bool:
    """Tell whether a straight way keeps `clearance_m` from all obstacles (k, 6), exactly.

    A rounded box grown by the clearance is the union of two rectangles and four discs.
    """
    dx = to_x - x
    dy = to_y - y
    length = math.hypot(dx, dy)
    middle_x = 0.5 * (x + to_x)
    middle_y = 0.5 * (y + to_y)
    for row in range(obstacles.shape[0]):
        half_x = obstacles[row, 2]
        half_y = obstacles[row, 3]
        reach = clearance_m + obstacles[row, 5]
        off_x = middle_x - obstacles[row, 0]
        off_y = middle_y - obstacles[row, 1]
        across = half_x + half_y + reach + 0.5 * length
        if math.fabs(off_x) >= across or math.fabs(off_y) >= across or reach <= 0.0:
            continue
        c = math.cos(obstacles[row, 4])
        s = math.sin(obstacles[row, 4])
        local_dx = c * dx + s * dy
        local_dy = -s * dx + c * dy
        local_x = c * off_x + s * off_y - 0.5 * local_dx
        local_y = -s * off_x + c * off_y - 0.5 * local_dy
        if crosses(local_x, local_y, local_dx, local_dy, half_x + reach, half_y):
            return False
        if crosses(local_x, local_y, local_dx, local_dy, half_x, half_y + reach):
            return False
        for corner in range(4):
            from_x = (half_x if corner < 2 else -half_x) - local_x
            from_y = (half_y if corner % 2 == 0 else -half_y) - local_y
            part = 0.0
            if length > 0.0:
                part = min(max((from_x * local_dx + from_y * local_dy) / (length * length), 0.0), 1.0)
            if math.hypot(from_x - part * local_dx, from_y - part * local_dy) < reach:
                return False
    return True


def gaps(points: Array, obstacles: Array, most_m: float) -> Array:
    """Return the distance from each point (p, 2) to the nearest obstacle, `most_m` where all are farther, (p,) m."""
    nearest = np.full(len(points), most_m)
    for x, y, half_x, half_y, yaw, corner_m in obstacles.tolist():
        across = math.hypot(half_x, half_y) + corner_m + most_m
        near = np.flatnonzero((np.abs(points[:, 0] - x) < across) & (np.abs(points[:, 1] - y) < across))
        if not len(near):
            continue
        local_x, local_y = _local(points[near] - (x, y), yaw)
        out_x, out_y = np.abs(local_x) - half_x, np.abs(local_y) - half_y
        outside = np.hypot(np.maximum(out_x, 0.0), np.maximum(out_y, 0.0))
        gap = np.where(outside > 0.0, outside, np.maximum(out_x, out_y)) - corner_m
        nearest[near] = np.minimum(nearest[near], gap)
    return nearest


def way_gaps(start: Array, end: Array, obstacles: Array, most_m: float) -> Array:
    """Return how near straight ways (w, 2) to (w, 2) come to an obstacle, `most_m` at most, (w,) m."""
    nearest = np.full(len(start), most_m)
    middle, reach_m = 0.5 * (start + end), 0.5 * np.hypot(*(end - start).T)
    for x, y, half_x, half_y, yaw, corner_m in obstacles.tolist():
        across = math.hypot(half_x, half_y) + corner_m + most_m + reach_m
        near = np.flatnonzero((np.abs(middle[:, 0] - x) < across) & (np.abs(middle[:, 1] - y) < across))
        if not len(near):
            continue
        ax, ay = _local(start[near] - (x, y), yaw)
        bx, by = _local(end[near] - (x, y), yaw)
        gap = np.minimum(_outside(ax, ay, half_x, half_y), _outside(bx, by, half_x, half_y))
        for corner_x in (half_x, -half_x):
            for corner_y in (half_y, -half_y):
                gap = np.minimum(gap, _off_segment(corner_x - ax, corner_y - ay, bx - ax, by - ay))
        gap[_cross(ax, ay, bx - ax, by - ay, half_x, half_y)] = 0.0
        nearest[near] = np.minimum(nearest[near], gap - corner_m)
    return nearest


def _outside(x: Array, y: Array, half_x: float, half_y: float) -> Array:
    return np.hypot(np.maximum(np.abs(x) - half_x, 0.0), np.maximum(np.abs(y) - half_y, 0.0))


def _off_segment(x: Array, y: Array, dx: Array, dy: Array) -> Array:
    """Return the distance of points from segments that go from 0 by (dx, dy)."""
    part = np.clip((x * dx + y * dy) / np.maximum(dx * dx + dy * dy, 1e-18), 0.0, 1.0)
    return np.hypot(x - part * dx, y - part * dy)


def free_ways(start: Array, end: Array, clearance_m: float, obstacles: Array) -> Flags:
    """Tell which straight ways (w, 2) to (w, 2) keep `clearance_m` from all obstacles: :func:`is_free` for many."""
    free: Flags = way_gaps(start, end, obstacles, clearance_m) >= clearance_m
    return free


def _local(offset: Array, yaw: float) -> tuple[Array, Array]:
    c, s = math.cos(yaw), math.sin(yaw)
    return c * offset[:, 0] + s * offset[:, 1], -s * offset[:, 0] + c * offset[:, 1]


def _cross(x: Array, y: Array, dx: Array, dy: Array, half_x: float, half_y: float) -> NDArray[np.bool_]:
    first_x, last_x = _within(x, dx, half_x)
    first_y, last_y = _within(y, dy, half_y)
    found: NDArray[np.bool_] = np.maximum(np.maximum(first_x, first_y), 0.0) < np.minimum(
        np.minimum(last_x, last_y), 1.0
    )
    return found


def _within(x: Array, dx: Array, half: float) -> tuple[Array, Array]:
    """Return between which shares of `dx` a coordinate is within ±`half`; an empty interval where it never is."""
    still = np.abs(dx) < 1e-12
    divisor = np.where(still, 1.0, dx)
    one, other = (-half - x) / divisor, (half - x) / divisor
    inside = np.abs(x) < half
    first = np.where(still, np.where(inside, -math.inf, math.inf), np.minimum(one, other))
    last = np.where(still, np.where(inside, math.inf, -math.inf), np.maximum(one, other))
    return first, last
