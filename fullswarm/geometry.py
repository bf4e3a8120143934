"""Angles, the unicycle map and frame changes. ENU, x forward, radians in [-π, π], counter-clockwise positive."""

from __future__ import annotations

import math

from fullswarm.kernels import kernel


@kernel
def wrap(angle_rad: float) -> float:
    """Wrap an angle to [-π, π] (the paper's *wrapptopi*, III.A)."""
    return math.atan2(math.sin(angle_rad), math.cos(angle_rad))


@kernel
def unicycle(
    vx_m_s: float, vy_m_s: float, heading_rad: float, speed_gain: float, turn_gain_per_s: float
) -> tuple[float, float]:
    """Map a desired planar velocity to a unicycle's speed and turn rate (paper III.A).

    ``u_v = K_v bᵀṗ`` and ``u_w = K_w w`` with ``w = wrap(atan2(ṗ_y, ṗ_x) - θ)``. The paper prints a
    one-argument atan2; the two-argument one is meant, or a robot could not tell ahead from behind.
    A velocity of zero has no direction: the robot then stays instead of turning to heading 0.

    Returns
    -------
    tuple
        Speed in m/s (negative: the desired velocity points backwards) and turn rate in rad/s, neither capped.
    """
    speed = math.hypot(vx_m_s, vy_m_s)
    if speed < 1e-9:
        return 0.0, 0.0
    error = wrap(math.atan2(vy_m_s, vx_m_s) - heading_rad)
    return speed_gain * speed * math.cos(error), turn_gain_per_s * error


@kernel
def clamp(value: float, low: float, high: float) -> float:
    """Return `value` held within [low, high]; the paper's caps are ``clamp(u, -U_max, U_max)``.

    NaN stays NaN: with min and max it would become a limit, full speed.
    """
    if value > high:
        return high
    if value < low:
        return low
    return value
