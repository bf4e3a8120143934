"""The filter of n robots from tick to tick: what it lets through, how far that is from the wish, why it brakes."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import structlog

from fullswarm.agent.safety.barrier import MAX_ROWS, half_planes, interval, project
from fullswarm.agent.safety.braking import stoppable, towards
from fullswarm.drivers.base import Description
from fullswarm.geometry import clamp, unicycle
from fullswarm.kernels import Array, Flags, Index, kernel

log = structlog.get_logger()

FREE, LIMITED, BLIND, CROWDED, TOO_FAST = range(5)
EXPLAIN = {
    FREE: "",
    LIMITED: "",
    BLIND: "the filter brakes: the robot's pose or motion is not known",
    CROWDED: "the filter brakes: a robot is said to be at this one's place, or too much is near to look at",
    TOO_FAST: "the filter brakes: something is so near that the robot cannot stop before its margin",
}
LEVEL = {BLIND: logging.WARNING, CROWDED: logging.WARNING, TOO_FAST: logging.INFO}
LONGEST_S = 0.1
"""A wish counts for so long at most in the way that the filter has taken."""
QUIET_S = 10.0
FEW = 5


@kernel
def guard(
    now_s: float, dt_s: float, period_s: float, speed_gain: float, turn_gain_per_s: float, reach_m: float,
    wished: Array, filtered: Flags, pose: Array, motion: Array, stamp_s: Array, gain: Array, margin_m: Array,
    start: Index, other: Index, places: Array, heard: Array, spread_m: Array, blur_m: Array, obstacles: Array,
    twists: Array, make: Array, bounds_m: Array, deviation: Array, verdict: Index, normal_x: Array, normal_y: Array,
    limits: Array, blur: Array, room: Array,
) -> int:  # fmt: skip
    """Map wished planar velocities to unicycle twists, behind the filter where `filtered` says so.

    Parameters
    ----------
    dt_s, period_s : since the last call; how long the answer is in force
    reach_m : obstacles farther than this are not sensed
    wished : (n, 2) m/s, world frame; NaN: no such wish, the robot's twist in `twists` is the wish
    filtered : (n,) behind the filter or straight through the paper's map
    pose, motion, stamp_s : (n, 3), (n, 2) m/s and rad/s, (n,): as measured, and when
    gain, margin_m : (n,) γ in 1/s and the gap to keep
    start, other, places, heard, spread_m, blur_m : neighbours (see :mod:`fullswarm.agent.neighbours.estimates`)
    obstacles, bounds_m : (k, 6) rounded boxes; (4,) x_min, y_min, x_max, y_max
    twists : (n, 2) in and out, m/s and rad/s
    make : (n, 8) of each robot: radius, greatest and least speed, turn rate, acceleration, turn acceleration, and how
        much farther than these accelerations say a stop goes: seconds of its speed, and m at most
    deviation, verdict : (n, 4), (n,) out, see :class:`SafetyFilter`; the vector is old where there is no deviation
    normal_x, normal_y, limits, blur, room : room for one robot's constraints

    Returns
    -------
    int
        How many verdicts became or ceased to be one of those that brake.
    """
    news = 0
    for i in range(wished.shape[0]):
        ux = wished[i, 0]
        uy = wished[i, 1]
        planar = not (math.isnan(ux) or math.isnan(uy))
        top = make[i, 1]
        low = make[i, 2]
        turn_limit = make[i, 3]
        if not filtered[i]:
            if planar:
                size = math.hypot(ux, uy)
                scale = top / size if size > top else 1.0
                speed, turn = unicycle(scale * ux, scale * uy, pose[i, 2], speed_gain, turn_gain_per_s)
                twists[i, 0] = clamp(speed, low, top)
                twists[i, 1] = clamp(turn, -turn_limit, turn_limit)
            if verdict[i] != FREE:
                news += verdict[i] > LIMITED
                verdict[i] = FREE
                deviation[i, 0] = 0.0
            continue
        x = pose[i, 0]
        y = pose[i, 1]
        heading = pose[i, 2]
        speed_now = motion[i, 0]
        turn_now = motion[i, 1]
        accel = make[i, 4]
        age = now_s - stamp_s[i]
        count = 0
        why = FREE
        if not math.isfinite(x + y + heading + speed_now + turn_now + age):
            why = BLIND
        else:
            # Where it has got to since it was measured: it may have sped up or turned, too.
            age = max(age, 0.0)
            unsure_m = min(math.fabs(speed_now) + 0.5 * accel * age, max(top, math.fabs(speed_now))) * age
            overrun_m = min(make[i, 6] * math.fabs(speed_now), make[i, 7])
            count = half_planes(
                x, y, reach_m, make[i, 0] + margin_m[i] + overrun_m, unsure_m, gain[i], top, start[i],
                start[i + 1], other, places, heard, spread_m, blur_m, obstacles, bounds_m, normal_x, normal_y, limits,
                blur, room,
            )  # fmt: skip
            if count < 0:
                why = CROWDED
        if why != FREE:
            off = math.hypot(ux, uy) if planar else math.fabs(twists[i, 0])
            deviation[i, 2] = -ux if planar else -twists[i, 0] * math.cos(heading)
            deviation[i, 3] = -uy if planar else -twists[i, 0] * math.sin(heading)
            twists[i, 0] = 0.0
            twists[i, 1] = 0.0
        else:
            off = 0.0
            ahead_x = math.cos(heading) if count > 0 else 0.0
            ahead_y = math.sin(heading) if count > 0 else 0.0
            wish_speed = twists[i, 0]
            speed = wish_speed
            turn = twists[i, 1]
            if planar:
                size = math.hypot(ux, uy)
                if size > top:
                    ux *= top / size
                    uy *= top / size
                wish_x = ux
                wish_y = uy
                if count > 0:
                    ux, uy = project(ux, uy, normal_x, normal_y, limits, count)
                    off = math.hypot(ux - wish_x, uy - wish_y)
                    deviation[i, 2] = ux - wish_x
                    deviation[i, 3] = uy - wish_y
                speed, turn = unicycle(ux, uy, heading, speed_gain, turn_gain_per_s)
                wish_speed = speed
                if off > 0.0:  # what the unicycle map makes of the wish, without its arctangents
                    wish_speed = speed_gain * (wish_x * ahead_x + wish_y * ahead_y)
            wish_speed = clamp(wish_speed, low, top)
            turn = clamp(turn, -turn_limit, turn_limit)
            if count == 0:
                speed = wish_speed
            else:
                low, high = interval(ahead_x, ahead_y, low, top, normal_x, normal_y, limits, blur, count)
                speed, turn, fits = stoppable(
                    heading, clamp(speed, low, high), turn, speed_now, turn_now, accel, make[i, 5], period_s,
                    normal_x, normal_y, room, blur, count,
                )  # fmt: skip
                why = FREE if fits else TOO_FAST
                step = accel * period_s
                faster = towards(speed_now, speed, step) - towards(speed_now, wish_speed, step)
                if math.fabs(faster) > off:
                    off = math.fabs(faster)
                    deviation[i, 2] = faster * ahead_x
                    deviation[i, 3] = faster * ahead_y
            if why == FREE and off > 1e-6:
                why = LIMITED
            twists[i, 0] = speed
            twists[i, 1] = turn
        deviation[i, 0] = off
        if off > 0.0 and math.isfinite(off):
            deviation[i, 1] += off * dt_s
        news += why != verdict[i] and (why > LIMITED or verdict[i] > LIMITED)
        verdict[i] = why
    return news


class SafetyFilter:
    """The filter of n robots.

    Attributes
    ----------
    deviation_m_s : (n,) how far the velocity let through is from the wished one now: the greater of what the
        projection changed and what was taken off the speed along the heading
    deviation_m : (n,) the same added up over time since the start
    change_m_s : (n, 2) which way: let through minus wished, world frame; old where `deviation_m_s` is zero
    verdict : (n,) FREE, LIMITED, or why it brakes: a key of `EXPLAIN`
    seen : the neighbours and obstacles of the last tick, as they were given
    reach_m, bounds_m : how far obstacles are sensed; (4,) the arena
    """

    def __init__(
        self, ids: Sequence[str], descriptions: Sequence[Description], speed_limit: Array, turn_limit: Array,
        reverse: Flags, period_s: float, reach_m: float, bounds_m: Array, gains: tuple[float, float],
    ) -> None:  # fmt: skip
        count = len(descriptions)
        self._ids = ids
        self._gains, self._period_s, self.reach_m = gains, period_s, reach_m
        self._last_s = math.inf
        self._told_s: dict[int, float] = {}
        self.seen: tuple[tuple[Index, Index], tuple[Array, Array, Array, Array], Array]
        deviation = np.zeros((count, 4))
        self.deviation_m_s, self.deviation_m, self.change_m_s = deviation[:, 0], deviation[:, 1], deviation[:, 2:]
        self.verdict = np.zeros(count, np.int64)
        make = np.column_stack(
            (
                [each.radius_m for each in descriptions], speed_limit, np.where(reverse, -speed_limit, 0.0), turn_limit,
                [each.limits.accel_m_s2 for each in descriptions],
                [each.limits.turn_accel_rad_s2 for each in descriptions],
                [each.limits.overrun_s for each in descriptions],
                [each.limits.overrun_m for each in descriptions],
            )
        )  # fmt: skip
        scratch = np.empty((5, MAX_ROWS))
        self.bounds_m = bounds_m
        shared: tuple[Any, ...] = (make, bounds_m, deviation, self.verdict)
        self._own: tuple[Any, ...] = (*shared, *scratch)
        # Views give Python's own numbers, and lists do so faster still: a kernel in plain Python takes half the time.
        self._plain: tuple[Any, ...] = (*(memoryview(each) for each in shared), *scratch.tolist())
        self._given: tuple[Any, ...] = ()
        self._views: list[Any] = []

    def apply(
        self, now_s: float, wished: Array, filtered: Flags, pose: Array, motion: Array, stamp_s: Array,
        gain: Array, margin_m: Array, near: tuple[Index, Index], heard: tuple[Array, Array, Array, Array],
        obstacles: Array, twists: Array,
    ) -> None:  # fmt: skip
        """Write the twists of all robots with a wish into `twists` (n, 2); see :func:`guard`.

        Parameters
        ----------
        stamp_s : (n,) when `pose` and `motion` were measured
        near : ``Neighbours.around``
        heard : ``Neighbours.believed``
        """
        dt_s = clamp(now_s - self._last_s, 0.0, LONGEST_S)
        self._last_s = now_s
        self.seen = near, heard, obstacles
        given: Any = (wished, filtered, pose, motion, stamp_s, gain, margin_m, *near, *heard, obstacles, twists)
        own, run = self._own, cast(Any, guard.run)
        if run is guard.plain:
            given, own = self._viewed(given), self._plain
        if run(now_s, dt_s, self._period_s, *self._gains, self.reach_m, *given, *own):
            self._tell(now_s)

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

    def _viewed(self, given: tuple[Any, ...]) -> list[Any]:
        """Return views of the arrays given; most are the same in each tick, and a new view costs more than a look."""
        if not self._given:
            self._views = [memoryview(array) for array in given]
        else:
            for place, array in enumerate(given):
                if array is not self._given[place]:
                    self._views[place] = memoryview(array)
        self._given = given
        return self._views

    def _tell(self, now_s: float) -> None:
        """Log which robots brake and why, each reason once in `QUIET_S`: in a crowd it is often so."""
        for why in np.unique(self.verdict[self.verdict > LIMITED]).tolist():
            if now_s - self._told_s.get(why, -math.inf) >= QUIET_S:
                self._told_s[why] = now_s
                rows = np.flatnonzero(self.verdict == why).tolist()
                log.log(LEVEL[why], EXPLAIN[why], robots=[self._ids[row] for row in rows[:FEW]], count=len(rows))
