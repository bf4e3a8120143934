"""Lets robots settle that cannot get nearer to their goals: they stand, report so, and go on when there is room.

A goal with room for one robot and a request to ten leaves nine that press against each other, and sidestep, for ever.
A robot settles when it is slow, or has come no nearer for `CIRCLES_S` although it moves, as one that circles those that
arrived before it, and

- something is in its way, and every place that is nearer to its goal is taken by a robot at standstill: at once; or
- every place in its goal's disc is taken or enclosed by robots at standstill, and it has come no nearer for `WAIT_S`;
- it has come no nearer for `GIVE_UP_S`, another robot is beside it, and there is no room ahead nor at its sides: in a
  corridor, a jam. By walls alone no robot is shut in that its planner led there.

The first two are judged where the goal is at most `WINDOW_M` away, so that all robots around it are sensed. While there
is a free place in the goal's disc that can be reached they do not hold, also for a robot at its rim.

A settled robot goes on when its goal changes, or when for `ROOM_S` it could have driven a way of its radius towards the
goal, to a place that the rule by which it settled takes for free. Each time that it settles again without having come
nearer, that time is doubled, so that noise does not have it start and stop.

A robot in its goal's disc whose pose is not good enough to tell it from the goal stops, too: what is left of the
desired velocity there has the direction of the noise.

The desired velocity of a settled robot is zero. All robots' desired velocities still pass through the filter.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from fullswarm.agent.neighbours.estimates import Nearby
from fullswarm.agent.safety.barrier import Arena, box_gap
from fullswarm.drivers.base import NO_OBSTACLES
from fullswarm.kernels import Array, Flags, Index, bound, kernel, views

CHECK_S = 0.5
"""How often a slow robot looks for places: they cost more than a control period has."""
SLOW_SHARE = 0.1
"""A robot below this share of its speed limit is slow."""
STANDSTILL_M_S = 0.02
WAITS_M_S = 0.02
"""A robot whose control law desires less waits, for its turn at a door, and is not held up."""
NEARER_RADII = 0.5
"""A robot has come nearer, and a place is nearer, by at least so many of its radii."""
FIT_M = 0.03
"""Beyond the filter's margin: the last of a gap is used up ever more slowly."""
WINDOW_M = 2.0
CIRCLES_S = 1.0
WAIT_S = 6.0
GIVE_UP_S = 20.0
ROOM_S = 1.0
LONGEST_ROOM_S = 64.0
TILTS = (0.0, 0.5, -0.5, 1.0, -1.0, 1.6, -1.6, 2.1, -2.1)
"""Directions in which there may be room, rad from that of the desired velocity."""
AHEAD = 5
"""So many of them lead nearer to the goal."""
NOT_SETTLED, NO_NEARER_PLACE, GOAL_TAKEN, SHUT_IN = range(4)
RELEASED = 2.0
"""So many times the distance at which a robot stops at its goal it must be away from it to go there again."""
ROUNDING_M = 1e-6


class Settled(NamedTuple):
    """State of :func:`settle`, rows of n robots.

    `goal`: (n, 2) of the last call. `least_m`, `nearer_s`: (n,) least distance to it so far, and when it was reached.
    `check_s`: (n,) when to check next. `rule`: (n,) by which it has settled. `room_s`, `free_s`: (n,) how long there
    must be room, and since when there is. `at_goal`: (n,) it stands where its goal is, as far as it can know.
    """

    goal: Array
    least_m: Array
    nearer_s: Array
    check_s: Array
    rule: Index
    room_s: Array
    free_s: Array
    at_goal: Flags


class Wanted(NamedTuple):
    """What :func:`settle` knows of the robots and their requests.

    `goal_m`, `reach_m`: (n, 2), (n,) as in ``Tasks``. `lasting`: (n,) the request is filtered and no intent of a stick.
    `radius_m`, `margin_m`, `speed_limit`: (n,) footprint, gap that the filter keeps, m/s.
    """

    goal_m: Array
    reach_m: Array
    lasting: Flags
    radius_m: Array
    margin_m: Array
    speed_limit: Array


