"""The robust certificate for differential drives under its older name, with that function's defaults."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fullswarm.kernels import Array
from fullswarm.robotarium.utilities.barrier_certificates import create_unicycle_differential_drive_barrier_certificate

__all__ = ["create_robust_barriers", "np"]


def create_robust_barriers(
    max_num_obstacles: int = 100,
    max_num_robots: int = 30,
    d: float = 5,
    wheel_vel_limit: float = 12.5,
    base_length: float = 0.105,
    wheel_radius: float = 0.016,
    projection_distance: float = 0.05,
    gamma: float = 150,
    safety_radius: float = 0.12,
) -> Callable[..., Array]:
    """Return :func:`~.barrier_certificates.create_unicycle_differential_drive_barrier_certificate` of these values."""
    return create_unicycle_differential_drive_barrier_certificate(
        max_num_obstacles, max_num_robots, d, wheel_vel_limit, base_length, wheel_radius, projection_distance, gamma,
        safety_radius,
    )  # fmt: skip
