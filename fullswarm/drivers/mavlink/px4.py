"""PX4 on a differential rover, in OFFBOARD.

What it makes of a set-point (its `rover_differential` and `mavlink_receiver` sources, and its guide to Offboard):

- only a velocity vector counts (all of vx, vy, vz given); yaw and yaw rate are ignored with it, and a yaw rate alone
  is "SET_POSITION_TARGET_LOCAL_NED invalid" and no proof of life;
- it turns towards the vector with ``RO_YAW_P`` times the angle between, and drives forwards with its length;
- beyond ``RD_TRANS_DRV_TRN`` it turns on the spot until the angle is below ``RD_TRANS_TRN_DRV``;
- a vector of length 0 points north: it would turn there. So standing is a crawl of 1 mm/s straight ahead.

A speed and a turn rate are therefore a vector that leads the heading by the angle which gives that rate. Sharper
curves than the smaller of both angles allows are slowed down, or turned on the spot when little speed would be left.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

from fullswarm.drivers.base import STAND, Limits, Twist
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.autopilot import FILTERED, ArduPilot, Autopilot, Check, Guard, Known, clip
from fullswarm.drivers.mavlink.codec import StationEncoder
from fullswarm.drivers.mavlink.maps import Map, SphereMap
from fullswarm.geometry import clamp

CRAWL_M_S = 0.001
PERIOD_S = 0.05
"""Between two set-points: the vector stays where it pointed when it arrived, so the lead melts by half of it."""
MARGIN = 0.8
SLOWEST = 0.25
"""Share of the speed below which a curve becomes a turn on the spot."""
MOST_LEAD_RAD = 2.5
YAW_P, DRIVE_TO_TURN_RAD, TURN_TO_DRIVE_RAD = 5.0, 0.174533, 0.0872665
"""Where a parameter cannot be read: PX4's defaults, and its simulated rover's gain."""
HOLD_ACTION, DISARM_ACTION = 5.0, 7.0


class MainMode(enum.IntEnum):
    """PX4's main modes, in the third byte of ``custom_mode``."""

    MANUAL = 1
    ALTCTL = 2
    POSCTL = 3
    AUTO = 4
    ACRO = 5
    OFFBOARD = 6
    STABILIZED = 7


SUB_MODES = {1: "READY", 2: "TAKEOFF", 3: "HOLD", 4: "MISSION", 5: "RETURN", 6: "LAND"}


def custom_mode(main: MainMode, sub: int = 0) -> int:
    """Return a heartbeat's ``custom_mode``."""
    return main << 16 | sub << 24


OFFBOARD = custom_mode(MainMode.OFFBOARD)
HOLD = custom_mode(MainMode.AUTO, 3)
MANUAL = custom_mode(MainMode.MANUAL)


@dataclass(frozen=True, slots=True)
class Steering:
    """How a rover turns towards a velocity vector."""

    yaw_p: float
    lead_rad: float  # up to here it also drives
    top_turn_rad_s: float

    @classmethod
    def of(cls, known: Known) -> Steering:
        """Read the vehicle's parameters; what it did not send is PX4's default."""
        angles = (known.get("RD_TRANS_DRV_TRN", DRIVE_TO_TURN_RAD), known.get("RD_TRANS_TRN_DRV", TURN_TO_DRIVE_RAD))
        top = math.radians(known.get("RO_YAW_RATE_LIM", 0.0))
        return cls(known.get("RO_YAW_P", YAW_P) or YAW_P, MARGIN * min(angles), top if top > 0.0 else math.inf)

    def lead(self, turn_rad_s: float) -> float:
        """Return the angle ahead of the heading at which the vector must point for a turn rate."""
        return clamp(turn_rad_s * self._gain_s, -MOST_LEAD_RAD, MOST_LEAD_RAD)

    @property
    def _gain_s(self) -> float:
        return 1.0 / self.yaw_p + PERIOD_S / 2.0

    def limited(self, twist: Twist) -> Twist:
        """Return the nearest speed and turn rate that it can do at once."""
        fastest = min(self.top_turn_rad_s, MOST_LEAD_RAD / self._gain_s)
        turn = clamp(twist.angular_rad_s, -fastest, fastest)
        driving = self.lead_rad / self._gain_s
        if twist.linear_m_s <= 0.0 or abs(turn) <= driving:
            return Twist(max(0.0, twist.linear_m_s), turn)
        share = driving / abs(turn)
        if share < SLOWEST:
            return Twist(0.0, turn)
        return Twist(twist.linear_m_s * share, math.copysign(driving, turn))  # the same curve, slower


