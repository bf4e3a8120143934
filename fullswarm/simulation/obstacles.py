"""Represents the boxes and walls of a world as rows of numbers, and measures the distance of a point to one."""

from __future__ import annotations

import math

import numpy as np

from fullswarm.config import WorldConfig
from fullswarm.kernels import Array, kernel

WALL_HALF_M = 0.5
"""Half thickness of an arena wall; its inner face lies on the bound."""


def static_obstacles(config: WorldConfig) -> Array:
    """Return boxes, then the four walls, as rows of ``Reading.obstacles``, shape (k, 6)."""
    rows = [(x, y, size_x / 2, size_y / 2, yaw, 0.0) for x, y, size_x, size_y, yaw in config.boxes]
    if config.walls:
        x_min, y_min, x_max, y_max = config.bounds_m
        middle_x, middle_y = (x_min + x_max) / 2, (y_min + y_max) / 2
        half_x, half_y = (x_max - x_min) / 2, (y_max - y_min) / 2 + 2 * WALL_HALF_M
        rows += [
            (x_min - WALL_HALF_M, middle_y, WALL_HALF_M, half_y, 0.0, 0.0),
            (x_max + WALL_HALF_M, middle_y, WALL_HALF_M, half_y, 0.0, 0.0),
            (middle_x, y_min - WALL_HALF_M, half_x, WALL_HALF_M, 0.0, 0.0),
            (middle_x, y_max + WALL_HALF_M, half_x, WALL_HALF_M, 0.0, 0.0),
        ]
    return np.array(rows, dtype=float).reshape(-1, 6)


def with_trigonometry(obstacles: Array) -> Array:
    """Return (k, 8): centre, half sizes, cos and sin of the yaw, corner radius, radius of the enclosing disc."""
    x, y, half_x, half_y, yaw, corner = obstacles.T
    reach = np.hypot(half_x, half_y) + corner
    return np.ascontiguousarray(np.stack([x, y, half_x, half_y, np.cos(yaw), np.sin(yaw), corner, reach], axis=1))


@kernel
def obstacle_gap(x: float, y: float, obstacles: Array, k: int) -> tuple[float, float, float]:
    """Return the distance of a point to obstacle `k` (< 0 inside) and the outward normal there (x, y)."""
    dx, dy = x - obstacles[k, 0], y - obstacles[k, 1]
    c, s = obstacles[k, 4], obstacles[k, 5]
    local_x, local_y = c * dx + s * dy, c * dy - s * dx
    half_x, half_y, corner = obstacles[k, 2], obstacles[k, 3], obstacles[k, 6]
    off_x = local_x - max(-half_x, min(half_x, local_x))
    off_y = local_y - max(-half_y, min(half_y, local_y))
    gap = math.sqrt(off_x * off_x + off_y * off_y)
    if gap > 0.0:
        nx, ny = off_x / gap, off_y / gap
    else:  # inside: out through the nearest side
        deep_x, deep_y = half_x - abs(local_x), half_y - abs(local_y)
        gap = -min(deep_x, deep_y)
        nx, ny = 0.0, 0.0
        if deep_x < deep_y:
            nx = 1.0 if local_x >= 0.0 else -1.0
        else:
            ny = 1.0 if local_y >= 0.0 else -1.0
    return gap - corner, c * nx - s * ny, s * nx + c * ny
