"""Finds what bars motion without any message: battery, pose, geofence, clock and driver; and judges standstill.

Arrays over n robots. The robot controller reads them each tick; nothing here depends on the network.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.motion.robot_controller import StopReason, explain_hazards
from fullswarm.agent.state import AgentState
from fullswarm.drivers.base import Description, Fleet, FleetReading, Hazard, Lifecycle
from fullswarm.geometry import wrap
from fullswarm.kernels import Array, Flags, kernel
from fullswarm.reasons import Code, Reason, given, reason

BATTERY_LOW = int(Hazard.BATTERY_LOW)


@dataclass(frozen=True, slots=True)
class Thresholds:
    """When the reflexes act."""

    battery_low: float = 0.1  # fraction; below it a robot ends its task and accepts none
    battery_rise: float = 0.05  # charged by so much above that, it may drive again
    fence_margin_m: float = 0.0  # how far outside the arena a robot's centre may be
    fence_delay_s: float = 0.15  # from seeing to braking, for the distance at which braking begins


class Reflexes:
    """Battery, pose, geofence and clock of n robots.

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
        count: int,
        bounds_m: tuple[float, float, float, float],
        thresholds: Thresholds,
        sigma_limit_m: Array | None = None,
    ) -> None:
        margin_m = thresholds.fence_margin_m
        x_min, y_min, x_max, y_max = bounds_m
        self._geofence = np.array([x_min - margin_m, y_min - margin_m, x_max + margin_m, y_max + margin_m])
        self._thresholds = thresholds
        self.battery_low = np.zeros(count, bool)
        self.pose_unknown, self.pose_uncertain = np.zeros(count, bool), np.zeros(count, bool)
        self._sigma_limit_m = np.full(count, math.inf) if sigma_limit_m is None else sigma_limit_m
        self.clock_jumped = False
        self.floor, self.ceiling = np.full(count, -math.inf), np.full(count, math.inf)
        self._jump_over_s = -math.inf

    def update(self, reading: FleetReading, pose: Array) -> None:
        """Take a reading and the poses (n, 3) estimated from it."""
        low = self._thresholds.battery_low
        inspect.run(
            pose, reading.position_sigma_m, self._sigma_limit_m, reading.battery, reading.hazards, low,
            low + self._thresholds.battery_rise, self.pose_unknown, self.pose_uncertain, self.battery_low,
        )  # fmt: skip

    def watch_clock(self, now_s: float, before_s: float, patience_s: float) -> None:
        """Compare the times of two ticks: after a jump of the clock the robot is held for `patience_s`.

        Messages that waited in sockets meanwhile arrive with a new stamp although they are old; they are to be replaced
        by then.
        """
        if now_s - before_s > patience_s or now_s < before_s:
            self._jump_over_s = now_s + patience_s
        self.clock_jumped = now_s < self._jump_over_s

    def watch_geofence(self, pose: Array, twist: Array, desired: Array, accel_m_s2: Array) -> None:
        """Compute between which speeds desired twists (n, 2) stay within the arena, or lead back into it.

        `twist` (n, 2) is the measured motion.
        """
        geofence.run(
            pose, twist, desired, self._geofence, accel_m_s2, self._thresholds.fence_delay_s, self.floor, self.ceiling
        )


@kernel
def inspect(
    pose: Array, sigma_m: Array, sigma_limit_m: Array, level: Array, hazards: NDArray[np.uint8], low: float,
    risen: float, pose_unknown: Flags, pose_uncertain: Flags, battery_low: Flags,
) -> None:  # fmt: skip
    """Fill `pose_unknown` and `pose_uncertain` and update `battery_low` (n,). A level of -1 or a NaN sigma: unknown."""
    for i in range(pose.shape[0]):
        pose_unknown[i] = not math.isfinite(pose[i, 0] + pose[i, 1] + pose[i, 2])
        pose_uncertain[i] = sigma_m[i] > sigma_limit_m[i]
        warned = int(hazards[i]) & BATTERY_LOW != 0
        battery_low[i] = warned or 0.0 <= level[i] < low or (battery_low[i] and level[i] < risen)


