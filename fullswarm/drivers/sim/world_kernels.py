"""What a world does to every body once per step, whatever the engine. Obstacle rows as in `with_trigonometry`."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fullswarm.drivers.sim.contact_kernels import obstacle_gap
from fullswarm.kernels import Array, kernel

BUMP_BIT = 1  # Hazard.BUMP, as a number that a compiled kernel can hold


@kernel
def ramp(
    target: Array, commanded_s: Array, limits: Array, drive: Array, now_s: float, watchdog_s: float, dt: float
) -> None:
    """Move `drive` (n, 2) towards `target` within `limits` (n, 4: m/s, rad/s, m/s², rad/s²).

    A body that got no command for `watchdog_s` gets the target zero.
    """
    for i in range(target.shape[0]):
        if now_s - commanded_s[i] > watchdog_s + 1e-9:
            target[i, 0] = 0.0
            target[i, 1] = 0.0
        for axis in range(2):
            cap, most = limits[i, axis], limits[i, axis + 2] * dt
            goal = max(-cap, min(cap, target[i, axis]))
            drive[i, axis] += max(-most, min(most, goal - drive[i, axis]))


@kernel
def dead_reckon(odometry: Array, twist: Array, dt: float) -> None:
    """Advance `odometry` (n, 3) along the arcs of the measured `twist` (n, 2)."""
    for i in range(odometry.shape[0]):
        half = 0.5 * twist[i, 1] * dt
        ratio = math.sin(half) / half if abs(half) > 1e-4 else 1.0 - half * half / 6.0
        middle, chord = odometry[i, 2] + half, twist[i, 0] * dt * ratio
        odometry[i, 0] += chord * math.cos(middle)
        odometry[i, 1] += chord * math.sin(middle)
        heading = middle + half
        if heading > math.pi or heading < -math.pi:
            heading = math.atan2(math.sin(heading), math.cos(heading))
        odometry[i, 2] = heading


@kernel
def front_bumps(pose: Array, pairs: NDArray[np.int64], obstacles: Array, hazards: NDArray[np.uint8]) -> None:
    """Set `hazards` (n,) to BUMP where a touching pair lies in the front half of a body, else to none."""
    hazards[:] = 0
    for p in range(pairs.shape[0]):
        i, j = pairs[p, 0], pairs[p, 1]
        if j >= 0:
            nx, ny = pose[i, 0] - pose[j, 0], pose[i, 1] - pose[j, 1]
            if nx * math.cos(pose[j, 2]) + ny * math.sin(pose[j, 2]) > 0.0:
                hazards[j] = BUMP_BIT
        else:
            _, nx, ny = obstacle_gap(pose[i, 0], pose[i, 1], obstacles, -1 - j)
        if nx * math.cos(pose[i, 2]) + ny * math.sin(pose[i, 2]) < 0.0:
            hazards[i] = BUMP_BIT


@kernel
def sense(pose: Array, obstacles: Array, radius: float, seen: NDArray[np.bool_]) -> int:
    """Mark in `seen` (k,) the obstacles whose surface is within `radius` of any pose; return how many changed."""
    changed = 0
    for k in range(obstacles.shape[0]):
        near = False
        far = obstacles[k, 7] + radius
        for i in range(pose.shape[0]):
            dx, dy = pose[i, 0] - obstacles[k, 0], pose[i, 1] - obstacles[k, 1]
            if dx * dx + dy * dy <= far * far and obstacle_gap(pose[i, 0], pose[i, 1], obstacles, k)[0] <= radius:
                near = True
                break
        if near != seen[k]:
            seen[k] = near
            changed += 1
    return changed


@kernel
def admit(
    twists: Array,
    active: NDArray[np.bool_],
    limits: Array,
    target: Array,
    commanded_s: Array,
    applied: Array,
    now_s: float,
) -> int:
    """Take set-points (n, 2) clipped to `limits` for the rows in `active`, zero for the others.

    Returns
    -------
    int
        The last row whose twist is not finite (it gets zero), or -1.
    """
    bad = -1
    for i in range(twists.shape[0]):
        v, w = twists[i, 0], twists[i, 1]
        if not (math.isfinite(v) and math.isfinite(w)):
            bad = i
            v, w = 0.0, 0.0
        if not active[i]:
            v, w = 0.0, 0.0
        applied[i, 0] = max(-limits[i, 0], min(limits[i, 0], v))
        applied[i, 1] = max(-limits[i, 1], min(limits[i, 1], w))
        target[i, 0], target[i, 1] = applied[i, 0], applied[i, 1]
        commanded_s[i] = now_s
    return bad
