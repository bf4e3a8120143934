"""Reciprocal avoidance above the safety filter: each robot takes half of what keeps a pair apart for some seconds.

Optimal reciprocal collision avoidance (van den Berg, Guy, Lin, Manocha 2011), from what the robot knows: its own pose
and motion, and the states that its neighbours send.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fullswarm.agent.neighbours.estimates import Nearby
from fullswarm.kernels import Array, Flags, kernel, views

MAX_LINES = 16


class Lines(NamedTuple):
    """Half-planes ``normal[k]·u <= limit[k]`` of one robot, and as many more for what violates them least."""

    normal_x: Array
    normal_y: Array
    limit: Array
    other_x: Array
    other_y: Array
    other_limit: Array


class Coordination(NamedTuple):
    horizon_s: float
    enlarged_m: float
    period_s: float
    share: float


@kernel
def on_line(
    k: int, normal_x: Array, normal_y: Array, limits: Array, top: float, aim_x: float, aim_y: float, direction: bool
) -> tuple[float, float, bool]:
    """Return the best velocity on border k that the first k half-planes and the speed limit allow; False: none."""
    nx = normal_x[k]
    ny = normal_y[k]
    limit = limits[k]
    squared = top * top - limit * limit
    if squared < 0.0:
        return 0.0, 0.0, False
    high = math.sqrt(squared)
    low = -high
    base_x = limit * nx
    base_y = limit * ny
    for j in range(k):
        other_x = normal_x[j]
        other_y = normal_y[j]
        slope = -ny * other_x + nx * other_y
        room = limits[j] - (other_x * base_x + other_y * base_y)
        if slope > 1e-6:
            most = room / slope
            high = most if most < high else high
        elif slope < -1e-6:
            least = room / slope
            low = least if least > low else low
        elif room < 0.0:
            return 0.0, 0.0, False
        if low > high:
            return 0.0, 0.0, False
    along = -ny * aim_x + nx * aim_y
    if direction:
        along = high if along > 0.0 else low
    else:
        along = low if along < low else (high if along > high else along)
    return base_x - ny * along, base_y + nx * along, True


@kernel
def nearest(
    count: int, normal_x: Array, normal_y: Array, limits: Array, top: float, aim_x: float, aim_y: float,
    direction: bool,
) -> tuple[float, float, int]:  # fmt: skip
    """Return the velocity nearest to the aim within all half-planes and the speed limit, and the first that fails."""
    size = math.hypot(aim_x, aim_y)
    scale = top / size if size > top or direction else 1.0
    x = scale * aim_x
    y = scale * aim_y
    for k in range(count):
        if normal_x[k] * x + normal_y[k] * y > limits[k]:
            new_x, new_y, found = on_line(k, normal_x, normal_y, limits, top, aim_x, aim_y, direction)
            if not found:
                return x, y, k
            x = new_x
            y = new_y
    return x, y, count


@kernel
def least_violation(first: int, count: int, top: float, x: float, y: float, lines: Lines) -> tuple[float, float]:
    """Return the velocity that violates the half-planes least where none fulfils them all."""
    normal_x, normal_y, limits, other_x, other_y, other_limit = lines
    worst = 0.0
    for k in range(first, count):
        nx = normal_x[k]
        ny = normal_y[k]
        if nx * x + ny * y - limits[k] <= worst:
            continue
        made = 0
        for j in range(k):
            dx = normal_x[j] - nx
            dy = normal_y[j] - ny
            size = math.hypot(dx, dy)
            if size > 1e-6:
                other_x[made] = dx / size
                other_y[made] = dy / size
                other_limit[made] = (limits[j] - limits[k]) / size
                made += 1
        new_x, new_y, failed = nearest(made, other_x, other_y, other_limit, top, -nx, -ny, True)
        if failed == made:
            x = new_x
            y = new_y
        worst = nx * x + ny * y - limits[k]
    return x, y


@kernel
def reciprocal(
    dx: float, dy: float, vx: float, vy: float, other_vx: float, other_vy: float, both_m: float, horizon_s: float,
    period_s: float, share: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return the half-plane that a robot with velocity v keeps towards another at (dx, dy): unit normal and limit."""
    rel_x = vx - other_vx
    rel_y = vy - other_vy
    squared = dx * dx + dy * dy
    apart = squared > both_m * both_m
    inverse = 1.0 / horizon_s if apart else 1.0 / period_s
    wx = rel_x - inverse * dx
    wy = rel_y - inverse * dy
    towards = wx * dx + wy * dy
    w_squared = wx * wx + wy * wy
    if not apart or (towards < 0.0 and towards * towards > both_m * both_m * w_squared):
        w = max(math.sqrt(w_squared), 1e-9)
        nx = -wx / w
        ny = -wy / w
        change = both_m * inverse - w
    else:
        leg = math.sqrt(squared - both_m * both_m)
        if dx * wy - dy * wx > 0.0:
            along_x = (dx * leg - dy * both_m) / squared
            along_y = (dx * both_m + dy * leg) / squared
        else:
            along_x = -(dx * leg + dy * both_m) / squared
            along_y = -(-dx * both_m + dy * leg) / squared
        nx = along_y
        ny = -along_x
        change = nx * rel_x + ny * rel_y
    return nx, ny, nx * vx + ny * vy - share * change