@kernel
def geofence(
    pose: Array, twist: Array, desired: Array, bounds: Array, accel_m_s2: Array, delay_s: float, floor: Array,
    ceiling: Array,
) -> None:  # fmt: skip
    """Fill `floor` and `ceiling` (n,): speeds that can be braked to zero before the centre crosses an edge.

    For each edge: v² / 2a + v · delay <= distance / cos, where cos is of the angle between the motion and the
    edge's normal, the worst one that the measured or desired turn rate can reach until the robot is at standstill.
    A robot that drives along an edge and then begins to turn towards it may cross it by its braking distance.
    """
    for i in range(pose.shape[0]):
        floor[i] = -math.inf
        ceiling[i] = math.inf
        if not math.isfinite(pose[i, 0] + pose[i, 1] + pose[i, 2] + desired[i, 0] + desired[i, 1]):
            continue
        accel = accel_m_s2[i]
        speed = max(math.fabs(twist[i, 0]), math.fabs(desired[i, 0]))
        turned = max(math.fabs(twist[i, 1]), math.fabs(desired[i, 1])) * (delay_s + speed / accel)
        nearest = min(pose[i, 0] - bounds[0], pose[i, 1] - bounds[1], bounds[2] - pose[i, 0], bounds[3] - pose[i, 1])
        if nearest > speed * delay_s + speed * speed / (2.0 * accel):
            continue
        for side in range(4):
            if side < 2:
                room = pose[i, side] - bounds[side]
                normal = math.pi if side == 0 else -0.5 * math.pi
            else:
                room = bounds[side] - pose[i, side - 2]
                normal = 0.0 if side == 2 else 0.5 * math.pi
            for way in range(2):
                heading = pose[i, 2] + (0.0 if way == 0 else math.pi)
                off = math.fabs(wrap(heading - normal))
                # Outside, turning must stay free, or no robot could turn round and drive back.
                outward = math.cos(max(0.0, off - turned) if room > 0.0 else off)
                if outward <= 1e-9:  # along the edge, but for rounding
                    continue
                way_m = max(0.0, room) / outward
                top = accel * (math.sqrt(delay_s * delay_s + 2.0 * way_m / accel) - delay_s)
                if way == 0:
                    ceiling[i] = min(ceiling[i], top)
                else:
                    floor[i] = max(floor[i], -top)


# Columns of the noise of a robot at standstill, and of a kept reading.
SPEED, TURN, WINDOW, WAY, ANGLE = range(5)
STAMP, X, Y, HEADING, LINEAR, ANGULAR = range(6)
ROUNDING_S = 1e-6


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
        self._noise = np.array(
            [[each.speed_m_s, each.turn_rad_s, each.window_s, each.way_m, each.angle_rad] for each in noise]
        ).reshape(count, 5)
        depth = 2 + math.ceil(max((each.window_s for each in noise), default=0.0) * rate_hz)
        self._past = np.full((count, depth, 6), -math.inf)
        self._newest, self._held = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self.at_standstill = np.ones(count, bool)
        self.since_s = np.full(count, math.inf)

    def update(self, reading: FleetReading) -> None:
        """Take the newest readings; one that was taken before changes nothing."""
        judge.run(
            reading.stamp_s, reading.odometry, reading.twist, self._noise, self._past, self._newest, self._held,
            self.at_standstill, self.since_s,
        )  # fmt: skip


@kernel
def judge(
    stamp_s: Array, odometry: Array, twist: Array, noise: Array, past: Array, newest: NDArray[np.int64],
    held: NDArray[np.int64], at_standstill: Flags, since_s: Array,
) -> None:  # fmt: skip
    """Fill `at_standstill` and `since_s` (n,); `past` (n, k, 6): a ring of readings, the last one at `newest`."""
    depth = past.shape[1]
    for i in range(stamp_s.shape[0]):
        if not stamp_s[i] > past[i, newest[i], STAMP]:
            continue
        head = (newest[i] + 1) % depth
        newest[i] = head
        held[i] = min(held[i] + 1, depth)
        past[i, head, STAMP] = stamp_s[i]
        past[i, head, X] = odometry[i, 0]
        past[i, head, Y] = odometry[i, 1]
        past[i, head, HEADING] = odometry[i, 2]
        past[i, head, LINEAR] = twist[i, 0]
        past[i, head, ANGULAR] = twist[i, 1]
        still = False
        speed = 0.0
        turn = 0.0
        count = 0
        oldest_s = stamp_s[i]
        for back in range(held[i]):
            at = (head - back) % depth
            way_m = math.hypot(past[i, at, X] - odometry[i, 0], past[i, at, Y] - odometry[i, 1])
            if not way_m <= noise[i, WAY] or math.fabs(wrap(past[i, at, HEADING] - odometry[i, 2])) > noise[i, ANGLE]:
                break
            speed += past[i, at, LINEAR]
            turn += past[i, at, ANGULAR]
            count += 1
            oldest_s = past[i, at, STAMP]
            if stamp_s[i] - oldest_s >= noise[i, WINDOW] - ROUNDING_S:
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
            self._end_task(0, fault or reason(Code.DRIVER_STOPPED))
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
