"""The filter of n robots from tick to tick: what it lets through, how far that is from the wish, why it brakes."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import structlog
from numpy.typing import NDArray

from fullswarm.agent.safety.barrier import MAX_ROWS, half_planes, interval, project
from fullswarm.agent.safety.braking import stoppable, towards
from fullswarm.drivers.base import Description
from fullswarm.geometry import clamp, unicycle
from fullswarm.kernels import kernel

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Flags = NDArray[np.bool_]

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
    dt_s: float, period_s: float, wished: Array, filtered: Flags, pose: Array, motion: Array, age_s: Array,
    make: Array, speed_gain: float, turn_gain_per_s: float, gain: Array, margin_m: Array, reach_m: float, start: Index,
    other: Index, places: Array, heard: Array, spread_m: Array, blur_m: Array, obstacles: Array, bounds_m: Array,
    twists: Array, deviation: Array, verdict: Index, normals: Array, limits: Array,
    blur: Array, room: Array,
) -> int:  # fmt: skip
    """Map wished planar velocities to unicycle twists, behind the filter where `filtered` says so.

    Parameters
    ----------
    dt_s, period_s : since the last call; how long the answer is in force
    wished : (n, 2) m/s, world frame; NaN: no such wish, the robot's twist in `twists` is the wish
    filtered : (n,) behind the filter or straight through the paper's map
    pose, motion, age_s : (n, 3), (n, 2) m/s and rad/s, (n,): as measured, and how old that is
    make : (n, 6) of each robot: radius, greatest and least speed, turn rate, acceleration, turn acceleration
    gain, margin_m : (n,) γ in 1/s and the gap to keep
    reach_m : obstacles farther than this are not sensed
    start, other, places, heard, spread_m, blur_m : neighbours (see :mod:`fullswarm.agent.pairs`)
    obstacles, bounds_m : (k, 6) rounded boxes; (4,) x_min, y_min, x_max, y_max
    twists : (n, 2) in and out, m/s and rad/s
    deviation, verdict : (n, 2), (n,) out, see :class:`SafetyFilter`
    normals, limits, blur, room : room for one robot's constraints

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
            if verdict[i] != 0:
                news += verdict[i] > 1
                verdict[i] = 0
                deviation[i, 0] = 0.0
            continue
        heading = pose[i, 2]
        speed_now = motion[i, 0]
        turn_now = motion[i, 1]
        accel = make[i, 4]
        count = 0
        why = 0
        if not math.isfinite(pose[i, 0] + pose[i, 1] + heading + speed_now + turn_now + age_s[i]):
            why = 2
        else:
            # Where it has got to since it was measured: it may have sped up or turned, too.
            age = max(age_s[i], 0.0)
            unsure_m = min(math.fabs(speed_now) + 0.5 * accel * age, max(top, math.fabs(speed_now))) * age
            count = half_planes(
                pose[i, 0], pose[i, 1], reach_m, make[i, 0] + margin_m[i], unsure_m, gain[i], top, start[i],
                start[i + 1], other, places, heard, spread_m, blur_m, obstacles, bounds_m, normals, limits, blur, room,
            )  # fmt: skip
            if count < 0:
                why = 3
        if why != 0:
            off = math.hypot(ux, uy) if planar else math.fabs(twists[i, 0])
            twists[i, 0] = 0.0
            twists[i, 1] = 0.0
        else:
            off = 0.0
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
                    ux, uy = project(ux, uy, normals, limits, count)
                    off = math.hypot(ux - wish_x, uy - wish_y)
                speed, turn = unicycle(ux, uy, heading, speed_gain, turn_gain_per_s)
                wish_speed = speed
                if off > 0.0:  # what the unicycle map makes of the wish, without its arctangents
                    wish_speed = speed_gain * (wish_x * math.cos(heading) + wish_y * math.sin(heading))
            wish_speed = clamp(wish_speed, low, top)
            turn = clamp(turn, -turn_limit, turn_limit)
            if count == 0:
                speed = wish_speed
            else:
                low, high = interval(heading, low, top, normals, limits, blur, count)
                speed, turn, fits = stoppable(
                    heading, clamp(speed, low, high), turn, speed_now, turn_now, accel, make[i, 5], period_s,
                    normals, room, blur, count,
                )  # fmt: skip
                if not fits:
                    why = 4
                step = accel * period_s
                slower = math.fabs(towards(speed_now, wish_speed, step) - towards(speed_now, speed, step))
                off = max(off, slower)
            if why == 0 and off > 1e-6:
                why = 1
            twists[i, 0] = speed
            twists[i, 1] = turn
        deviation[i, 0] = off
        if off > 0.0 and math.isfinite(off):
            deviation[i, 1] += off * dt_s
        news += why != verdict[i] and (why > 1 or verdict[i] > 1)
        verdict[i] = why
    return news


