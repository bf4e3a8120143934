"""Barrier certificates for unicycles, per robot (paper III.A, its [11]: Wang, Ames, Egerstedt 2017).

For a neighbour j in direction n (unit, from i to j) with a gap g between the footprints, robot i has the half of it
to itself: ``n·u_i <= γ g / 2``. For a wall or a box it carries the whole: ``n·u_i <= γ g``. The desired velocity is
projected onto these half-planes exactly, by an incremental method in the plane: no solver, no tolerance.

A unicycle cannot drive sideways, so projecting is not enough: that is how the paper's robots collided. Here the
projection only says where to turn to. The speed along the *present* heading is held within the interval that the same
half-planes allow, and :mod:`fullswarm.agent.safety.braking` sees to it that speed and turn rate can be brought to
zero before the gap is used up. ``docs/explanation-safety-filter.md`` says what follows from that, and what does not.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fullswarm.agent.neighbours.estimates import Nearby
from fullswarm.agent.neighbours.objects import Objects
from fullswarm.geometry import clamp
from fullswarm.kernels import Array, kernel

MAX_ROWS = 256
"""Half-planes per robot at most. Only things within braking distance count, and discs of one size leave room for
a few dozen of them there."""


class Arena(NamedTuple):
    """Rounded boxes (k, 6) as in ``Reading.obstacles``; x_min, y_min, x_max, y_max (4,) in m."""

    obstacles: Array
    bounds_m: Array


class HalfPlanes(NamedTuple):
    """Constraints of one robot, ``normal[k]·u <= limit[k]``, in arrays of `MAX_ROWS`; filled by :func:`half_planes`.

    `limit` >= 0 in m/s; `blur`: by how much the true direction may differ from the normal; `room` >= 0: m that the
    robot may use up towards there. Inside the clearance it may be at standstill or leave.
    """

    normal_x: Array
    normal_y: Array
    limit: Array
    blur: Array
    room: Array


@kernel
def box_gap(x: float, y: float, obstacles: Array, row: int) -> tuple[float, float, float]:
    """Return the distance and direction from a point to a rounded box.

    Returns
    -------
    tuple
        Distance in m (negative inside) and the unit direction towards the box.
    """
    yaw = obstacles[row, 4]
    cos_yaw = math.cos(yaw)
    sin_yaw = math.sin(yaw)
    dx = x - obstacles[row, 0]
    dy = y - obstacles[row, 1]
    local_x = cos_yaw * dx + sin_yaw * dy
    local_y = -sin_yaw * dx + cos_yaw * dy
    out_x = local_x - clamp(local_x, -obstacles[row, 2], obstacles[row, 2])
    out_y = local_y - clamp(local_y, -obstacles[row, 3], obstacles[row, 3])
    distance = math.hypot(out_x, out_y)
    if distance < 1e-9:
        # Inside: the nearest face counts.
        depth_x = obstacles[row, 2] - math.fabs(local_x)
        depth_y = obstacles[row, 3] - math.fabs(local_y)
        if depth_x < depth_y:
            out_x = 1.0 if local_x > 0 else -1.0
            out_y = 0.0
            distance = -depth_x
        else:
            out_x = 0.0
            out_y = 1.0 if local_y > 0 else -1.0
            distance = -depth_y
        towards_x = -(cos_yaw * out_x - sin_yaw * out_y)
        towards_y = -(sin_yaw * out_x + cos_yaw * out_y)
        return distance - obstacles[row, 5], towards_x, towards_y
    towards_x = -(cos_yaw * out_x - sin_yaw * out_y) / distance
    towards_y = -(sin_yaw * out_x + cos_yaw * out_y) / distance
    return distance - obstacles[row, 5], towards_x, towards_y


@kernel
def project(desired_x: float, desired_y: float, planes: HalfPlanes, count: int) -> tuple[float, float]:
    """Find the velocity nearest to the desired one within the first `count` of `planes`.

    All limits are >= 0, so zero is always allowed and the answer is never faster than the desired velocity.
    Half-planes are taken one after the other; where the answer so far violates one, the new answer lies on its border:
    a problem in one dimension, clipped by those before.
    """
    normal_x, normal_y, limits, _, _ = planes
    x = desired_x
    y = desired_y
    for k in range(count):
        nx = normal_x[k]
        ny = normal_y[k]
        limit = limits[k]
        if nx * x + ny * y <= limit + 1e-12:
            continue
        along = -ny * desired_x + nx * desired_y
        low = -math.inf
        high = math.inf
        base_x = limit * nx
        base_y = limit * ny
        for j in range(k):
            other_x = normal_x[j]
            other_y = normal_y[j]
            slope = -ny * other_x + nx * other_y
            room = limits[j] - (other_x * base_x + other_y * base_y)
            if slope > 1e-12:
                most = room / slope
                high = most if most < high else high
            elif slope < -1e-12:
                least = room / slope
                low = least if least > low else low
            elif room < -1e-12:
                return 0.0, 0.0
        if low > high + 1e-9:
            return 0.0, 0.0
        # Borders that meet in one point may miss it by a rounding error: that point is the answer.
        along = 0.5 * (low + high) if low > high else max(low, min(high, along))
        x = base_x - ny * along
        y = base_y + nx * along
    return x, y


@kernel
def approach_limit(room_m: float, gain: float, accel: float, approach_s: float) -> float:
    """Return how fast a body may use up `room_m`, m/s: γ of it per second, or what its brakes allow if `gain` is 0.

    The brakes: the speed v at which it goes on for `approach_s` and then stops within the room, ``v t + v²/2a``.
    """
    if gain > 0.0:
        return gain * room_m
    return accel * (math.sqrt(approach_s * approach_s + 2.0 * room_m / accel) - approach_s)


@kernel
def approach_m(closing: float, stop_s: float, limits: Array) -> float:
    """Return how far an object that closes in at `closing` m/s may come in `stop_s`, >= 0.

    `limits` (2,): the assumed greatest speed and acceleration of any object. A way whose speed grows has its greatest
    value at the start or at the end.
    """
    way_m = closing * stop_s + 0.5 * float(limits[1]) * stop_s * stop_s
    return max(0.0, min(way_m, float(limits[0]) * stop_s))


@kernel
def object_planes(
    x: float, y: float, clearance_m: float, unsure_m: float, swing: float, gain: float, accel: float, approach_s: float,
    binding_m: float, stop_s: float, objects: Objects, planes: HalfPlanes, count: int,
) -> int:  # fmt: skip
    """Add the constraints of moving objects to `count` ones; return how many there are then, -1: it must not move.

    The robot carries all of a gap, less what the object may close of it until the robot stands.
    """
    normal_x, normal_y, limits, blur, room = planes
    moving = objects.rows
    for row in range(objects.used[0]):
        dx = moving[row, 0] - x
        dy = moving[row, 1] - y
        squared = dx * dx + dy * dy
        closest_m = clearance_m + moving[row, 4]
        reach = closest_m + binding_m + objects.limits[0] * stop_s
        if squared > reach * reach:
            continue
        distance = math.sqrt(squared)
        if distance < 1e-6 or count == MAX_ROWS:
            return -1
        nx = dx / distance
        ny = dy / distance
        closing = moving[row, 5] - nx * moving[row, 2] - ny * moving[row, 3]
        gap = distance - closest_m - approach_m(closing, stop_s, objects.limits)
        if gap < binding_m:
            normal_x[count] = nx
            normal_y[count] = ny
            room[count] = max(0.0, gap)
            limits[count] = approach_limit(room[count], gain, accel, approach_s)
            blur[count] = unsure_m / distance + swing
            count += 1
    return count


@kernel
def half_planes(
    i: int, x: float, y: float, clearance_m: float, unsure_m: float, swing: float, gain: float, accel: float,
    approach_s: float, speed_limit: float, way: float, reach_m: float, near: Nearby, arena: Arena, planes: HalfPlanes,
    objects: Objects, stop_s: float,
) -> int:  # fmt: skip
    """Collect the constraints of robot `i` at (x, y); return how many there are, -1 when it must not move at all.

    Those that no velocity within the speed limit can violate are left out: in open space that is nearly all. It must
    not move where a neighbour is estimated to be at its own place, nor where more than `MAX_ROWS` things are near.

    Parameters
    ----------
    clearance_m, unsure_m : radius plus margin and error of the position; how far the robot may be from (x, y)
    swing : error of the robot's heading, rad: all normals may be off by it
    gain : γ in 1/s; 0: what the brakes allow, see :func:`approach_limit`
    way : how far it will go before a new command acts, m
    reach_m : obstacles farther away are not sensed
    planes : out
    objects, stop_s : what moves and does not keep its half; how long the robot takes to stop
    """
    obstacles, bounds_m = arena
    start, other, places, states, spread_m, blur_m, _ = near
    normal_x, normal_y, limits, blur, room = planes
    count = 0
    clearance_m += unsure_m
    binding_m = speed_limit / gain if gain > 0.0 else speed_limit * (approach_s + 0.5 * speed_limit / accel)
    binding_m = (binding_m + way) * (1.0 + swing)
    twice_m = 2.0 * binding_m
    blur_share = twice_m / clearance_m
    for pair in range(start[i], start[i + 1]):
        row = other[pair]
        dx = places[row, 0] - x
        dy = places[row, 1] - y
        squared = dx * dx + dy * dy
        far_off = blur_m[row] + unsure_m
        closest_m = clearance_m + states[row, 5] + spread_m[row]
        reach = closest_m + twice_m + blur_share * far_off
        if squared > reach * reach:
            continue
        distance = math.sqrt(squared)
        if distance < 1e-6:
            return -1
        share = 0.5 * (distance - closest_m)
        if share * distance < binding_m * (distance + far_off):
            if count == MAX_ROWS:
                return -1
            left_m = share if share > 0.0 else 0.0
            normal_x[count] = dx / distance
            normal_y[count] = dy / distance
            room[count] = left_m
            # Written out: in plain Python a call for each neighbour takes 0.1 µs.
            limits[count] = gain * left_m if gain > 0.0 else approach_limit(left_m, gain, accel, approach_s)
            blur[count] = far_off / distance + swing
            count += 1
    for row in range(obstacles.shape[0]):
        across = math.hypot(obstacles[row, 2], obstacles[row, 3]) + obstacles[row, 5] + clearance_m + binding_m
        if math.fabs(obstacles[row, 0] - x) > across or math.fabs(obstacles[row, 1] - y) > across:
            continue
        gap, nx, ny = box_gap(x, y, obstacles, row)
        if gap < reach_m and gap - clearance_m < binding_m:
            if count == MAX_ROWS:
                return -1
            normal_x[count] = nx
            normal_y[count] = ny
            room[count] = max(0.0, gap - clearance_m)
            limits[count] = approach_limit(room[count], gain, accel, approach_s)
            blur[count] = swing
            count += 1
    if objects.used[0] > 0:
        count = object_planes(
            x, y, clearance_m, unsure_m, swing, gain, accel, approach_s, binding_m, stop_s, objects, planes, count
        )
        if count < 0:
            return -1
    if (
        x - bounds_m[0] - clearance_m >= binding_m and y - bounds_m[1] - clearance_m >= binding_m
        and bounds_m[2] - x - clearance_m >= binding_m and bounds_m[3] - y - clearance_m >= binding_m
    ):  # fmt: skip
        return count
    for side in range(4):
        horizontal = side % 2 == 0
        sign = -1.0 if side < 2 else 1.0
        to_edge = sign * (bounds_m[side] - (x if horizontal else y)) - clearance_m
        if to_edge < binding_m:
            if count == MAX_ROWS:
                return -1
            normal_x[count] = sign if horizontal else 0.0
            normal_y[count] = 0.0 if horizontal else sign
            room[count] = max(0.0, to_edge)
            limits[count] = approach_limit(room[count], gain, accel, approach_s)
            blur[count] = swing
            count += 1
    return count


@kernel
def shorten(
    planes: HalfPlanes, count: int, x: float, y: float, way: float, swing: float, reverses: bool, unsure: float,
    gain: float, accel: float, approach_s: float,
) -> None:  # fmt: skip
    """Reduce the rooms by what a body uses up on a way that nothing can change any more.

    A path of length `way` that turns by `swing` <= π/2 in all leads along its chord, and stays within half its length
    times sin(swing / 2) of it, so it comes nearer in direction n by n·(x, y) and that at most; any path by its length.

    Parameters
    ----------
    x, y : m, displacement in the end; `way`, m, length of the path
    reverses : it goes forwards and backwards
    unsure : rad by which the heading at its end may be off
    """
    normal_x, normal_y, limits, blur, room = planes
    bulge = 0.5 * way * math.sin(0.5 * min(swing, math.pi))
    reverses = reverses or swing > 0.5 * math.pi
    for k in range(count):
        blur[k] += unsure
        nearer = max(0.0, normal_x[k] * x + normal_y[k] * y) + bulge + blur[k] * way
        if reverses or nearer > way:
            nearer = way
        left_m = room[k] - nearer
        room[k] = left_m if left_m > 0.0 else 0.0
        limits[k] = approach_limit(room[k], gain, accel, approach_s)


@kernel
def interval(
    ahead_x: float, ahead_y: float, low: float, high: float, planes: HalfPlanes, count: int
) -> tuple[float, float]:
    """Narrow the interval of speeds along (ahead_x, ahead_y) to what the half-planes allow; zero stays in it."""
    normal_x, normal_y, limits, blur, _ = planes
    for k in range(count):
        slope = normal_x[k] * ahead_x + normal_y[k] * ahead_y
        unsure = blur[k]
        # The other may be a little to the side of its estimated position: the worse direction counts.
        ahead = slope + unsure
        if ahead > 1e-9:
            most = limits[k] / ahead
            high = min(high, most)
        behind = slope - unsure
        if behind < -1e-9:
            least = limits[k] / behind
            low = max(low, least)
    return low, high
