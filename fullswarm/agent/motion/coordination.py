"""Coordinates robots above the safety filter: of each pair that would meet, both avoid the other in advance.

Optimal reciprocal collision avoidance (ORCA: van den Berg, Guy, Lin, Manocha 2011): velocities with which a robot and
a neighbour would touch within a time horizon form a cone; each of the two changes its velocity by a share of what leads
out of it. Each neighbour so gives a half-plane of velocities, and the desired velocity is replaced by the nearest one
in all of them, or, where they have none in common, by the one that violates them least. A robot that is pushed gives
way, also when it has arrived: that is how a crowd fills a goal disc.

A unicycle follows the velocity with a delay, so discs count as larger while it moves, as in NH-ORCA (Alonso-Mora,
Breitenmoser, Rufli, Beardsley, Siegwart 2010). The robot uses its own pose and motion and the states that its
neighbours send; nothing is negotiated, and a neighbour that does not take part is still avoided.

What is left of a desired velocity in a jam is little and jumps: a robot that keeps hardly any of it turns to where it
wants to go instead of following it, so that wheels do not reverse, unless what is left lasts.

Only the *desired* velocity changes. The safety filter comes after it, so its guarantees hold whatever is computed here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from fullswarm.agent.neighbours.estimates import Nearby
from fullswarm.kernels import Array, Flags, bound, kernel, views

HORIZON_S = 2.0
"""Robots further apart in time than this ignore each other; less where the sensing radius is passed earlier."""
ENLARGED_M = 0.15
"""By how much a robot's disc counts as larger at its top speed. At standstill it does not: a pile needs its room."""
SHARE = 0.8
"""Of the change that a pair needs, by each robot: more than half, because a unicycle turns before it obeys."""
LATE_SHARE = 0.5
"""The same where the sensing radius is less than what a robot drives in the horizon: both see each other late, and two
that overdo a strong change swing to and fro."""
HELD_SHARE = 0.25
"""A robot is held while less than this of its desired speed is left: the direction of what little is left jumps with
each millimetre. A held robot desires to go where it did at `CREEP_SHARE` of that speed, so that it turns there."""
CREEP_SHARE = 0.02
SLIDES_SHARE = 0.1
"""What is left of its velocity lasts if the mean of it, over the time in which the robot can turn back, is above this
share of its speed limit: a held robot then follows the mean, if it can turn within its footprint at that speed. So the
robots of a full goal disc move up into gaps."""
RESTS_M_S = 0.006
"""A robot that desires less only gives way. It is held, and stands, while it is to give way by less."""
PART_S = 0.12
"""In so long two robots that overlap are to part: a moving robot's disc grows with its speed, so that it begins to
overlap by a little, and one that parts in a control period then stops and starts again without end."""
RELEASED = 2.0
"""A held robot is released by so many times what it is held below."""
MAX_LINES = 16
"""Half-planes per robot at most; of more neighbours, those that restrict the robot most count."""


class Rules(NamedTuple):
    """How robots avoid each other; `part_s`: in which those that overlap shall part, `reach_m`: sensing radius.

    `period_s`: between two calls.
    """

    horizon_s: float
    enlarged_m: float
    share: float
    late_share: float
    part_s: float
    reach_m: float
    period_s: float


class Crowd(NamedTuple):
    """The own robots, (n,) each; `takes_part`: others keep their desired velocity; `held`: in and out, see above.

    `slide`: (n, 2), in and out, the mean of what was left of the desired velocity lately, m/s.
    """

    takes_part: Flags
    radius: Array
    margin_m: Array
    speed_limit: Array
    turn_limit: Array
    held: Flags
    slide: Array


class Motion(NamedTuple):
    """Desired velocity (n, 2), in and out, m/s, NaN: none; pose (n, 3) and measured twist (n, 2)."""

    desired: Array
    pose: Array
    twist: Array


class Lines(NamedTuple):
    """Half-planes ``normal[k]·u <= limit[k]`` of one robot, and room for those of :func:`least_violation`."""

    normal_x: Array
    normal_y: Array
    limit: Array
    other_x: Array
    other_y: Array
    other_limit: Array


@kernel
def on_line(
    k: int, normal_x: Array, normal_y: Array, limits: Array, top: float, aim_x: float, aim_y: float, direction: bool
) -> tuple[float, float, bool]:
    """Return the velocity on the border of half-plane k that is nearest to the aim; False: there is none.

    It fulfils the first k half-planes and the speed limit. With `direction`: the farthest one in the aim's direction.
    """
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
    # As in `barrier.project`, which is exact to 1e-12: here half-planes are often nearly parallel, and a border that
    # others clip to nothing is an answer, not a rounding error. A call that both share would slow down the filter.
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
        along = math.copysign(math.inf, along)
    along = low if along < low else min(high, along)
    return base_x - ny * along, base_y + nx * along, True


