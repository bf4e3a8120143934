"""Decides which twist each driver gets (paper II.D; design decision 6). Arrays over n robots.

A desired twist is valid for its time-to-live on this machine's monotonic clock. Every tick the controller decides
for each robot whether it may move; if not, the twist is zero at once and the reason is kept for people to read. If it
may, speed and turn rate are held within the limits and the acceleration limits.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fullswarm.drivers.base import STOPPING_HAZARDS, Hazard, Limits
from fullswarm.geometry import clamp
from fullswarm.kernels import Array, Flags, bound, kernel
from fullswarm.reasons import Code, Reason


class StopReason(enum.IntEnum):
    """Why a robot is stopped; `find_reasons` gives their order."""

    MOVING = 0
    ESTOP = 1
    DRIVER = 2
    READING = 3
    HAZARD = 4
    IDLE = 5
    LAW = 6
    HUB = 7
    CORE = 8
    EXPIRED = 9
    STALE = 10
    BATTERY = 11
    CLOCK = 12
    POSE = 13
    GEOFENCE = 14
    OVERLAP = 15
    FRAME = 16
    UNSURE = 17
    RANGES = 18


# The kernels' own numbers: compiled code knows no enum, and plain Python reads a global faster than a member.
MOVING, ESTOP, DRIVER, READING, HAZARD, IDLE, LAW, HUB, CORE = (int(each) for each in tuple(StopReason)[:9])
EXPIRED, STALE, BATTERY, CLOCK, POSE, GEOFENCE, OVERLAP, FRAME, UNSURE, RANGES = (
    int(each) for each in tuple(StopReason)[9:]
)

CODES: dict[int, Code] = {
    StopReason.MOVING: Code.NONE,
    StopReason.ESTOP: Code.ESTOP,
    StopReason.DRIVER: Code.DRIVER,
    StopReason.READING: Code.READING,
    StopReason.HAZARD: Code.HAZARD,
    StopReason.IDLE: Code.NONE,
    StopReason.LAW: Code.LAW,
    StopReason.HUB: Code.HUB,
    StopReason.CORE: Code.CORE,
    StopReason.EXPIRED: Code.EXPIRED,
    StopReason.STALE: Code.STALE,
    StopReason.BATTERY: Code.BATTERY,
    StopReason.CLOCK: Code.CLOCK,
    StopReason.POSE: Code.POSE,
    StopReason.GEOFENCE: Code.GEOFENCE,
    StopReason.OVERLAP: Code.OVERLAP,
    StopReason.FRAME: Code.FRAME,
    StopReason.UNSURE: Code.UNSURE,
    StopReason.RANGES: Code.RANGES,
}
"""What the kernels' numbers are called on the wire."""

HAZARDS: dict[Hazard, tuple[str, str]] = {
    Hazard.CLIFF: ("a cliff sensor sees no floor", "put it on safe ground"),
    Hazard.WHEEL_DROP: ("a wheel hangs", "put it on safe ground"),
    Hazard.OVERCURRENT: ("a wheel motor draws too much current (overcurrent)", "free its wheels"),
    Hazard.ESTOP_BUTTON: ("a person pressed its stop button or took it over", "have the button released"),
    Hazard.MOTORS_OFF: ("its safety switch keeps the motors off", "release the switch"),
}
"""What a hazard that stops a robot is called, and what to do about it."""

STOPPING = int(STOPPING_HAZARDS)
BUMP = int(Hazard.BUMP)
STILL = 1e-3
"""m/s and rad/s: less is no motion."""


def explain_hazards(hazards: int, fault: str) -> tuple[Reason, str]:
    """Return which hazards stop a robot, and what to do about them.

    Parameters
    ----------
    fault
        The driver's. Where a person may have taken over it says what happened, which the hazard does not.
    """
    seen = {each: HAZARDS[each] for each in HAZARDS if hazards & each}
    if Hazard.MOTORS_OFF in seen:
        seen.pop(Hazard.ESTOP_BUTTON, None)  # the switch is the button
    elif fault and Hazard.ESTOP_BUTTON in seen:
        seen[Hazard.ESTOP_BUTTON] = fault, HAZARDS[Hazard.ESTOP_BUTTON][1]
    words, remedies = zip(*seen.values(), strict=True) if seen else ((), ())
    names = " ".join(str(each.name).lower() for each in seen)
    return Reason(Code.HAZARD, " and ".join(words), {"hazards": names}), " and ".join(dict.fromkeys(remedies))


class Task(NamedTuple):
    """What the robots were asked for; (n,) each.

    `active`: a behaviour is on; `survives_core`: it goes on without core and hub; `expires_at_s`: it ends then, finite
    for a person at the stick only.
    """

    active: Flags
    survives_core: Flags
    expires_at_s: Array