@kernel
def is_free(i: int, x: float, y: float, clearance_m: float, standing: bool, near: Nearby, arena: Arena) -> bool:
    """Tell whether robot `i` could stand at (x, y) among the robots near it, or among those at standstill only."""
    start, other, places, states, spread_m, _, _ = near
    obstacles, bounds_m = arena
    for pair in range(start[i], start[i + 1]):
        row = other[pair]
        if standing and math.fabs(states[row, 3]) > STANDSTILL_M_S:
            continue
        dx = places[row, 0] - x
        dy = places[row, 1] - y
        apart_m = clearance_m + states[row, 5] + spread_m[row] - ROUNDING_M
        if dx * dx + dy * dy < apart_m * apart_m:
            return False
    for row in range(obstacles.shape[0]):
        gap, _, _ = box_gap(x, y, obstacles, row)
        if gap < clearance_m:
            return False
    nearest_m: float = min(x - bounds_m[0], y - bounds_m[1], bounds_m[2] - x, bounds_m[3] - y)
    return nearest_m >= clearance_m


@kernel
def is_enclosed(i: int, x: float, y: float, from_x: float, from_y: float, clearance_m: float, near: Nearby) -> bool:
    """Tell whether robots at standstill near robot `i` close every way from (from_x, from_y) to (x, y).

    Two of them that leave no gap between them close the line between their centres. They enclose the place if such
    lines make a closed path that crosses the straight way an odd number of times: each robot gets a label, another one
    across a crossing, and on such a path the labels contradict each other.
    """
    start, other, places, states, spread_m, _, _ = near
    count = start[i + 1] - start[i]
    label = np.full(count, -1, np.int64)
    queue = np.empty(count, np.int64)
    for first in range(count):
        row = other[start[i] + first]
        if label[first] >= 0 or math.fabs(states[row, 3]) > STANDSTILL_M_S:
            continue
        label[first] = 0
        queue[0] = first
        done = 0
        queued = 1
        while done < queued:
            one = queue[done]
            done += 1
            row = other[start[i] + one]
            ax = places[row, 0]
            ay = places[row, 1]
            radius = 2.0 * clearance_m + states[row, 5] + spread_m[row]
            for two in range(count):
                row = other[start[i] + two]
                if two == one or math.fabs(states[row, 3]) > STANDSTILL_M_S:
                    continue
                bx = places[row, 0]
                by = places[row, 1]
                apart = radius + states[row, 5] + spread_m[row]
                if (bx - ax) * (bx - ax) + (by - ay) * (by - ay) >= apart * apart:
                    continue
                # Whether the lines (a, b) and (from, to) cross: the ends of each lie on both sides of the other. An end
                # on the other line counts to one side, so that a robot right on the way is crossed once, not twice.
                side_a = (x - from_x) * (ay - from_y) - (y - from_y) * (ax - from_x)
                side_b = (x - from_x) * (by - from_y) - (y - from_y) * (bx - from_x)
                side_from = (bx - ax) * (from_y - ay) - (by - ay) * (from_x - ax)
                side_to = (bx - ax) * (y - ay) - (by - ay) * (x - ax)
                crosses = 1 if (side_a > 0.0) != (side_b > 0.0) and (side_from > 0.0) != (side_to > 0.0) else 0
                if label[two] < 0:
                    label[two] = label[one] ^ crosses
                    queue[queued] = two
                    queued += 1
                elif label[two] != label[one] ^ crosses:
                    return True
    return False


