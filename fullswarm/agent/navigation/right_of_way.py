"""Decides which robot drives through a narrow passage first, and where the others wait.

Through a passage in which two robots cannot meet they go one direction at a time. Robots inside go on; of those
outside, the side whose first robot is nearer to its mouth has the right of way, and on that side the nearest robot goes
first. The others of that side stay on rings around the mouth, one farther out for each few that are before them. Robots
of the other side wait beside the mouth, so that it stays free for those that come out. In a wider passage with traffic
in both directions each keeps to its right.

Each robot decides by itself: from where its neighbours are, how they move, and where they say they are driving to.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from fullswarm.kernels import Array, Index, kernel

EXIT_M = 0.3
"""A robot on its way through a passage aims at the point of its axis so far behind it."""
MATCH_M = 0.3
"""Points that are nearer to each other are the same aim: maps of two robots may differ a little."""
ROOM_M = 0.2
"""A passage is narrow if two robots and their margins leave less than this."""
CLAIM_M = 2.0
"""A robot on its way through claims the passage from so far before its mouth."""
CLEAR_AHEAD_M = 1.5
"""Waiting robots keep off the axis up to so far before the mouth."""
RING_M = 0.8
RING_STEP_M = 0.45
RING_ROBOTS = 4
BESIDE_M = 0.1
SLOWING_M = 0.4
LANE_AHEAD_M = 0.8
LANE_SLACK_M = 0.05
EVEN_M = 0.05
FOLLOW_M = 0.8
MOVING_M_S = 0.03
FIRST_M = 0.2
"""Those that wait leave so much more than the margin to the first one: it may have a wall at its other side."""
AWAY_SHARE = 0.6
"""A robot that clears a mouth does so at this share of its desired speed."""


class Traffic(NamedTuple):
    """The robots that one robot senses: rows ``other[low:high]`` of places (m, 2), states (m, 6) and aims (m, 2)."""

    other: Index
    places: Array
    states: Array
    aims: Array


@kernel
def direction(
    x: float, y: float, speed_x: float, speed_y: float, aim_x: float, aim_y: float, along: float, across: float,
    passages: Array, row: int,
) -> int:  # fmt: skip
    """Return in which direction a robot is going through a passage: 1 along its axis, -1 against it, 0 not at all.

    `along`, `across`: its place in the frame of the passage. A robot that says nothing of its aim is taken to drive on
    as it does.
    """
    axis_x = passages[row, 2]
    axis_y = passages[row, 3]
    half = passages[row, 4]
    width = passages[row, 5]
    known = math.isfinite(aim_x + aim_y)
    if not known:
        if math.hypot(speed_x, speed_y) < MOVING_M_S:
            return 0
        aim_x = x + 2.0 * speed_x
        aim_y = y + 2.0 * speed_y
    off_x = aim_x - passages[row, 0]
    off_y = aim_y - passages[row, 1]
    aim_along = axis_x * off_x + axis_y * off_y
    aim_across = -axis_y * off_x + axis_x * off_y
    if math.fabs(along) < half + 0.5 * width and math.fabs(across) < 0.5 * width:
        if aim_along > along + EVEN_M:
            return 1
        return -1 if aim_along < along - EVEN_M else 0
    if known:
        if math.fabs(aim_across) < MATCH_M and math.fabs(math.fabs(aim_along) - half - EXIT_M) < MATCH_M:
            if aim_along > 0.0 and along < 0.0:
                return 1
            if aim_along < 0.0 and along > 0.0:
                return -1
        return 0
    if along * aim_along < 0.0:
        part = along / (along - aim_along)
        if math.fabs(across + part * (aim_across - across)) < 0.5 * width:
            return 1 if along < 0.0 else -1
    return 0


@kernel
def survey(
    along: float, before: float, across: float, radius_m: float, sign: float, row: int, low: int, high: int,
    passages: Array, traffic: Traffic,
) -> tuple[bool, bool, float, float, float, bool, bool, int, int]:  # fmt: skip
    """Return what the neighbours of a robot do at passage `row`; the frame is that of its own direction.

    Parameters
    ----------
    along, before, across : where it is: from the middle, before its mouth, to the left of the axis, m
    sign : 1.0 when it drives along the axis, -1.0 against it

    Returns
    -------
    tuple
        Some robot that comes towards it is inside; one is inside or near; how far the one that is ahead of it has come
        in, -1 if there is none; distances of the first one outside from their mouth and of the first one with its own
        direction from its own, m; one with its own direction is inside; the next one of these comes back; how many of
        these are outside and nearer to the mouth, and the row of the nearest.
    """
    axis_x = sign * passages[row, 2]
    axis_y = sign * passages[row, 3]
    half = passages[row, 4]
    half_width = 0.5 * passages[row, 5]
    mouth_m = math.hypot(max(before, 0.0), across)
    opposing_inside = False
    opposing_near = False
    opposing_depth = -1.0
    opposing_head = math.inf
    own_head = mouth_m
    own_inside = False
    backing = False
    ahead = 0
    first = 0
    first_m = math.inf
    for pair in range(low, high):
        other = traffic.other[pair]
        other_x = traffic.places[other, 0]
        other_y = traffic.places[other, 1]
        heading = traffic.states[other, 2]
        speed_x = traffic.states[other, 3] * math.cos(heading)
        speed_y = traffic.states[other, 3] * math.sin(heading)
        dx = other_x - passages[row, 0]
        dy = other_y - passages[row, 1]
        there = axis_x * dx + axis_y * dy
        aside = -axis_y * dx + axis_x * dy
        going = sign * direction(
            other_x, other_y, speed_x, speed_y, traffic.aims[other, 0], traffic.aims[other, 1], sign * there,
            sign * aside, passages, row,
        )  # fmt: skip
        if going == 0.0:
            continue
        its_before = there - half if going < 0.0 else -half - there
        gone = its_before < -2.0 * half - radius_m
        its_inside = math.fabs(aside) < half_width and its_before < 0.5 * radius_m and not gone
        its_mouth_m = math.hypot(max(its_before, 0.0), aside)
        off_x = traffic.aims[other, 0] - passages[row, 0]
        off_y = traffic.aims[other, 1] - passages[row, 1]
        if math.isfinite(off_x + off_y) and its_before > 0.0:
            # Where it says that it goes through: two that know a silent robot's disc differently must agree on who
            # is first, and each distance is the same for both.
            mouth = axis_x * off_x + axis_y * off_y - going * (2.0 * half + EXIT_M)
            its_mouth_m = math.hypot(max(going * (mouth - there), 0.0), aside - axis_x * off_y + axis_y * off_x)
        if going < 0.0:
            opposing_inside = opposing_inside or its_inside
            opposing_near = opposing_near or (its_before < CLAIM_M and not gone)
            if its_inside and there > along:
                opposing_depth = max(opposing_depth, -its_before)
            elif its_before > 0.0:
                opposing_head = min(opposing_head, its_mouth_m)
        elif its_inside:
            own_inside = True
            if along < there < along + FOLLOW_M and axis_x * speed_x + axis_y * speed_y < -MOVING_M_S:
                backing = True
        elif its_before > 0.0:
            own_head = min(own_head, its_mouth_m)
            if its_mouth_m < mouth_m or (its_mouth_m == mouth_m and aside < across):
                ahead += 1
                if its_mouth_m < first_m:
                    first = other
                    first_m = its_mouth_m
    return opposing_inside, opposing_near, opposing_depth, opposing_head, own_head, own_inside, backing, ahead, first


@kernel
def wait(
    vx: float, vy: float, before: float, across: float, axis_x: float, axis_y: float, band_m: float, yields: bool,
    ahead: int,
) -> tuple[float, float]:  # fmt: skip
    """Return the velocity of a robot that is not to enter now: to its ring around the mouth, or off the mouth's axis.

    Parameters
    ----------
    axis_x, axis_y : in the direction of the robot
    band_m : robots that wait for those of the other side keep so far off the axis
    yields : it waits for the other side
    ahead : how many are before it on its own side
    """
    speed = AWAY_SHARE * math.hypot(vx, vy)
    mouth_m = math.hypot(max(before, 0.0), across)
    ring_m = RING_M + RING_STEP_M * (max(ahead - 1, 0) // RING_ROBOTS)
    if yields:
        ring_m += RING_STEP_M
    in_band = math.fabs(across) < band_m
    if mouth_m < ring_m - EVEN_M or (yields and in_band and before < CLEAR_AHEAD_M):
        back = 0.0 if mouth_m >= ring_m - EVEN_M else max(before, 0.05)
        off = across
        if in_band:
            off = band_m if across > 0.0 else -band_m
        size = math.hypot(back, off)
        return speed * (-back * axis_x - off * axis_y) / size, speed * (-back * axis_y + off * axis_x) / size
    room_m = before - CLEAR_AHEAD_M if yields and in_band else mouth_m - ring_m
    share = min(1.0, max(0.0, room_m / SLOWING_M))
    return share * vx, share * vy


@kernel
def leave_way(vx: float, vy: float, dx: float, dy: float, apart_m: float, speed: float) -> tuple[float, float]:
    """Return the velocity of a robot that waits, less what leads it nearer than `apart_m` to the first one at (dx, dy).

    Where it is nearer already it drives off; `speed`: of the way that it would have alone.
    """
    away_m = max(math.hypot(dx, dy), EVEN_M)
    most = speed * max(-AWAY_SHARE, min(1.0, (away_m - apart_m) / SLOWING_M))
    closing = (vx * dx + vy * dy) / away_m
    if closing <= most:
        return vx, vy
    share = (closing - most) / away_m
    return vx - share * dx, vy - share * dy


@kernel
def keep_right(
    vx: float, vy: float, along: float, across: float, half: float, axis_x: float, axis_y: float, lane_m: float
) -> tuple[float, float]:
    """Return the velocity towards the right lane, `lane_m` right of the axis: first to its mouth, then along it."""
    to_along = max(LANE_AHEAD_M, -half - along)
    to_across = -lane_m - across
    share = math.hypot(vx, vy) / math.hypot(to_along, to_across)
    return share * (to_along * axis_x - to_across * axis_y), share * (to_along * axis_y + to_across * axis_x)


@kernel
def give_way(
    x: float, y: float, vx: float, vy: float, radius_m: float, margin_m: float, gate: int, low: int, high: int,
    passages: Array, traffic: Traffic,
) -> tuple[float, float]:  # fmt: skip
    """Return the desired velocity of a robot on its way through passage `gate`: `v`, or how it waits or makes way.

    Parameters
    ----------
    x, y, vx, vy : m and m/s; the velocity that it would have alone
    gate : as ``Ways.gate``, not 0
    low, high : its neighbours in `traffic`
    """
    row = (gate if gate > 0 else -gate) - 1
    sign = 1.0 if gate > 0 else -1.0
    axis_x = sign * passages[row, 2]
    axis_y = sign * passages[row, 3]
    half = passages[row, 4]
    width = passages[row, 5]
    off_x = x - passages[row, 0]
    off_y = y - passages[row, 1]
    along = axis_x * off_x + axis_y * off_y
    across = -axis_y * off_x + axis_x * off_y
    before = -half - along
    mouth_m = math.hypot(max(before, 0.0), across)
    if mouth_m > CLAIM_M + 1.0:
        return vx, vy
    opposing_inside, opposing_near, opposing_depth, opposing_head, own_head, own_inside, backing, ahead, first = survey(
        along, before, across, radius_m, sign, row, low, high, passages, traffic
    )
    if width >= 4.0 * radius_m + 3.0 * margin_m + ROOM_M:
        if not opposing_near or before > CLAIM_M or along > half:
            return vx, vy
        lane_m = min(0.25 * width, max(0.5 * width - radius_m - margin_m - LANE_SLACK_M, 0.0))
        return keep_right(vx, vy, along, across, half, axis_x, axis_y, lane_m)
    if before < 0.5 * radius_m and math.fabs(across) < 0.5 * width:
        # Inside: of two that meet the one that has come less far goes back, and those behind it with it.
        even = math.fabs(opposing_depth + before) < EVEN_M
        if backing or (opposing_depth >= 0.0 and (sign < 0.0 if even else opposing_depth > -before)):
            speed = math.hypot(vx, vy)
            return -speed * axis_x, -speed * axis_y
        return vx, vy
    yields = opposing_inside
    if not yields and not own_inside and opposing_head < CLAIM_M:
        even = math.fabs(opposing_head - own_head) < EVEN_M
        yields = sign < 0.0 if even else opposing_head < own_head
    if not yields and ahead == 0:
        return vx, vy
    speed = math.hypot(vx, vy)
    vx, vy = wait(vx, vy, before, across, axis_x, axis_y, 2.0 * radius_m + margin_m + BESIDE_M, yields, ahead)
    if ahead == 0:
        return vx, vy
    apart_m = radius_m + margin_m + traffic.states[first, 5] + FIRST_M
    return leave_way(vx, vy, traffic.places[first, 0] - x, traffic.places[first, 1] - y, apart_m, speed)