class Link(NamedTuple):
    """Whether those are there that the agent depends on; `driver_ready` is (n,)."""

    core_alive: bool
    hub_alive: bool
    driver_ready: Flags


class Sensed(NamedTuple):
    """The newest reading: when, (n,), and :class:`~fullswarm.drivers.base.Hazard` bits, (n,)."""

    stamp_s: Array
    hazards: NDArray[np.uint8]


class Doubt(NamedTuple):
    """What makes motion unsafe by what this computer knows: see ``Reflexes`` and ``PoseConflicts``; (n,) each.

    `blind`: a range sensor is silent. `floor` and `ceiling` in m/s: the least and the greatest speed that the geofence
    allows.
    """

    battery_low: Flags
    clock_jumped: bool
    pose_unknown: Flags
    pose_uncertain: Flags
    overlap: Flags
    frame_conflict: bool
    blind: Flags
    floor: Array
    ceiling: Array


class Desired(NamedTuple):
    """The twists that control laws and operators ask for, (n, 2), until when they are valid, and failed laws, (n,)."""

    twist: Array
    valid_until_s: Array
    law_failed: Flags


class Bounds(NamedTuple):
    """What the wheels may do, (n,) each: m/s, rad/s, whether backwards, m/s², rad/s²."""

    speed: Array
    turn: Array
    reverse: Flags
    accel: Array
    turn_accel: Array


class Decision(NamedTuple):
    """What :func:`decide` keeps and fills: (n,) each but `twist`, (n, 2). `estop` is read only."""

    estop: Flags
    reason: NDArray[np.int64]
    drive_on: Flags
    twist: Array


class RobotController:
    """Decides, tick by tick, which twists the drivers get.

    Attributes
    ----------
    estop : (n,) latched e-stop
    reason : (n,) :class:`StopReason` of the last tick
    changed : a reason changed in the last tick
    drive_on : (n,) drivers that shall be ACTIVE: a task is on and no e-stop is latched
    speed_limit, turn_limit : (n,) m/s and rad/s in force
    """

    def __init__(
        self, limits: tuple[Limits, ...], speed_limit_m_s: float | None, turn_limit_rad_s: float | None
    ) -> None:
        count = len(limits)
        self.speed_limit = np.array([min(each.speed_m_s, speed_limit_m_s or math.inf) for each in limits])
        self.turn_limit = np.array([min(each.turn_rad_s, turn_limit_rad_s or math.inf) for each in limits])
        self.reverse = np.array([each.can_reverse for each in limits])
        accel = np.array([each.accel_m_s2 for each in limits])
        turn_accel = np.array([each.turn_accel_rad_s2 for each in limits])
        self.estop = np.zeros(count, bool)
        self.law_failed = np.zeros(count, bool)
        self.reason = np.full(count, int(StopReason.IDLE), np.int64)
        self.desired = np.zeros((count, 2))
        self.valid_until_s = np.full(count, -math.inf)
        self.changed = False
        self.drive_on = np.zeros(count, bool)
        self._desired = Desired(self.desired, self.valid_until_s, self.law_failed)
        self._bounds = Bounds(self.speed_limit, self.turn_limit, self.reverse, accel, turn_accel)
        self._decision = Decision(self.estop, self.reason, self.drive_on, np.zeros((count, 2)))
        self._given: tuple[Task, Link, Sensed, Doubt] | None = None
        self._decide: Callable[[float, float, float], bool]

    def submit(self, row: int, linear_m_s: float, angular_rad_s: float, valid_until_s: float) -> None:
        """Set the desired twist of robot `row`, valid until then; ``ValueError`` if it is not finite."""
        if not (math.isfinite(linear_m_s) and math.isfinite(angular_rad_s)):
            raise ValueError(f"a twist of {linear_m_s} m/s, {angular_rad_s} rad/s is not finite")
        self.desired[row] = linear_m_s, angular_rad_s
        self.valid_until_s[row] = valid_until_s

    def forget(self, row: int) -> None:
        """Drop the desired twist of robot `row`: it is stopped at the next tick."""
        self.desired[row] = 0.0
        self.valid_until_s[row] = -math.inf

    def step(
        self, now_s: float, dt_s: float, read_since_s: float, task: Task, link: Link, sensed: Sensed, doubt: Doubt
    ) -> Array:
        """Return the twists (n, 2) for this tick; all of them zero where `reason` is not MOVING.

        Readings with a stamp before `read_since_s` are too old to move on. Tuples that are the same objects as in the
        tick before cost no time.
        """
        given = self._given
        if (
            given is None or task is not given[0] or link is not given[1] or sensed is not given[2]
            or doubt is not given[3]
        ):  # fmt: skip
            self._given = task, link, sensed, doubt
            self._decide = bound(
                partial(decide.run, task, link, sensed, doubt, self._desired, self._bounds, self._decision),
                viewed=True,
            )
        self.changed = self._decide(now_s, dt_s, read_since_s)
        return self._decision.twist