@kernel
def nearest(
    count: int, normal_x: Array, normal_y: Array, limits: Array, top: float, aim_x: float, aim_y: float,
    direction: bool,
) -> tuple[float, float, int]:  # fmt: skip
    """Return the velocity nearest to the aim within all half-planes and the speed limit `top`.

    Returns
    -------
    tuple
        Velocity in m/s, and how many half-planes it fulfils: fewer than `count` where they have no point in common.
    """
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
    """Return the velocity whose greatest violation of a half-plane is the least, in m/s.

    Parameters
    ----------
    first : the half-planes below it are fulfilled by (x, y), the best velocity so far
    """
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
    part_s: float, share: float,
) -> tuple[float, float, float]:  # fmt: skip
    """Return the half-plane of velocities that a robot keeps to for the sake of another at (dx, dy): normal and limit.

    Parameters
    ----------
    both_m : the distance to keep; within it the two part in `part_s`
    share : of the least change of the relative velocity that keeps it for `horizon_s`
    """
    rel_x = vx - other_vx
    rel_y = vy - other_vy
    squared = dx * dx + dy * dy
    apart = squared > both_m * both_m
    inverse = 1.0 / horizon_s if apart else 1.0 / part_s
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
def hold(
    i: int, x: float, y: float, aim_x: float, aim_y: float, top: float, tightest: float, share: float, held: Flags,
    slide: Array,
) -> tuple[float, float]:  # fmt: skip
    """Return the velocity (x, y) that is left for robot `i`; while it is held, what lasts of it, or little of its aim.

    All in m/s. `top`: speed limit; an aim may be faster. `tightest`: at which the robot can turn within its footprint.
    `share`: of the new velocity in the mean, `slide`.
    """
    wanted = min(math.hypot(aim_x, aim_y), top)
    rests = wanted <= RESTS_M_S
    least = RESTS_M_S if rests else HELD_SHARE * wanted
    slide[i, 0] += share * (x - slide[i, 0])
    slide[i, 1] += share * (y - slide[i, 1])
    if held[i]:
        least *= RELEASED
    held[i] = math.hypot(x, y) < least and (x != aim_x or y != aim_y)
    if not held[i]:
        return x, y
    if rests:
        return 0.0, 0.0
    if SLIDES_SHARE * top < math.hypot(slide[i, 0], slide[i, 1]) < tightest:
        return slide[i, 0], slide[i, 1]
    creep = CREEP_SHARE * wanted / math.hypot(aim_x, aim_y)
    return creep * aim_x, creep * aim_y


@kernel
def coordinate(rules: Rules, crowd: Crowd, near: Nearby, lines: Lines, motion: Motion) -> None:
    """Replace desired velocities (n, 2) by the nearest ones with which all pairs stay apart for the horizon.

    Parameters
    ----------
    lines : room for one robot's half-planes
    """
    most_s, enlarged_m, usual_share, late_share, part_s, reach_m, period_s = rules
    takes_part, radius, margin_m, speed_limit, turn_limit, held, slide = crowd
    start, other, places, states, spread_m, _, _ = near
    normal_x, normal_y, limits, _, _, _ = lines
    desired, pose, twist = motion
    for i in range(desired.shape[0]):
        aim_x = desired[i, 0]
        aim_y = desired[i, 1]
        x = pose[i, 0]
        y = pose[i, 1]
        speed = twist[i, 0]
        if not takes_part[i] or not math.isfinite(aim_x + aim_y + x + y + pose[i, 2] + speed):
            held[i] = False
            continue
        vx = speed * math.cos(pose[i, 2])
        vy = speed * math.sin(pose[i, 2])
        top = speed_limit[i]
        horizon_s = min(most_s, reach_m / top)
        share = late_share if horizon_s < most_s else usual_share
        own_m = radius[i] + margin_m[i] + enlarged_m * min(math.fabs(speed) / top, 1.0)
        count = 0
        for pair in range(start[i], start[i + 1]):
            row = other[pair]
            dx = places[row, 0] - x
            dy = places[row, 1] - y
            both_m = own_m + states[row, 5] + spread_m[row]
            other_speed = states[row, 3]
            reach = both_m + horizon_s * (top + math.fabs(other_speed))
            if dx * dx + dy * dy > reach * reach:
                continue
            heading = states[row, 2]
            nx, ny, limit = reciprocal(
                dx, dy, vx, vy, other_speed * math.cos(heading), other_speed * math.sin(heading), both_m, horizon_s,
                part_s, share,
            )  # fmt: skip
            if limit >= top:
                continue
            at = count
            if count < MAX_LINES:
                count += 1
            else:
                at = 0
                for k in range(1, MAX_LINES):
                    if limits[k] > limits[at]:
                        at = k
                if limits[at] <= limit:
                    continue
            normal_x[at] = nx
            normal_y[at] = ny
            limits[at] = limit
        if count > 0:
            new_x, new_y, fulfilled = nearest(count, normal_x, normal_y, limits, top, aim_x, aim_y, False)
            if fulfilled < count:
                new_x, new_y = least_violation(fulfilled, count, top, new_x, new_y, lines)
            turned = min(period_s * turn_limit[i] / math.pi, 1.0)
            tightest = turn_limit[i] * radius[i]
            desired[i, 0], desired[i, 1] = hold(i, new_x, new_y, aim_x, aim_y, top, tightest, turned, held, slide)
        else:
            held[i] = False


class Coordinator:
    """Coordinates n robots with those they sense.

    Parameters
    ----------
    crowd : arrays that others may write
    reach_m : sensing radius
    period_s : of control
    """

    def __init__(self, crowd: Crowd, reach_m: float, period_s: float) -> None:
        self._crowd = crowd
        self._rules = Rules(HORIZON_S, ENLARGED_M, SHARE, LATE_SHARE, PART_S, reach_m, period_s)
        scratch = np.zeros((len(Lines._fields), MAX_LINES))
        # Plain Python reads lists and views faster than arrays.
        self._lines, self._listed = Lines(*scratch), Lines._make(scratch.tolist())
        self._near: Nearby | None = None
        self._run: Callable[[Motion], None]

    def apply(self, desired: Array, pose: Array, twist: Array, near: Nearby) -> None:
        """Replace desired velocities (n, 2) of robots that take part; see :func:`coordinate`."""
        plain = coordinate.run is coordinate.plain
        if near is not self._near:
            self._near = near
            given = (views(self._crowd), views(near), self._listed) if plain else (self._crowd, near, self._lines)
            self._run = bound(partial(coordinate.run, self._rules, *given))
        motion = Motion(desired, pose, twist)
        self._run(views(motion) if plain else motion)
