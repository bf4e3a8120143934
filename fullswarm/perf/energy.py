"""What driving costs: a proxy, the same for the true bodies and for what robots measure of themselves.

The motors give the kinetic energy that a robot gains (braking gives nothing back) and what rolling takes:

    E = sum of max(0, T(t + dt) - T(t)) + c m g (|v - w b| + |v + w b|) / 2 dt,   T = m v^2 / 2 + m r^2 w^2 / 4

with wheels at b = 0.75 r from the middle, a body like a homogeneous disc and c = 0.02 (small rubber wheels on a hard
floor). Motors' heat and electronics are left out: it compares behaviours, it sizes no battery.
"""

from __future__ import annotations

import math

from fullswarm.kernels import Array, kernel

MASS_KG = 3.6
"""A Create with its battery."""
GRAVITY_M_S2 = 9.81
ROLLING = 0.02
"""Rolling resistance over weight."""
WHEEL_RADII = 0.75
"""Where the wheels are, from the middle, in radii of the body."""


@kernel
def spend(twist: Array, radius: Array, mass: Array, energy: Array, dt_s: float) -> None:
    """Add what one period cost to `energy` (n, 2): joules so far; kinetic energy at the last call, NaN before it."""
    for i in range(twist.shape[0]):
        v, w = float(twist[i, 0]), float(twist[i, 1])
        if not (math.isfinite(v) and math.isfinite(w)):
            continue
        rim = radius[i] * w
        kinetic = mass[i] * (0.5 * v * v + 0.25 * rim * rim)
        gained = kinetic - energy[i, 1]
        if gained > 0.0:  # false at the first call
            energy[i, 0] += gained
        energy[i, 1] = kinetic
        wheel = WHEEL_RADII * rim
        way = 0.5 * (math.fabs(v - wheel) + math.fabs(v + wheel)) * dt_s
        energy[i, 0] += ROLLING * GRAVITY_M_S2 * mass[i] * way
