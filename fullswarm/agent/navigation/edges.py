"""Keeps control laws off the edge of the arena: how near each robot is to it, and which way is inwards."""

from __future__ import annotations

import numpy as np

from fullswarm.kernels import Array


def inwards(position: Array, bounds_m: tuple[float, float, float, float], reach_m: Array) -> Array:
    """Return a push off the edges, (n, 2): per edge 0 at the distance `reach_m` (n, 1) or more, and 1 at the edge."""
    low, high = position - np.array(bounds_m[:2]), np.array(bounds_m[2:]) - position
    near = np.maximum(reach_m, 1e-6)
    push: Array = np.clip(1.0 - low / near, 0.0, 1.0) - np.clip(1.0 - high / near, 0.0, 1.0)
    return push
