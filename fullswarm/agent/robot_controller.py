"""The robot controller: the last word on the wheels (paper II.D; design decision 6). Arrays over n robots.

A wish (a twist) is valid for its time-to-live on this machine's monotonic clock. Every tick the controller decides
for each robot whether it may move; if not, the twist is zero at once and the reason is kept for people to read. If it
may, speed and turn rate are held within the limits and the acceleration limits.
"""

from __future__ import annotations

import enum
import math

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.reflexes import Reflexes
from fullswarm.drivers.base import Hazard, Limits
from fullswarm.geometry import clamp
from fullswarm.kernels import kernel
from fullswarm.reasons import Code, Reason

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]


class StopReason(enum.IntEnum):
    """Why a robot stands; `decide` says in which order they count."""

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
    FENCE = 14
    OVERLAP = 15
    FRAME = 16
    UNSURE = 17


# The kernels' own numbers: compiled code knows no enum, and plain Python reads a global faster than a member.
MOVING, ESTOP, DRIVER, READING, HAZARD, IDLE, LAW, HUB, CORE = (int(each) for each in tuple(StopReason)[:9])
EXPIRED, STALE, BATTERY, CLOCK, POSE, FENCE, OVERLAP, FRAME, UNSURE = (int(each) for each in tuple(StopReason)[9:])

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
    StopReason.FENCE: Code.FENCE,
    StopReason.OVERLAP: Code.OVERLAP,
    StopReason.FRAME: Code.FRAME,
    StopReason.UNSURE: Code.UNSURE,
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

STOPPING_HAZARDS = int(Hazard.CLIFF | Hazard.WHEEL_DROP | Hazard.OVERCURRENT | Hazard.ESTOP_BUTTON | Hazard.MOTORS_OFF)
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