@kernel
def find_reasons(
    task: Task, link: Link, sensed: Sensed, doubt: Doubt, desired: Desired, bounds: Bounds, decision: Decision,
    now_s: float, read_since_s: float,
) -> bool:  # fmt: skip
    """Fill `reason` and `drive_on` of `decision`; tell if a reason changed."""
    reason = decision.reason
    changed = False
    for i in range(reason.shape[0]):
        forward = desired.twist[i, 0]
        turn = desired.twist[i, 1]
        why = MOVING
        if decision.estop[i]:
            why = ESTOP
        elif not link.driver_ready[i]:
            why = DRIVER
        elif not sensed.stamp_s[i] >= read_since_s:
            why = READING
        elif int(sensed.hazards[i]) & STOPPING:
            why = HAZARD
        elif not task.active[i]:
            why = IDLE
        elif desired.law_failed[i]:
            why = LAW
        elif not link.hub_alive and not task.survives_core[i]:
            why = HUB
        elif not link.core_alive and not task.survives_core[i]:
            why = CORE
        elif now_s >= task.expires_at_s[i]:
            why = EXPIRED
        elif now_s >= desired.valid_until_s[i] or not math.isfinite(forward + turn):
            why = STALE
        elif doubt.clock_jumped:
            why = CLOCK
        elif not math.isfinite(task.expires_at_s[i]):
            # A person at the stick may drive a robot to its charger, and needs no estimator to see where it is.
            why = (
                BATTERY if doubt.battery_low[i]
                else POSE if doubt.pose_unknown[i]
                else FRAME if doubt.frame_conflict
                else OVERLAP if doubt.overlap[i]
                else UNSURE if doubt.pose_uncertain[i]
                else RANGES if doubt.blind[i]
                else MOVING
            )  # fmt: skip
        if why == MOVING and math.fabs(turn) < STILL:
            low = -bounds.speed[i] if bounds.reverse[i] else 0.0
            high = 0.0 if int(sensed.hazards[i]) & BUMP else bounds.speed[i]
            speed = clamp(forward, low, high)
            allowed = clamp(speed, max(low, doubt.floor[i]), min(high, doubt.ceiling[i]))
            why = GEOFENCE if math.fabs(speed) >= STILL and math.fabs(allowed) < STILL else MOVING
        changed = changed or reason[i] != why
        reason[i] = why
        decision.drive_on[i] = task.active[i] and not decision.estop[i]
    return changed


@kernel
def decide(
    task: Task, link: Link, sensed: Sensed, doubt: Doubt, desired: Desired, bounds: Bounds, decision: Decision,
    now_s: float, dt_s: float, read_since_s: float,
) -> bool:  # fmt: skip
    """Fill `decision`; tell if a reason (see :class:`StopReason`) changed.

    Readings with a stamp before `read_since_s` are too old to move on.
    """
    changed = find_reasons(task, link, sensed, doubt, desired, bounds, decision, now_s, read_since_s)
    reason, twist, wanted = decision.reason, decision.twist, desired.twist
    for i in range(reason.shape[0]):
        if reason[i] != MOVING:
            # Zero at once, not a ramp: the wheels' own limits brake, and silence must end in zero within the bound.
            twist[i, 0] = 0.0
            twist[i, 1] = 0.0
            continue
        low = max(-bounds.speed[i] if bounds.reverse[i] else 0.0, doubt.floor[i])
        high = min(0.0 if int(sensed.hazards[i]) & BUMP else bounds.speed[i], doubt.ceiling[i])
        speed = clamp(wanted[i, 0], low, high)
        turn = clamp(wanted[i, 1], -bounds.turn[i], bounds.turn[i])
        step = bounds.accel[i] * dt_s
        # Braking is never held back: the filter's promise rests on it, and the wheels limit it anyway.
        if speed * twist[i, 0] < 0.0:
            speed = clamp(speed, -step, step)
        elif math.fabs(speed) > math.fabs(twist[i, 0]):
            speed = clamp(speed, twist[i, 0] - step, twist[i, 0] + step)
        turn_step = bounds.turn_accel[i] * dt_s
        twist[i, 0] = speed
        twist[i, 1] = clamp(turn, twist[i, 1] - turn_step, twist[i, 1] + turn_step)
    return changed
