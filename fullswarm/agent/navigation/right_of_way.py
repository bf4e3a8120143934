"""Decides who drives through a narrow passage, and where the others wait.

Through a passage in which two robots cannot meet they go one direction at a time. Robots inside go on; of those outside,
the side whose first robot is nearer to its mouth has the right of way, and on that side the nearest robot goes first.
The others of that side stay on rings around the mouth, one farther out for each few that are before them. Robots of the
other side wait beside the mouth, so that it stays free for those that come out. In a wider passage with traffic in both
directions each keeps to its right.

Each robot decides by itself from where its neighbours are, how they move and where they say that they are driving to.
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
EVEN_M = 0.05
FOLLOW_M = 0.8
MOVING_M_S = 0.03
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
    speed = math.hypot(vx, vy)
    inside = before < 0.5 * radius_m and math.fabs(across) < 0.5 * width
    mouth_m = math.hypot(max(before, 0.0), across)
    narrow = width < 4.0 * radius_m + 3.0 * margin_m + ROOM_M
    band = 2.0 * radius_m + margin_m + BESIDE_M
    opposing_inside = False
    opposing_near = False
    opposing_depth = -1.0
    opposing_head = math.inf
    same_head = before
    same_inside = False
    backing = False
    ahead = 0
    for pair in range(low, high):
        other = traffic.other[pair]
        other_x = traffic.places[other, 0]
        other_y = traffic.places[other, 1]
        heading = traffic.states[other, 2]
        other_speed = traffic.states[other, 3]
        speed_x = other_speed * math.cos(heading)
        speed_y = other_speed * math.sin(heading)
        dx = other_x - passages[row, 0]
        dy = other_y - passages[row, 1]
        there = axis_x * dx + axis_y * dy
        aside = -axis_y * dx + axis_x * dy
        going = direction(
            other_x, other_y, speed_x, speed_y, traffic.aims[other, 0], traffic.aims[other, 1], sign * there,
            sign * aside, passages, row,
        )  # fmt: skip
        if going == 0:
            continue
        within = math.fabs(aside) < 0.5 * width
        if going * sign < 0.0:
            its_before = there - half
            its_inside = within and its_before < 0.5 * radius_m and there > -half - radius_m
            if its_inside:
                opposing_inside = True
                if there > along:
                    opposing_depth = max(opposing_depth, -its_before)
            if its_before > -2.0 * half - 1.0:
                opposing_near = opposing_near or its_before < CLAIM_M
                if not its_inside and its_before > 0.0:
                    opposing_head = min(opposing_head, math.hypot(its_before, aside))
        else:
            its_before = -half - there
            its_inside = within and its_before < 0.5 * radius_m
            if its_inside:
                same_inside = same_inside or there < half + radius_m
                if along < there < along + FOLLOW_M and axis_x * speed_x + axis_y * speed_y < -MOVING_M_S:
                    backing = True
            elif its_before > 0.0:
                its_mouth_m = math.hypot(its_before, aside)
                same_head = min(same_head, its_mouth_m)
                nearer = its_mouth_m < mouth_m
                if its_mouth_m == mouth_m:
                    nearer = aside < across
                if nearer:
                    ahead += 1
    if not narrow:
        if not opposing_near and not opposing_inside:
            return vx, vy
        lane = -min(0.25 * width, max(0.5 * width - radius_m - margin_m - 0.05, 0.0))
        if before > CLAIM_M or along > half:
            return vx, vy
        # To the right half of the mouth first, then along it.
        towards = max(along + 0.8, -half)
        to_along = towards - along
        to_across = lane - across
        size = math.hypot(to_along, to_across)
        ux = (to_along * axis_x - to_across * axis_y) / size
        uy = (to_along * axis_y + to_across * axis_x) / size
        return speed * ux, speed * uy
    if inside:
        depth = -before
        retreat = backing
        if opposing_depth >= 0.0:
            even = math.fabs(opposing_depth - depth) < EVEN_M
            retreat = retreat or (sign < 0.0 if even else opposing_depth > depth)
        if retreat:
            return -speed * axis_x, -speed * axis_y
        return vx, vy
    if mouth_m > CLAIM_M + 1.0:
        return vx, vy
    yields = opposing_inside
    if not yields and not same_inside and opposing_head < CLAIM_M:
        own_head = min(same_head, mouth_m)
        even = math.fabs(opposing_head - own_head) < EVEN_M
        yields = sign < 0.0 if even else opposing_head < own_head
    if not yields and ahead == 0:
        return vx, vy
    ring_m = RING_M + RING_STEP_M * (max(ahead - 1, 0) // RING_ROBOTS)
    if yields:
        ring_m += RING_STEP_M
    side = 1.0 if across > 0.0 else -1.0
    in_band = math.fabs(across) < band
    if mouth_m < ring_m - EVEN_M or (yields and in_band and before < CLEAR_AHEAD_M):
        # Away from the mouth, and off its axis: those that come out need it.
        back = 0.0 if mouth_m >= ring_m - EVEN_M else max(before, 0.05)
        off = side * band if in_band else across
        size = math.hypot(back, off)
        ux = (-back * axis_x - off * axis_y) / size
        uy = (-back * axis_y + off * axis_x) / size
        return AWAY_SHARE * speed * ux, AWAY_SHARE * speed * uy
    room_m = mouth_m - ring_m
    if yields and in_band:
        room_m = before - CLEAR_AHEAD_M
    share = min(1.0, max(0.0, room_m / SLOWING_M))
    return share * vx, share * vy