@kernel
def is_open(
    i: int, x: float, y: float, way: bool, from_x: float, from_y: float, clearance_m: float, near: Nearby, arena: Arena
) -> bool:
    """Tell whether (x, y) is free of robots at standstill and, if `way` counts, whether they leave a way to it."""
    return is_free(i, x, y, clearance_m, True, near, arena) and not (
        way and is_enclosed(i, x, y, from_x, from_y, clearance_m, near)
    )


@kernel
def place_left(
    i: int, way: bool, from_x: float, from_y: float, goal_x: float, goal_y: float, within_m: float, clearance_m: float,
    near: Nearby, arena: Arena,
) -> bool:  # fmt: skip
    """Tell whether a place within `within_m` of the goal is open to robot `i` at (from_x, from_y): see `is_open`.

    Of a region bounded by circles the nearest point to the goal is the goal, the nearest point of a circle, or where
    two circles meet: no other places are tried.
    """
    start, other, places, states, spread_m, _, _ = near
    if is_open(i, goal_x, goal_y, way, from_x, from_y, clearance_m, near, arena):
        return True
    for pair in range(start[i], start[i + 1]):
        row = other[pair]
        if math.fabs(states[row, 3]) > STANDSTILL_M_S:
            continue
        x = places[row, 0]
        y = places[row, 1]
        radius = clearance_m + states[row, 5] + spread_m[row]
        to_goal = math.hypot(goal_x - x, goal_y - y)
        if to_goal > within_m + radius:
            continue
        if math.fabs(to_goal - radius) <= within_m:
            # Of a robot at the goal all points of the circle are equally near.
            at_x = x + (radius / to_goal * (goal_x - x) if to_goal > ROUNDING_M else radius)
            at_y = y + (radius / to_goal * (goal_y - y) if to_goal > ROUNDING_M else 0.0)
            if is_open(i, at_x, at_y, way, from_x, from_y, clearance_m, near, arena):
                return True
        for later in range(pair + 1, start[i + 1]):
            row = other[later]
            if math.fabs(states[row, 3]) > STANDSTILL_M_S:
                continue
            dx = places[row, 0] - x
            dy = places[row, 1] - y
            second = clearance_m + states[row, 5] + spread_m[row]
            squared = dx * dx + dy * dy
            if squared >= (radius + second) * (radius + second) or squared < ROUNDING_M:
                continue
            along = 0.5 * (squared + radius * radius - second * second) / squared
            rest = radius * radius / squared - along * along
            if rest <= 0.0:
                continue
            across = math.sqrt(rest)
            for side in range(2):
                sign = 1.0 if side == 0 else -1.0
                at_x = x + along * dx - sign * across * dy
                at_y = y + along * dy + sign * across * dx
                if math.hypot(goal_x - at_x, goal_y - at_y) <= within_m and is_open(
                    i, at_x, at_y, way, from_x, from_y, clearance_m, near, arena
                ):
                    return True
    return False


@kernel
def has_room(
    i: int, x: float, y: float, ux: float, uy: float, way_m: float, clearance_m: float, tilts: int, near: Nearby,
    arena: Arena,
) -> bool:  # fmt: skip
    """Tell whether robot `i` could go `way_m` in one of the first `tilts` directions of `TILTS`, 0 is (ux, uy)."""
    for k in range(tilts):
        c = math.cos(TILTS[k])
        s = math.sin(TILTS[k])
        way_x = way_m * (c * ux - s * uy)
        way_y = way_m * (s * ux + c * uy)
        if is_free(i, x + way_x, y + way_y, clearance_m, False, near, arena) and is_free(
            i, x + 0.5 * way_x, y + 0.5 * way_y, clearance_m, False, near, arena
        ):
            return True
    return False


@kernel
def is_beside(i: int, x: float, y: float, clearance_m: float, near: Nearby) -> bool:
    """Tell whether another robot is less than `clearance_m` from (x, y)."""
    start, other, places, states, spread_m, _, _ = near
    for pair in range(start[i], start[i + 1]):
        row = other[pair]
        apart_m = clearance_m + states[row, 5] + spread_m[row]
        if math.hypot(places[row, 0] - x, places[row, 1] - y) < apart_m:
            return True
    return False


