"""The world's boxes and walls as rows of numbers, for the engines and for whoever looks for a free place."""

from __future__ import annotations

import numpy as np

from fullswarm.config import WorldConfig
from fullswarm.kernels import Array

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
