"""Filters the desired motion of n robots: what is let through, how far that is from what was desired, why it brakes."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import structlog

from fullswarm.agent.neighbours.estimates import Nearby
from fullswarm.agent.neighbours.objects import Objects, no_objects
from fullswarm.agent.safety.barrier import MAX_ROWS, Arena, HalfPlanes, half_planes, interval, project, shorten
from fullswarm.agent.safety.braking import stoppable, towards
from fullswarm.agent.safety.dead_time import Commands, Underway, expect
from fullswarm.drivers.base import Description
from fullswarm.geometry import clamp, unicycle
from fullswarm.kernels import Array, Flags, Index, bound, kernel, views

log = structlog.get_logger()

FREE, LIMITED, BLIND, CROWDED, TOO_FAST = range(5)
EXPLAIN = {
    FREE: "",
    LIMITED: "",
    BLIND: "the filter brakes: the robot's pose or motion is not known",
    CROWDED: "the filter brakes: a robot is reported at this one's place, or too many things are near",
    TOO_FAST: "the filter brakes: something is so near that the robot cannot stop before its margin",
}
LEVEL = {BLIND: logging.WARNING, CROWDED: logging.WARNING, TOO_FAST: logging.INFO}
LONGEST_S = 0.1
"""A deviation counts for so long at most in its sum over time."""
QUIET_S = 60.0
FEW = 5
LOOSE_GAIN_PER_S = 2.0
"""γ of the linear barrier, or less, for makes with a dead time or an overrun, whatever form is set."""
APPROACH_S = 0.1
"""The last part of an approach decays with this time constant; see ``barrier.approach_limit``."""


HELD_SHARE, RELEASED_SHARE = 0.1, 0.2
"""A robot is held while the projection leaves less than this of its desired speed: where the half-planes meet in a
corner, the direction of what little is left jumps from one border to the other with each millimetre. A held robot turns
to where it wants to go, and does not reverse. It is released by the greater share."""
FACING_RAD = 0.15
"""A held robot whose heading differs by less from the desired direction does not turn."""


class RobotParams(NamedTuple):
    """What each robot is and can do, (n,) each; see :func:`robot_params`.

    `overrun_s` and `overrun_m`: how much farther than the accelerations say a stop goes, seconds of the speed and m at
    most. `dead_time_s`: from a command to its first effect.
    """

    radius_m: Array
    top_speed: Array
    least_speed: Array
    turn_limit: Array
    accel: Array
    turn_accel: Array
    overrun_s: Array
    overrun_m: Array
    dead_time_s: Array


class Tuning(NamedTuple):
    """Settings of the filter and of the unicycle map.

    `period_s`: how long an answer is in force; `reach_m`: obstacles farther away are not sensed; `confidence`: so many
    standard deviations of the own pose count.
    """

    period_s: float
    reach_m: float
    speed_gain: float
    turn_gain_per_s: float
    confidence: float = 0.0


class Requested(NamedTuple):
    """What the filter is given of each robot's task.

    `velocity`: (n, 2) m/s, world frame, desired; NaN: there is none, the desired motion is the robot's twist.
    `filtered`: (n,) behind the filter or straight through the paper's map. `gain`, `margin_m`: (n,) γ in 1/s, 0: the
    braking barrier; gap to keep.
    """

    velocity: Array
    filtered: Flags
    gain: Array
    margin_m: Array


class Measured(NamedTuple):
    """Pose (n, 3), twist (n, 2) in m/s and rad/s, when they were measured (n,), s, and `sigma` (n, 2) of the pose.

    `sigma`: standard deviations of position (m, worse axis) and heading (rad).
    """

    pose: Array
    twist: Array
    stamp_s: Array
    sigma: Array


class Filtered(NamedTuple):
    """What :func:`guard` fills.

    `twist`: (n, 2) m/s and rad/s, in and out. `deviation`: (n, 4) size, sum over time and vector of the change, see
    :class:`SafetyFilter`; the vector is old where the size is zero. `verdict`: (n,). `held`: (n,), see `HELD_SHARE`.
    """

    twist: Array
    deviation: Array
    verdict: Index
    held: Flags


class Given(NamedTuple):
    """All arrays of :func:`guard` but the measured ones."""

    robots: RobotParams
    underway: Underway
    requested: Requested
    near: Nearby
    arena: Arena
    objects: Objects
    out: Filtered
    planes: HalfPlanes


def robot_params(
    descriptions: Sequence[Description], speed_limit: Array, turn_limit: Array, reverse: Flags
) -> RobotParams:
    """Return the parameters of robots whose speed and turn rate are limited to (n,) m/s and rad/s."""
    limits = [each.limits for each in descriptions]
    return RobotParams(
        radius_m=np.array([each.radius_m for each in descriptions]),
        top_speed=speed_limit,
        least_speed=np.where(reverse, -speed_limit, 0.0),
        turn_limit=turn_limit,
        accel=np.array([each.accel_m_s2 for each in limits]),
        turn_accel=np.array([each.turn_accel_rad_s2 for each in limits]),
        overrun_s=np.array([each.overrun_s for each in limits]),
        overrun_m=np.array([each.overrun_m for each in limits]),
        dead_time_s=np.array([each.dead_time_s for each in limits]),
    )


@kernel
def steer(
    allowed_x: float, allowed_y: float, desired_x: float, desired_y: float, heading: float, held: bool,
    speed_gain: float, turn_gain_per_s: float,
) -> tuple[float, float, bool]:  # fmt: skip
    """Map a projected velocity to speed and turn rate; `held`: whether the robot was held before, and is; see above."""
    allowed = allowed_x * allowed_x + allowed_y * allowed_y
    share = RELEASED_SHARE if held else HELD_SHARE
    speed, turn = unicycle(allowed_x, allowed_y, heading, speed_gain, turn_gain_per_s)
    if allowed >= share * share * (desired_x * desired_x + desired_y * desired_y):
        return speed, turn, False
    _, turn = unicycle(desired_x, desired_y, heading, speed_gain, turn_gain_per_s)
    return max(speed, 0.0), turn if math.fabs(turn) >= FACING_RAD * turn_gain_per_s else 0.0, True


@kernel
def pass_through(
    i: int, top: float, low: float, turn_limit: float, speed_gain: float, turn_gain_per_s: float, velocity: Array,
    pose: Array, out: Filtered,
) -> int:  # fmt: skip
    """Map the desired velocity of robot `i` to a twist, unfiltered; return 1 if the filter braked it before."""
    ux = velocity[i, 0]
    uy = velocity[i, 1]
    if not (math.isnan(ux) or math.isnan(uy)):
        size = math.hypot(ux, uy)
        scale = top / size if size > top else 1.0
        speed, turn = unicycle(scale * ux, scale * uy, pose[i, 2], speed_gain, turn_gain_per_s)
        out.twist[i, 0] = clamp(speed, low, top)
        out.twist[i, 1] = clamp(turn, -turn_limit, turn_limit)
    braked = 1 if out.verdict[i] > LIMITED else 0
    if out.verdict[i] != FREE:
        out.verdict[i] = FREE
        out.deviation[i, 0] = 0.0
    return braked


@kernel
def guard(
    tuning: Tuning, robots: RobotParams, underway: Underway, requested: Requested, near: Nearby, arena: Arena,
    objects: Objects,
    out: Filtered, planes: HalfPlanes, measured: Measured, now_s: float, dt_s: float, stall_s: float,
) -> int:  # fmt: skip
    """Map desired planar velocities to unicycle twists, behind the filter where `filtered` says so.

    Parameters
    ----------
    planes : room for one robot's constraints
    dt_s : since the last call
    stall_s : by how much the next one may come late; the robot drives on meanwhile

    Returns
    -------
    int
        How many verdicts became or ceased to be one of those that brake.
    """
    period_s, reach_m, speed_gain, turn_gain_per_s, confidence = tuning
    radius, top_speed, least_speed, turn_limits, accels, turn_accels, overrun_s, overrun_max_m, dead_time_s = robots
    velocity, filtered, gain, margin_m = requested
    pose, motion, stamp_s, sigma = measured
    twists, deviation, verdict, held = out
    approach_s = APPROACH_S if 3.0 * period_s < APPROACH_S else 3.0 * period_s
    moving = objects.used[0] > 0
    news = 0
    for i in range(velocity.shape[0]):
        ux = velocity[i, 0]
        uy = velocity[i, 1]
        planar = not (math.isnan(ux) or math.isnan(uy))
        top = top_speed[i]
        low = least_speed[i]
        turn_limit = turn_limits[i]
        if not filtered[i]:
            news += pass_through(i, top, low, turn_limit, speed_gain, turn_gain_per_s, velocity, pose, out)
            continue
        x = pose[i, 0]
        y = pose[i, 1]
        heading = pose[i, 2]
        speed_now = motion[i, 0]
        turn_now = motion[i, 1]
        accel = accels[i]
        late_s = dead_time_s[i]
        overrun = overrun_s[i]
        # The braking barrier uses all of the brakes: it is for makes that follow their ramps exactly.
        gamma = gain[i]
        as_given = gamma > 0.0 or (late_s == 0.0 and overrun == 0.0)
        barrier_gain = gamma if as_given else min(LOOSE_GAIN_PER_S, accel / top)
        age = now_s - stamp_s[i]
        count = 0
        why = FREE
        if not math.isfinite(x + y + heading + speed_now + turn_now + age):
            why = BLIND
        else:
            # Where it has got to since it was measured: it may have sped up or turned, too.
            age = 0.0 if age < 0.0 else age
            fastest = math.fabs(speed_now)
            gained = fastest + 0.5 * accel * age
            most = fastest if fastest > top else top
            unsure_m = (most if most < gained else gained) * age
            moved_x = 0.0
            moved_y = 0.0
            way = 0.0
            if late_s > 0.0:
                # Decided is for the motion in which the commands before this one will have brought it.
                speed_now, turn_now, heading, moved_x, moved_y, way, fastest = expect(
                    i, heading, speed_now, accel * (overrun + period_s), late_s, underway
                )
            overrun_m = min(overrun * fastest, overrun_max_m[i]) if overrun > 0.0 else 0.0
            hung_m = stall_s * (fastest + accel * period_s)
            clearance_m = radius[i] + margin_m[i] + overrun_m + hung_m + confidence * sigma[i, 0]
            stop_s = math.fabs(speed_now) / accel + 2.0 * period_s + age + late_s + overrun + stall_s if moving else 0.0
            count = half_planes(
                i, x, y, clearance_m, unsure_m, confidence * sigma[i, 1], barrier_gain, accel, approach_s, top, way,
                reach_m, near, arena, planes, objects, stop_s,
            )  # fmt: skip
            if way > 0.0:
                shorten(
                    planes, count, moved_x, moved_y, way, underway.swing[i], underway.reverses[i] > 0.0,
                    underway.unsure[i], barrier_gain, accel, approach_s,
                )  # fmt: skip
            if count < 0:
                why = CROWDED
        if why != FREE:
            off = math.hypot(ux, uy) if planar else math.fabs(twists[i, 0])
            change_x = -ux if planar else -twists[i, 0] * math.cos(heading)
            change_y = -uy if planar else -twists[i, 0] * math.sin(heading)
            speed = 0.0
            turn = 0.0
        else:
            off = 0.0
            change_x = 0.0
            change_y = 0.0
            ahead_x = math.cos(heading) if count > 0 else 0.0
            ahead_y = math.sin(heading) if count > 0 else 0.0
            if planar:
                size = math.hypot(ux, uy)
                if size > top:
                    ux *= top / size
                    uy *= top / size
                desired_x = ux
                desired_y = uy
                if count > 0:
                    ux, uy = project(ux, uy, planes, count)
                    change_x = ux - desired_x
                    change_y = uy - desired_y
                    off = math.hypot(change_x, change_y)
                if off > 0.0:
                    speed, turn, held[i] = steer(
                        ux, uy, desired_x, desired_y, heading, held[i], speed_gain, turn_gain_per_s
                    )  # fmt: skip
                    # What the unicycle map makes of the desired velocity, without its arctangents.
                    desired_speed = speed_gain * (desired_x * ahead_x + desired_y * ahead_y)
                else:
                    speed, turn = unicycle(ux, uy, heading, speed_gain, turn_gain_per_s)
                    desired_speed = speed
                    held[i] = False
            else:
                speed = twists[i, 0]
                turn = twists[i, 1]
                desired_speed = speed
            # Written out: in plain Python three calls of `clamp` take 0.3 µs.
            desired_speed = low if desired_speed < low else (top if desired_speed > top else desired_speed)
            turn = -turn_limit if turn < -turn_limit else (turn_limit if turn > turn_limit else turn)
            if count == 0:
                speed = desired_speed
            else:
                low, high = interval(ahead_x, ahead_y, low, top, planes, count)
                speed = low if speed < low else (high if speed > high else speed)
                speed, turn, fits = stoppable(
                    heading, speed, turn, speed_now, turn_now, accel, turn_accels[i], period_s,
                    planes, count,
                )  # fmt: skip
                why = FREE if fits else TOO_FAST
                step = accel * period_s
                faster = (
                    towards(speed_now, speed, step) - towards(speed_now, desired_speed, step)
                    if speed != desired_speed
                    else 0.0
                )
                if math.fabs(faster) > off:
                    off = math.fabs(faster)
                    change_x = faster * ahead_x
                    change_y = faster * ahead_y
            if why == FREE and off > 1e-6:
                why = LIMITED
        twists[i, 0] = speed
        twists[i, 1] = turn
        deviation[i, 0] = off
        if off > 0.0:
            deviation[i, 2] = change_x
            deviation[i, 3] = change_y
            deviation[i, 1] += off * dt_s if math.isfinite(off) else 0.0
        before = verdict[i]
        news += why != before and (why > LIMITED or before > LIMITED)
        verdict[i] = why
    return news


class SafetyFilter:
    """The filter of n robots.

    Attributes
    ----------
    deviation_m_s : (n,) how far the velocity let through is from the desired one now: the greater of what the
        projection changed and what was taken off the speed along the heading
    deviation_m : (n,) the same added up over time since the start
    change_m_s : (n, 2) the difference, let through minus desired, world frame; old where `deviation_m_s` is zero
    verdict : (n,) FREE, LIMITED, or why it brakes: a key of `EXPLAIN`
    given : the arrays of the last tick; None before the first one
    reach_m, bounds_m : how far obstacles are sensed; (4,) the arena
    commands : those that have no effect yet; to be updated in each tick if there are `any`
    stall_s : by how much the next tick may come late, see :mod:`fullswarm.agent.safety.stalls`; the node's to set
    """

    def __init__(
        self, ids: Sequence[str], robots: RobotParams, tuning: Tuning, bounds_m: Array,
        objects: Objects | None = None,
    ) -> None:  # fmt: skip
        count = len(ids)
        self._ids, self._tuning = ids, tuning
        self._objects = objects or no_objects()
        self.reach_m, self.bounds_m = tuning.reach_m, bounds_m
        self._last_s, self.stall_s = math.inf, 0.0
        self._logged_s: dict[int, float] = {}
        deviation = np.zeros((count, 4))
        self.deviation_m_s, self.deviation_m, self.change_m_s = deviation[:, 0], deviation[:, 1], deviation[:, 2:]
        self.verdict = np.zeros(count, np.int64)
        self._held = np.zeros(count, bool)
        scratch = np.empty((len(HalfPlanes._fields), MAX_ROWS))
        self._robots, self._planes = robots, HalfPlanes(*scratch)
        # Plain Python reads lists still faster than views.
        self._robots_viewed, self._planes_listed = views(robots), HalfPlanes._make(scratch.tolist())
        self.commands = Commands(robots.dead_time_s, robots.accel, robots.turn_accel, tuning.period_s)
        self._deviation = deviation
        self.given: Given | None = None
        self._measured: Measured | None = None
        self._measured_viewed: Measured
        self._guard: Callable[[Measured, float, float, float], int]

    def apply(
        self, now_s: float, requested: Requested, measured: Measured, near: Nearby, obstacles: Array, twist: Array
    ) -> None:
        """Write the twists of all robots with a desired motion into `twist` (n, 2); see :func:`guard`."""
        dt_s = clamp.plain(now_s - self._last_s, 0.0, LONGEST_S)  # for one number faster than compiled
        self._last_s = now_s
        given = self.given
        if (
            given is None or near is not given.near or obstacles is not given.arena.obstacles
            or requested is not given.requested or twist is not given.out.twist
        ):  # fmt: skip
            self._take(requested, near, obstacles, twist)
        if guard.run is guard.plain:
            if measured is not self._measured:
                self._measured, self._measured_viewed = measured, views(measured)
            measured = self._measured_viewed
        if self._guard(measured, now_s, dt_s, self.stall_s):
            self._log_braking(now_s)

    def _take(self, requested: Requested, near: Nearby, obstacles: Array, twist: Array) -> None:
        """Keep these arrays or their views; they seldom are others than in the tick before, and views cost time."""
        arena, out = Arena(obstacles, self.bounds_m), Filtered(twist, self._deviation, self.verdict, self._held)
        self.given = given = Given(
            self._robots, self.commands.underway, requested, near, arena, self._objects, out, self._planes
        )  # fmt: skip
        if guard.run is guard.plain:
            given = Given(
                self._robots_viewed, views(self.commands.underway), views(requested), views(near), views(arena),
                views(self._objects), views(out), self._planes_listed,
            )  # fmt: skip
        self._guard = bound(partial(guard.run, self._tuning, *given))

    def note(self, row: int) -> str:
        """Return why the filter brakes robot `row`; empty when it does not."""
        return EXPLAIN[int(self.verdict[row])]

    def report(self, filtered: Flags) -> tuple[list[float], list[float], list[str]]:
        """Return `deviation_m_s`, `deviation_m` and the notes of all robots; nothing new of those not `filtered`."""
        now: list[float] = np.where(filtered, self.deviation_m_s, 0.0).tolist()
        notes = [""] * len(filtered)
        for row in np.flatnonzero(filtered & (self.verdict > LIMITED)).tolist():
            notes[row] = self.note(row)
        total: list[float] = self.deviation_m.tolist()
        return now, total, notes

    def _log_braking(self, now_s: float) -> None:
        """Log which robots brake and why, each reason once in `QUIET_S`: in a crowd it is often so."""
        for why in np.unique(self.verdict[self.verdict > LIMITED]).tolist():
            if now_s - self._logged_s.get(why, -math.inf) >= QUIET_S:
                self._logged_s[why] = now_s
                rows = np.flatnonzero(self.verdict == why).tolist()
                log.log(LEVEL[why], EXPLAIN[why], robots=[self._ids[row] for row in rows[:FEW]], count=len(rows))