@kernel
def rule_for(
    i: int, x: float, y: float, ux: float, uy: float, goal_x: float, goal_y: float, reach_m: float, waited_s: float,
    radius: float, clearance_m: float, near: Nearby, arena: Arena,
) -> int:  # fmt: skip
    """Return by which rule robot `i`, slow or without progress for `waited_s`, settles now; see the module."""
    left_m = math.hypot(goal_x - x, goal_y - y)
    fit_m = clearance_m + FIT_M
    if left_m <= WINDOW_M:
        nearer_m = left_m - NEARER_RADII * radius
        if not has_room(i, x, y, ux, uy, 0.5 * radius, clearance_m, 1, near, arena) and not place_left(
            i, False, x, y, goal_x, goal_y, nearer_m, fit_m, near, arena
        ):
            return NO_NEARER_PLACE
        if waited_s >= WAIT_S and not place_left(i, True, x, y, goal_x, goal_y, reach_m, fit_m, near, arena):
            return GOAL_TAKEN
    way_m = 2.0 * radius
    if (
        waited_s >= GIVE_UP_S and is_beside(i, x, y, way_m + clearance_m, near)
        and not has_room(i, x, y, ux, uy, way_m, clearance_m, len(TILTS), near, arena)
    ):  # fmt: skip
        return SHUT_IN
    return NOT_SETTLED


@kernel
def may_go_on(
    i: int, rule: int, x: float, y: float, ux: float, uy: float, goal_x: float, goal_y: float, reach_m: float,
    radius: float, clearance_m: float, near: Nearby, arena: Arena,
) -> bool:  # fmt: skip
    """Tell whether robot `i`, which has settled by `rule`, could come nearer to its goal now."""
    if not has_room(i, x, y, ux, uy, radius, clearance_m, AHEAD, near, arena):
        return False
    if rule == SHUT_IN:
        return True
    within_m = reach_m if rule == GOAL_TAKEN else math.hypot(goal_x - x, goal_y - y) - NEARER_RADII * radius
    return place_left(i, True, x, y, goal_x, goal_y, within_m, clearance_m + FIT_M, near, arena)