def plain(array: Any) -> Any:
    """Return a view that gives Python's own numbers: in plain Python a kernel counts twice as fast with them."""
    return memoryview(array)


class SafetyFilter:
    """The filter of n robots.

    Attributes
    ----------
    deviation_m_s : (n,) how far the velocity let through is from the wished one now: the greater of what the
        projection changed and what was taken off the speed along the heading
    deviation_m : (n,) the same added up over time since the start
    verdict : (n,) FREE, LIMITED, or why it brakes: a key of `EXPLAIN`
    """

    def __init__(
        self, ids: Sequence[str], descriptions: Sequence[Description], speed_limit: Array, turn_limit: Array,
        reverse: Flags, period_s: float, reach_m: float, bounds_m: Array, gains: tuple[float, float],
    ) -> None:  # fmt: skip
        count = len(descriptions)
        self._ids = ids
        self._gains, self._period_s, self._reach_m = gains, period_s, reach_m
        self._last_s = math.inf
        self._told_s: dict[int, float] = {}
        deviation = np.zeros((count, 2))
        self.deviation_m_s, self.deviation_m = deviation[:, 0], deviation[:, 1]
        self.verdict = np.zeros(count, np.int64)
        self._make = np.column_stack(
            (
                [each.radius_m for each in descriptions], speed_limit, np.where(reverse, -speed_limit, 0.0), turn_limit,
                [each.limits.accel_m_s2 for each in descriptions],
                [each.limits.turn_accel_rad_s2 for each in descriptions],
            )
        )  # fmt: skip
        scratch = np.empty((MAX_ROWS, 2)), np.empty(MAX_ROWS), np.empty(MAX_ROWS), np.empty(MAX_ROWS)
        self._out: tuple[Any, ...] = (deviation, self.verdict, *scratch)
        self._bounds_m = bounds_m
        self._plain = (plain(self._make), plain(bounds_m), tuple(map(plain, self._out)))

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
        given: tuple[Any, ...] = (wished, filtered, pose, motion, now_s - stamp_s)
        settings: tuple[Any, ...] = (gain, margin_m)
        neighbours: tuple[Any, ...] = (*near, *heard, obstacles)
        make, bounds_m, out = self._make, self._bounds_m, self._out
        if guard.run is guard.plain:
            make, bounds_m, out = self._plain
            given, settings = tuple(map(plain, given)), tuple(map(plain, settings))
            neighbours, twists = tuple(map(plain, neighbours)), plain(twists)
        columns = (*given, make, *self._gains, *settings, self._reach_m, *neighbours, bounds_m, twists, *out)
        run: Any = guard.run
        if run(dt_s, self._period_s, *columns):
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

    def _tell(self, now_s: float) -> None:
        """Log who brakes and why, each reason not again before `QUIET_S` have passed: in a crowd it is often so."""
        for why in np.unique(self.verdict[self.verdict > LIMITED]).tolist():
            if now_s - self._told_s.get(why, -math.inf) >= QUIET_S:
                self._told_s[why] = now_s
                rows = np.flatnonzero(self.verdict == why).tolist()
                log.log(LEVEL[why], EXPLAIN[why], robots=[self._ids[row] for row in rows[:FEW]], count=len(rows))