@kernel
def coordinate(
    rules: Coordination, desired: Array, takes_part: Flags, pose: Array, twist: Array, radius: Array, margin_m: Array,
    speed_limit: Array, near: Nearby, lines: Lines,
) -> None:  # fmt: skip
    """Replace desired velocities (n, 2) by those nearest to them that keep all pairs apart for the horizon."""
    horizon_s, enlarged_m, period_s, share = rules
    start, other, places, states, spread_m, blur_m, _ = near
    normal_x, normal_y, limits, _, _, _ = lines
    for i in range(desired.shape[0]):
        aim_x = desired[i, 0]
        aim_y = desired[i, 1]
        if not takes_part[i] or math.isnan(aim_x + aim_y):
            continue
        x = pose[i, 0]
        y = pose[i, 1]
        vx = twist[i, 0] * math.cos(pose[i, 2])
        vy = twist[i, 0] * math.sin(pose[i, 2])
        if not math.isfinite(x + y + vx + vy):
            continue
        top = speed_limit[i]
        enlarged = enlarged_m * math.fabs(twist[i, 0]) / top
        count = 0
        for pair in range(start[i], start[i + 1]):
            row = other[pair]
            dx = places[row, 0] - x
            dy = places[row, 1] - y
            squared = dx * dx + dy * dy
            both_m = radius[i] + states[row, 5] + margin_m[i] + enlarged + spread_m[row]
            other_speed = states[row, 3]
            reach = both_m + horizon_s * (top + math.fabs(other_speed))
            if squared > reach * reach:
                continue
            other_heading = states[row, 2]
            nx, ny, limit = reciprocal(
                dx, dy, vx, vy, other_speed * math.cos(other_heading), other_speed * math.sin(other_heading), both_m,
                horizon_s, period_s, share,
            )  # fmt: skip
            if limit >= top:
                continue
            if count < MAX_LINES:
                at = count
                count += 1
            else:
                at = 0
                for k in range(1, count):
                    if limits[k] > limits[at]:
                        at = k
                if limits[at] <= limit:
                    continue
            normal_x[at] = nx
            normal_y[at] = ny
            limits[at] = limit
        if count == 0:
            continue
        new_x, new_y, failed = nearest(count, normal_x, normal_y, limits, top, aim_x, aim_y, False)
        if failed < count:
            new_x, new_y = least_violation(failed, count, top, new_x, new_y, lines)
        desired[i, 0] = new_x
        desired[i, 1] = new_y


class Coordinator:
    """Coordinates n robots."""

    def __init__(self, rules: Coordination) -> None:
        self._rules = rules
        scratch = np.empty((len(Lines._fields), MAX_LINES))
        self._lines, self._listed = Lines(*scratch), Lines._make(scratch.tolist())

    def apply(
        self, desired: Array, takes_part: Flags, pose: Array, twist: Array, radius: Array, margin_m: Array,
        speed_limit: Array, near: Nearby,
    ) -> None:  # fmt: skip
        """Replace desired velocities (n, 2)."""
        if coordinate.run is coordinate.plain:
            coordinate.run(
                self._rules, memoryview(desired), memoryview(takes_part), memoryview(pose), memoryview(twist),
                memoryview(radius), memoryview(margin_m), memoryview(speed_limit), views(near), self._listed,
            )  # fmt: skip
            return
        coordinate.run(
            self._rules, desired, takes_part, pose, twist, radius, margin_m, speed_limit, near, self._lines
        )  # fmt: skip
