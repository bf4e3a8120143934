"""Finds what bars motion without any message: battery, pose, geofence, clock and driver; and judges standstill.

Arrays over n robots. The robot controller reads them each tick; nothing here depends on the network.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.motion.robot_controller import StopReason, explain_hazards
from fullswarm.agent.safety.dead_time import Underway
from fullswarm.agent.state import AgentState
from fullswarm.drivers.base import Description, Fleet, FleetReading, Hazard, Lifecycle
from fullswarm.geometry import wrap
from fullswarm.kernels import Array, Flags, Index, bound, kernel
from fullswarm.reasons import Code, Reason, given, reason

BATTERY_LOW = int(Hazard.BATTERY_LOW)
BASE_CHANGED = "its base left the driving mode and reports no fault; see its buttons, its switches and its driver's log"


@dataclass(frozen=True, slots=True)
class Thresholds:
    """When the reflexes act."""

    battery_low: float = 0.1  # fraction; below it a robot ends its task and accepts none
    battery_rise: float = 0.05  # charged by so much above that, it may drive again
    fence_margin_m: float = 0.0  # how far outside the arena a robot's centre may be
    fence_delay_s: float = 0.15  # from seeing to braking, for the distance at which braking begins


class InspectionLimits(NamedTuple):
    """Up to which sigma (n,) a position is good enough, and from and up to which charge a battery is low."""

    sigma_m: Array
    battery_low: float
    battery_risen: float


class Unfit(NamedTuple):
    """What :func:`inspect` fills, (n,) each; see :class:`Reflexes`."""

    pose_unknown: Flags
    pose_uncertain: Flags
    battery_low: Flags


class Geofence(NamedTuple):
    """Bounds of the centres, m; accelerations (n,) m/s²; and the delay from seeing to braking in s."""

    bounds_m: tuple[float, float, float, float]
    accel_m_s2: Array
    delay_s: float


class SpeedBounds(NamedTuple):
    """What :func:`geofence` fills, (n,) m/s each: the least and the greatest speed that it allows."""

    floor: Array
    ceiling: Array


class Reflexes:
    """Battery, pose, geofence and clock of n robots.

    Parameters
    ----------
    accel_m_s2 : (n,) how hard each robot brakes
    sigma_limit_m : (n,) up to which sigma of its position a robot may drive; default: any

    Attributes
    ----------
    battery_low : (n,) the battery is too low to drive
    pose_unknown : (n,) the estimator knows no finite pose
    pose_uncertain : (n,) the driver states a position that is less certain than `sigma_limit_m`
    clock_jumped : the clock jumped a moment ago (suspend or stall); the data at hand may be old
    floor, ceiling : (n,) m/s, the least and the greatest speed that the geofence allows
    """

    def __init__(
        self,
        bounds_m: tuple[float, float, float, float],
        thresholds: Thresholds,
        accel_m_s2: Array,
        sigma_limit_m: Array | None = None,
    ) -> None:
        count, margin_m, low = len(accel_m_s2), thresholds.fence_margin_m, thresholds.battery_low
        x_min, y_min, x_max, y_max = bounds_m
        bounds = (x_min - margin_m, y_min - margin_m, x_max + margin_m, y_max + margin_m)
        fence = Geofence(bounds, accel_m_s2, thresholds.fence_delay_s)
        sigma_m = np.full(count, math.inf) if sigma_limit_m is None else sigma_limit_m
        limits = InspectionLimits(sigma_m, battery_low=low, battery_risen=low + thresholds.battery_rise)
        unfit = Unfit(np.zeros(count, bool), np.zeros(count, bool), np.zeros(count, bool))
        self.pose_unknown, self.pose_uncertain, self.battery_low = unfit
        speeds = SpeedBounds(floor=np.full(count, -math.inf), ceiling=np.full(count, math.inf))
        self.floor, self.ceiling = speeds
        self._underway = Underway(*np.zeros((len(Underway._fields), count)))
        self._inspect = bound(partial(inspect.run, limits, unfit), viewed=True)
        self._bound_speeds = bound(partial(geofence.run, fence, speeds), viewed=True)
        self.clock_jumped = False
        self._jump_over_s = -math.inf

    def update(self, reading: FleetReading, pose: Array) -> None:
        """Take a reading and the poses (n, 3) estimated from it."""
        self._inspect(pose, reading.position_sigma_m, reading.battery, reading.hazards)

    def watch_clock(self, now_s: float, before_s: float, patience_s: float) -> None:
        """Compare the times of two ticks: after a jump of the clock the robot is held for `patience_s`.

        Messages that waited in sockets meanwhile arrive with a new stamp although they are old; they are to be replaced
        by then.
        """
        if now_s - before_s > patience_s or now_s < before_s:
            self._jump_over_s = now_s + patience_s
        self.clock_jumped = now_s < self._jump_over_s

    def watch_geofence(self, pose: Array, twist: Array, desired: Array, underway: Underway | None = None) -> None:
        """Compute between which speeds desired twists (n, 2) stay within the arena, or lead back into it.

        `twist` (n, 2) is the measured motion; `underway`: what commands will still do that have no effect yet.
        """
        before = self._underway if underway is None else underway
        self._bound_speeds(pose, twist, desired, before.way, before.swing, before.speed)


@kernel
def inspect(
    limits: InspectionLimits, unfit: Unfit, pose: Array, sigma_m: Array, battery: Array, hazards: NDArray[np.uint8]
) -> None:
    """Fill `pose_unknown` and `pose_uncertain` and update `battery_low`. A battery of -1 or a NaN sigma: unknown."""
    sigma_limit_m, low, risen = limits
    pose_unknown, pose_uncertain, battery_low = unfit
    for i in range(pose.shape[0]):
        pose_unknown[i] = not math.isfinite(pose[i, 0] + pose[i, 1] + pose[i, 2])
        pose_uncertain[i] = sigma_m[i] > sigma_limit_m[i]
        warned = int(hazards[i]) & BATTERY_LOW != 0
        battery_low[i] = warned or 0.0 <= battery[i] < low or (battery_low[i] and battery[i] < risen)


@kernel
def geofence(
    fence: Geofence, speeds: SpeedBounds, pose: Array, twist: Array, desired: Array, underway_m: Array, swing: Array,
    then_m_s: Array,
) -> None:  # fmt: skip
    """Fill `speeds` with those that can be braked to zero before the centre crosses an edge.

    For each edge: v² / 2a + v · delay <= distance / cos, where cos is of the angle between the motion and the
    edge's normal, the worst one that the measured or desired turn rate can reach until the robot is at standstill.
    A robot that drives along an edge and then begins to turn towards it may cross it by its braking distance.
    `underway_m`, `swing`, `then_m_s`: (n,) length (m) and turn (rad) of the path that earlier commands will still have
    it drive, and the speed at its end.
    """
    bounds, accel_m_s2, delay_s = fence
    floor, ceiling = speeds
    for i in range(pose.shape[0]):
        floor[i] = -math.inf
        ceiling[i] = math.inf
        x = pose[i, 0]
        y = pose[i, 1]
        yaw = pose[i, 2]
        desired_speed = desired[i, 0]
        desired_turn = desired[i, 1]
        if not math.isfinite(x + y + yaw + desired_speed + desired_turn):
            continue
        accel = accel_m_s2[i]
        speed = max(math.fabs(twist[i, 0]), math.fabs(desired_speed))
        turned = max(math.fabs(twist[i, 1]), math.fabs(desired_turn)) * (delay_s + speed / accel) + swing[i]
        gone_m = underway_m[i]
        if gone_m > 0.0:  # in the delay it is still as fast as before the path
            gone_m += delay_s * max(0.0, math.fabs(twist[i, 0]) - math.fabs(then_m_s[i]))
        nearest = min(x - bounds[0], y - bounds[1], bounds[2] - x, bounds[3] - y)
        if nearest - gone_m > speed * delay_s + speed * speed / (2.0 * accel):
            continue
        for side in range(4):
            centre = x if side % 2 == 0 else y
            if side < 2:
                room = centre - bounds[side]
                normal = math.pi if side == 0 else -0.5 * math.pi
            else:
                room = bounds[side] - centre
                normal = 0.0 if side == 2 else 0.5 * math.pi
            for way in range(2):
                heading = yaw + (0.0 if way == 0 else math.pi)
                off = math.fabs(wrap(heading - normal))
                # Outside, turning must stay free, or no robot could turn round and drive back.
                outward = math.cos(max(0.0, off - turned) if room > 0.0 else off)
                if outward <= 1e-9:  # along the edge, but for rounding
                    continue
                way_m = max(0.0, room - gone_m) / outward
                top = accel * (math.sqrt(delay_s * delay_s + 2.0 * way_m / accel) - delay_s)
                if way == 0:
                    ceiling[i] = min(ceiling[i], top)
                else:
                    floor[i] = max(floor[i], -top)


# Columns of the noise of a robot at standstill, and of a kept reading.
SPEED, TURN, WINDOW, WAY, ANGLE = range(5)
STAMP, X, Y, HEADING, LINEAR, ANGULAR = range(6)
ROUNDING_S = 1e-6


class Window(NamedTuple):
    """The last `held` (n,) readings of each robot, in a ring (n, k, 6) with the newest one at `newest` (n,)."""

    past: Array
    newest: Index
    held: Index


class Judgement(NamedTuple):
    """What :func:`judge` fills, (n,) each; see :class:`Standstill`."""

    at_standstill: Flags
    since_s: Array


class Standstill:
    """Judges whether each robot is at standstill, by its odometry and measured velocity over a window.

    One judgement for health reports and e-stop receipts. A velocity alone is not enough: the filter of an autopilot may
    show 0.05 m/s of a vehicle at standstill and none of one that creeps; its position does not wander as fast.

    Parameters
    ----------
    rate_hz : readings are taken in so often at most

    Attributes
    ----------
    at_standstill : (n,) as judged by the newest readings; True before the first
    since_s : (n,) stamp of the oldest reading of that window; inf while it is False
    """

    def __init__(self, descriptions: Sequence[Description], rate_hz: float) -> None:
        count, noise = len(descriptions), [each.standstill for each in descriptions]
        noise_of = np.array(
            [[each.speed_m_s, each.turn_rad_s, each.window_s, each.way_m, each.angle_rad] for each in noise]
        ).reshape(count, 5)
        depth = 2 + math.ceil(max((each.window_s for each in noise), default=0.0) * rate_hz)
        past = np.full((count, depth, 6), -math.inf)
        window = Window(past, newest=np.zeros(count, np.int64), held=np.zeros(count, np.int64))
        judgement = Judgement(np.ones(count, bool), np.full(count, math.inf))
        self.at_standstill, self.since_s = judgement
        self._judge = bound(partial(judge.run, window, judgement, noise_of), viewed=True)

    def update(self, reading: FleetReading) -> None:
        """Take the newest readings; one that was taken before changes nothing."""
        self._judge(reading.stamp_s, reading.odometry, reading.twist)


@kernel
def judge(window: Window, judgement: Judgement, noise: Array, stamp_s: Array, odometry: Array, twist: Array) -> None:
    """Take a reading of each robot into `window` if it is new, and fill `judgement`; `noise` (n, 5)."""
    past, newest, held = window
    at_standstill, since_s = judgement
    depth = past.shape[1]
    for i in range(stamp_s.shape[0]):
        now_s = stamp_s[i]
        if not now_s > past[i, newest[i], STAMP]:
            continue
        head = (newest[i] + 1) % depth
        newest[i] = head
        held[i] = min(held[i] + 1, depth)
        x = odometry[i, 0]
        y = odometry[i, 1]
        heading = odometry[i, 2]
        past[i, head, STAMP] = now_s
        past[i, head, X] = x
        past[i, head, Y] = y
        past[i, head, HEADING] = heading
        past[i, head, LINEAR] = twist[i, 0]
        past[i, head, ANGULAR] = twist[i, 1]
        still = False
        speed = 0.0
        turn = 0.0
        count = 0
        oldest_s = now_s
        for back in range(held[i]):
            at = (head - back) % depth
            way_m = math.hypot(past[i, at, X] - x, past[i, at, Y] - y)
            if not way_m <= noise[i, WAY] or math.fabs(wrap(past[i, at, HEADING] - heading)) > noise[i, ANGLE]:
                break
            speed += past[i, at, LINEAR]
            turn += past[i, at, ANGULAR]
            count += 1
            oldest_s = past[i, at, STAMP]
            if now_s - oldest_s >= noise[i, WINDOW] - ROUNDING_S:
                still = True
                break
        if still:
            still = math.fabs(speed) < noise[i, SPEED] * count and math.fabs(turn) < noise[i, TURN] * count
        at_standstill[i] = still
        since_s[i] = oldest_s if still else math.inf


ENDING = [StopReason.DRIVER, StopReason.HAZARD, StopReason.BATTERY, StopReason.OVERLAP, StopReason.FRAME]


class DriverWatch:
    """Watches whether the drivers are ready, and ends the tasks of robots that must not drive on by themselves.

    The lifecycle is followed for one robot; the drivers of a swarm in lockstep are always ready.

    Attributes
    ----------
    ready : which drivers were READY or ACTIVE at the last call of `look`, (n,)
    """

    def __init__(
        self,
        fleet: Fleet,
        state: AgentState,
        drive_on: Flags,
        end_task: Callable[[int, Reason], None],
        conflict_of: Callable[[int], Reason],
    ) -> None:
        self._fleet, self._robots, self._drive_on = fleet, state, drive_on
        self._end_task, self._conflict_of = end_task, conflict_of
        self._state = Lifecycle.CLOSED
        self._been_ready = self._engaged = False

    def look(self) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        """Return which drivers are READY or ACTIVE, (n,)."""
        fleet = self._fleet
        if len(fleet.ids) == 1:
            state = fleet.lifecycle(0)
            self._robots.driver_ready[0] = state in (Lifecycle.READY, Lifecycle.ACTIVE)
            self._been_ready |= state in (Lifecycle.READY, Lifecycle.ACTIVE)
            self._watch_engaged(state)
        else:
            self._robots.driver_ready[:] = True
        return self._robots.driver_ready

    def _watch_engaged(self, state: Lifecycle) -> None:
        """End the task if the driver fell from ACTIVE to READY although the task goes on: a passing fault."""
        desired = bool(self._drive_on[0])
        if self._engaged and desired and state is Lifecycle.READY:
            fault = given(self._fleet.fault(0), self._fleet.fault_code(0))
            self._end_task(0, fault or reason(Code.DRIVER_STOPPED, cause=BASE_CHANGED))
        # Engaged by the present task: a driver that still ends an earlier one becomes READY on purpose.
        fresh = self._engaged or self._state is Lifecycle.READY
        self._engaged = desired and state is Lifecycle.ACTIVE and fresh
        self._state = state

    def end_unsafe_tasks(self, hazards: NDArray[np.uint8]) -> None:
        """End the tasks of robots that are stopped for a reason of `ENDING`; `hazards` (n,) of the newest reading."""
        reasons = self._robots.stop_reason
        for row in np.flatnonzero(np.isin(reasons, ENDING)).tolist():
            if reasons[row] in (StopReason.OVERLAP, StopReason.FRAME):
                self._end_task(row, self._conflict_of(row))
            elif reasons[row] == StopReason.HAZARD:
                self._end_task(row, explain_hazards(int(hazards[row]), self._fleet.fault(row))[0])
            elif reasons[row] == StopReason.BATTERY:
                self._end_task(row, reason(Code.BATTERY))
            elif self._been_ready and self._fleet.lifecycle(row) is Lifecycle.FAULT:
                # A driver that was never ready has not stopped a task: a base may be switched on late.
                self._end_task(row, reason(Code.DRIVER_FAILED, fault=self._fleet.fault(row)))