class RobotController:
    """Decides, tick by tick, what the drivers are told.

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
        self._accel = np.array([each.accel_m_s2 for each in limits])
        self._turn_accel = np.array([each.turn_accel_rad_s2 for each in limits])
        self.estop = np.zeros(count, bool)
        self.law_failed = np.zeros(count, bool)
        self.reason = np.full(count, int(StopReason.IDLE), np.int64)
        self.wished = np.zeros((count, 2))
        self.valid_until_s = np.full(count, -math.inf)
        self.changed = False
        self.drive_on = np.zeros(count, bool)
        self._twist = np.zeros((count, 2))

    def submit(self, row: int, linear_m_s: float, angular_rad_s: float, valid_until_s: float) -> None:
        """Wish a twist for robot `row`, valid until then; a non-finite one is refused with ``ValueError``."""
        if not (math.isfinite(linear_m_s) and math.isfinite(angular_rad_s)):
            raise ValueError(f"a twist of {linear_m_s} m/s, {angular_rad_s} rad/s is not finite")
        self.wished[row] = linear_m_s, angular_rad_s
        self.valid_until_s[row] = valid_until_s

    def forget(self, row: int) -> None:
        """Drop the wish of robot `row`: it stands at the next tick."""
        self.wished[row] = 0.0
        self.valid_until_s[row] = -math.inf

    def step(
        self,
        now_s: float,
        dt_s: float,
        active: Flags,
        survives_core: Flags,
        lapses_s: Array,
        core_alive: bool,
        hub_alive: bool,
        driver_ready: Flags,
        read_since_s: float,
        stamp_s: Array,
        hazards: NDArray[np.uint8],
        reflexes: Reflexes,
        overlap: Flags,
        frame_conflict: bool,
    ) -> Array:
        """Return the twists (n, 2) for this tick; all of them zero where `reason` is not MOVING.

        `overlap` (n,) and `frame_conflict` are those of :class:`~fullswarm.agent.pose_conflicts.PoseConflicts`.
        Readings with a stamp before `read_since_s` are too old to move on.
        """
        self.changed = decide.run(
            now_s, dt_s, active, survives_core, lapses_s, core_alive, hub_alive, driver_ready, read_since_s, stamp_s,
            hazards, reflexes.flat, reflexes.slept, reflexes.no_pose, reflexes.unsure, overlap, frame_conflict,
            reflexes.floor, reflexes.ceiling, self.estop, self.law_failed, self.wished, self.valid_until_s,
            self.speed_limit, self.turn_limit, self.reverse, self._accel, self._turn_accel, self.reason, self.drive_on,
            self._twist,
        )  # fmt: skip
        return self._twist


@kernel
def why_not(
    now_s: float, survives_core: bool, lapses_s: float, core_alive: bool, hub_alive: bool, driver_ready: bool,
    fresh: bool, hazard: int, active: bool, estop: bool, law_failed: bool, wish: float, valid_until_s: float,
    flat: bool, slept: bool, no_pose: bool, unsure: bool, overlap: bool, frame_conflict: bool,
) -> int:  # fmt: skip
    """Return why one robot may not move, a number of :class:`StopReason`; 0: it may."""
    why = MOVING
    if estop:
        why = ESTOP
    elif not driver_ready:
        why = DRIVER
    elif not fresh:
        why = READING
    elif hazard & STOPPING_HAZARDS:
        why = HAZARD
    elif not active:
        why = IDLE
    elif law_failed:
        why = LAW
    elif not hub_alive and not survives_core:
        why = HUB
    elif not core_alive and not survives_core:
        why = CORE
    elif now_s >= lapses_s:
        why = EXPIRED
    elif now_s >= valid_until_s or not math.isfinite(wish):
        why = STALE
    elif slept:
        why = CLOCK
    elif not math.isfinite(lapses_s):
        # A person at the stick may drive a robot to its charger, and needs no estimator to see where it is.
        why = (
            BATTERY if flat
            else POSE if no_pose
            else FRAME if frame_conflict
            else OVERLAP if overlap
            else UNSURE if unsure
            else MOVING
        )  # fmt: skip
    return why


@kernel
def decide(
    now_s: float, dt_s: float, active: Flags, survives_core: Flags, lapses_s: Array, core_alive: bool,
    hub_alive: bool, driver_ready: Flags, read_since_s: float, stamp_s: Array, hazards: NDArray[np.uint8],
    flat: Flags, slept: bool, no_pose: Flags, unsure: Flags, overlap: Flags, frame_conflict: bool, floor: Array,
    ceiling: Array, estop: Flags, law_failed: Flags, wished: Array, valid_until_s: Array, speed_limit: Array,
    turn_limit: Array, reverse: Flags, accel: Array, turn_accel: Array, reason: NDArray[np.int64], drive_on: Flags,
    twist: Array,
) -> bool:  # fmt: skip
    """Fill `reason` (n,; see :class:`StopReason`), `drive_on` (n,) and `twist` (n, 2); tell if a reason changed."""
    changed = False
    for i in range(active.shape[0]):
        hazard = int(hazards[i])
        why = why_not(
            now_s, survives_core[i], lapses_s[i], core_alive, hub_alive, driver_ready[i],
            stamp_s[i] >= read_since_s, hazard, active[i], estop[i], law_failed[i], wished[i, 0] + wished[i, 1],
            valid_until_s[i], flat[i], slept, no_pose[i], unsure[i], overlap[i], frame_conflict,
        )  # fmt: skip
        low = -speed_limit[i] if reverse[i] else 0.0
        high = 0.0 if hazard & BUMP else speed_limit[i]
        if why == MOVING:
            speed, low, high = clamp(wished[i, 0], low, high), max(low, floor[i]), min(high, ceiling[i])
            held = math.fabs(speed) >= STILL and math.fabs(clamp(speed, low, high)) < STILL
            if held and math.fabs(wished[i, 1]) < STILL:
                why = FENCE
        changed = changed or reason[i] != why
        reason[i] = why
        drive_on[i] = active[i] and not estop[i]
        if why != MOVING:
            # Zero at once, not a ramp: the wheels' own limits brake, and silence must end in zero within the bound.
            twist[i, 0] = 0.0
            twist[i, 1] = 0.0
            continue
        speed = clamp(wished[i, 0], low, high)
        turn = clamp(wished[i, 1], -turn_limit[i], turn_limit[i])
        step = accel[i] * dt_s
        # Braking is never held back: the filter's promise rests on it, and the wheels limit it anyway.
        if speed * twist[i, 0] < 0.0:
            speed = clamp(speed, -step, step)
        elif math.fabs(speed) > math.fabs(twist[i, 0]):
            speed = clamp(speed, twist[i, 0] - step, twist[i, 0] + step)
        turn_step = turn_accel[i] * dt_s
        twist[i, 0] = speed
        twist[i, 1] = clamp(turn, twist[i, 1] - turn_step, twist[i, 1] + turn_step)
    return changed