@kernel
def settle(
    state: Settled, wanted: Wanted, near: Nearby, arena: Arena, confidence: float, now_s: float, desired: Array,
    pose: Array, twist: Array, sigma: Array,
) -> None:  # fmt: skip
    """Set the desired velocities (n, 2) of settled robots to zero; see the module."""
    goal, least_m, nearer_s, check_s, rule, room_s, free_s, at_goal = state
    goals, reach_m, lasting, radius, margin_m, speed_limit = wanted
    for i in range(desired.shape[0]):
        goal_x = goals[i, 0]
        goal_y = goals[i, 1]
        left_m = math.hypot(goal_x - pose[i, 0], goal_y - pose[i, 1])
        if not lasting[i] or math.isnan(left_m):
            if math.isnan(goal_x):
                goal[i, 0] = math.nan
                rule[i] = NOT_SETTLED
            continue
        if goal_x != goal[i, 0] or goal_y != goal[i, 1]:
            goal[i, 0] = goal_x
            goal[i, 1] = goal_y
            least_m[i] = math.inf
            room_s[i] = ROOM_S
        size = math.hypot(desired[i, 0], desired[i, 1])
        if left_m < least_m[i] - NEARER_RADII * radius[i] or left_m <= reach_m[i] or size < WAITS_M_S:
            least_m[i] = min(left_m, least_m[i])
            nearer_s[i] = now_s
            check_s[i] = now_s + CHECK_S
            rule[i] = NOT_SETTLED
            known_m = (RELEASED if at_goal[i] else 1.0) * confidence * sigma[i, 0]
            at_goal[i] = left_m <= min(reach_m[i], known_m)
            if at_goal[i]:
                desired[i, 0] = 0.0
                desired[i, 1] = 0.0
            continue
        at_goal[i] = False
        if now_s >= check_s[i]:
            check_s[i] = now_s + CHECK_S
            ux = desired[i, 0] / size
            uy = desired[i, 1] / size
            clearance_m = radius[i] + margin_m[i] + confidence * sigma[i, 0]
            if rule[i] != NOT_SETTLED:
                if not may_go_on(
                    i, rule[i], pose[i, 0], pose[i, 1], ux, uy, goal_x, goal_y, reach_m[i], radius[i],
                    clearance_m, near, arena,
                ):  # fmt: skip
                    free_s[i] = math.inf
                elif free_s[i] == math.inf:
                    free_s[i] = now_s
                if now_s - free_s[i] >= room_s[i]:
                    rule[i] = NOT_SETTLED
                    nearer_s[i] = now_s
                    room_s[i] = min(2.0 * room_s[i], LONGEST_ROOM_S)
            elif math.fabs(twist[i, 0]) <= SLOW_SHARE * speed_limit[i] or now_s - nearer_s[i] >= CIRCLES_S:
                rule[i] = rule_for(
                    i, pose[i, 0], pose[i, 1], ux, uy, goal_x, goal_y, reach_m[i], now_s - nearer_s[i], radius[i],
                    clearance_m, near, arena,
                )  # fmt: skip
                free_s[i] = math.inf
        if rule[i] != NOT_SETTLED:
            desired[i, 0] = 0.0
            desired[i, 1] = 0.0


class Settling:
    """Finds which of n robots are as near to their goals as they can get.

    Parameters
    ----------
    wanted : goals and sizes of the robots; the arrays are kept, their values may change
    bounds_m : (4,) the arena
    confidence : so many standard deviations of its position the filter adds to a robot's margin

    Attributes
    ----------
    rule : (n,) by which the robot has settled; `NOT_SETTLED`
    """

    def __init__(self, wanted: Wanted, bounds_m: Array, confidence: float) -> None:
        count = len(wanted.radius_m)
        self._wanted, self._bounds_m, self._confidence = wanted, bounds_m, confidence
        self._state = Settled(
            goal=np.full((count, 2), math.nan),
            least_m=np.full(count, math.inf),
            nearer_s=np.zeros(count),
            check_s=np.zeros(count),
            rule=np.zeros(count, np.int64),
            room_s=np.full(count, ROOM_S),
            free_s=np.full(count, math.inf),
            at_goal=np.zeros(count, bool),
        )
        self.rule = self._state.rule
        self._near: Nearby | None = None
        self._obstacles = NO_OBSTACLES
        self._settle: Callable[[float, Array, Array, Array, Array], None]

    @property
    def settled(self) -> Flags:
        """Which robots stand because they cannot get nearer, (n,)."""
        settled: Flags = self.rule != NOT_SETTLED
        return settled

    def hold(
        self, now_s: float, desired: Array, pose: Array, twist: Array, sigma: Array, near: Nearby, obstacles: Array
    ) -> None:
        """Set the desired velocities (n, 2) of the settled robots to zero.

        Parameters
        ----------
        pose, twist, sigma : (n, 3), (n, 2), (n, 2) estimated, measured, and standard deviations of the pose
        near : which robots are near each
        obstacles : (k, 6), see ``Reading.obstacles``
        """
        if near is not self._near or obstacles is not self._obstacles:
            self._near, self._obstacles = near, obstacles
            arena = Arena(obstacles, self._bounds_m)
            given = self._state, self._wanted, near, arena
            if settle.run is settle.plain:
                given = views(self._state), views(self._wanted), views(near), views(arena)
            self._settle = bound(partial(settle.run, *given, self._confidence))
        self._settle(now_s, desired, pose, twist, sigma)