def _unfit_vision(value: float | None) -> str:
    fits = value is not None and int(value) & 0b1001 == 0b1001
    return "" if fits else "EKF2_EV_CTRL must have bits 0 (position) and 3 (yaw) set to use external poses"


class Px4:
    """PX4 1.14 and later on a differential rover. It does not reverse."""

    key, make, firmware, number = "px4", "PX4", "PX4", p.AUTOPILOT_PX4
    drive_mode, hold_mode = OFFBOARD, HOLD
    estimator, bytewise = p.MESSAGE_ESTIMATOR, True
    stream_s, stores_s, watchdog_s = 1.2, 0.0, 1.0
    standstill = FILTERED
    slow_heartbeat, tells_safety, can_reverse = True, False, False
    chart: Map = SphereMap()
    blank_velocity = math.nan
    guards: tuple[Guard, ...] = (
        # Hold (or disarm) when our set-points stop; the default is a mode that waits for a pilot's sticks.
        Guard("COM_OBL_RC_ACT", HOLD_ACTION, frozenset((HOLD_ACTION, DISARM_ACTION)), p.PARAM_INT32),
    )
    reads: tuple[str, ...] = (
        "COM_OF_LOSS_T",
        "RO_SPEED_LIM",
        "RO_YAW_P",
        "RO_YAW_RATE_LIM",
        "RD_TRANS_DRV_TRN",
        "RD_TRANS_TRN_DRV",
    )
    pose_checks: tuple[Check, ...] = (Check("EKF2_EV_CTRL", _unfit_vision),)

    def mode_name(self, custom_mode: int) -> str:
        """Return a mode's name, or its number."""
        main, sub = custom_mode >> 16 & 0xFF, custom_mode >> 24 & 0xFF
        if main == MainMode.AUTO and sub in SUB_MODES:
            return SUB_MODES[sub]
        return MainMode(main).name if main in MainMode.__members__.values() else f"mode {custom_mode:#x}"

    def starting(self, heartbeat: p.Heartbeat) -> bool:
        """Tell whether it is still booting or calibrating."""
        return heartbeat.status < 3

    def problem(self, known: Known) -> str:
        """Return whether it would drive on for long without us."""
        timeout_s = known.get("COM_OF_LOSS_T", self.watchdog_s)
        if timeout_s > 2.0:
            return f"COM_OF_LOSS_T is {timeout_s:g} s: it would drive on without us for that long; set it to 1"
        return ""

    def set_mode(self, encoder: StationEncoder, mode: int, confirmation: int) -> bytes:
        """Return the command for a mode."""
        return encoder.set_mode(mode >> 16 & 0xFF, mode >> 24 & 0xFF, confirmation=confirmation)

    def applied(self, twist: Twist, limits: Limits, known: Known) -> Twist:
        """Return what it can do of a twist: no reversing, and curves only as sharp as it drives them."""
        can = Limits(limits.speed_m_s, limits.turn_rad_s, limits.accel_m_s2, limits.turn_accel_rad_s2, False)
        twist = Steering.of(known).limited(clip(twist, can, known.get("RO_SPEED_LIM", 0.0)))
        return STAND if twist == STAND else twist

    def setpoint(self, encoder: StationEncoder, twist: Twist, known: Known) -> bytes:
        """Return the velocity vector for an applied twist."""
        length, lead = max(CRAWL_M_S, twist.linear_m_s), Steering.of(known).lead(twist.angular_rad_s)
        return encoder.velocity(length * math.cos(lead), length * math.sin(lead))


AUTOPILOTS: dict[int, Autopilot] = {each.number: each for each in (ArduPilot(), Px4())}
