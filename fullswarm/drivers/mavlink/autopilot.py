"""What differs between autopilots: modes, set-points, parameters. ArduPilot's Rover is here, PX4's in ``px4.py``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final, Protocol

from fullswarm.drivers.base import STAND, Limits, Standstill, Twist
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import StationEncoder
from fullswarm.drivers.mavlink.maps import FlatMap, Map
from fullswarm.geometry import clamp

STATION: Final = 255

FILTERED: Final = Standstill(speed_m_s=0.08, turn_rad_s=0.02, window_s=0.4, way_m=0.01, angle_rad=0.02, wander_m=0.03)
"""What an EKF that is aided by satellites shows of a vehicle that stands.

Recorded from ArduRover over 18 s at rest: a velocity of up to 0.05 m/s that changes over seconds, 0.001 rad/s, and a
position that moves by less than 6 mm in 0.5 s. A creep of 0.05 m/s is 20 mm in the window.
"""


@dataclass(frozen=True, slots=True)
class Guard:
    """A parameter that must hold one of the `accepted` values, for the vehicle's own safety.

    It is written for good, unless `unfit` finds a value wrong: then only a person may change it.
    """

    name: str
    wanted: float
    accepted: frozenset[float]
    kind: int
    unfit: Callable[[float], str] | None = None


@dataclass(frozen=True, slots=True)
class Check:
    """A parameter that external poses need and that only a person may change.

    `unfit` gets its value (None: the vehicle does not have it) and returns what is wrong; empty when nothing is.
    """

    name: str
    unfit: Callable[[float | None], str]
    needed: bool = True  # False: only warn


Known = Mapping[str, float]
"""The values of the parameters that have been read."""


class Autopilot(Protocol):
    """One kind of firmware on a ground rover. Stateless."""

    key: str  # in URLs
    make: str
    firmware: str
    number: int  # in heartbeats
    drive_mode: int
    hold_mode: int
    estimator: int  # id of the message with how well it knows its position
    bytewise: bool  # how integers travel in parameters
    stream_s: float  # it wants standing set-points for so long before it lets itself be driven; 0: it must get none
    stores_s: float  # a set-point sent while disarmed moves it when it is armed within this time
    watchdog_s: float  # it stops by itself after this silence
    standstill: Standstill
    slow_heartbeat: bool  # it keeps to 1 Hz: what confirms a command has to be asked for
    tells_safety: bool  # SYS_STATUS shows the safety switch
    can_reverse: bool
    chart: Map  # how it makes metres of degrees
    blank_velocity: float  # stands for "not measured" in ODOMETRY
    guards: tuple[Guard, ...]  # each is asked for once those before it are as they must be
    reads: tuple[str, ...]
    pose_checks: tuple[Check, ...]

    def mode_name(self, custom_mode: int) -> str:
        """Return a mode's name, or its number."""
        ...

    def starting(self, heartbeat: p.Heartbeat) -> bool:
        """Tell whether it is still booting."""
        ...

    def problem(self, known: Known) -> str:
        """Return which parameter's value forbids driving; empty when none does."""
        ...

    def set_mode(self, encoder: StationEncoder, mode: int, confirmation: int) -> bytes:
        """Return the command for a mode."""
        ...

    def applied(self, twist: Twist, limits: Limits, known: Known) -> Twist:
        """Return what it will make of a set-point."""
        ...

    def setpoint(self, encoder: StationEncoder, twist: Twist, known: Known) -> bytes:
        """Return the set-point for an applied twist."""
        ...


# What FS_ACTION makes of a lost station. Terminate disarms: that ends standing as HOLD does, its motors off.
HOLD_ACTION, TERMINATE_ACTION = 2.0, 5.0
UNFIT_ACTIONS = {
    0: "does nothing: it would stay armed",
    1: "is RTL: it would drive home",
    3: "is SmartRTL or RTL: it would drive home",
    4: "is SmartRTL or Hold: it would drive home",
    6: "is Loiter or Hold: it would drive to keep its place",
}


def unfit_action(value: float) -> str:
    """Return what an FS_ACTION that does not end standing would do."""
    what = UNFIT_ACTIONS.get(int(value), "is not known here: it might drive")
    return f"FS_ACTION {value:.0f} {what} when it loses us; set it to 2 (HOLD)"


class ArduPilot:
    """ArduPilot Rover 4.x: GUIDED, body speed and turn rate, reverse too."""

    key, make, firmware, number = "ardupilot", "ArduPilot", "ArduRover", p.AUTOPILOT_ARDUPILOT
    drive_mode, hold_mode = int(p.Mode.GUIDED), int(p.Mode.HOLD)
    estimator, bytewise = p.MESSAGE_EKF, False
    stream_s, stores_s, watchdog_s = 0.0, 3.2, 3.0
    standstill = FILTERED
    slow_heartbeat, tells_safety, can_reverse = False, True, True
    chart: Map = FlatMap()
    blank_velocity = 0.0  # NaN would go into its filter; EK3_SRC1_VELXY keeps zeros out
    guards: tuple[Guard, ...] = (
        # Other failsafes use it too, so it stays a person's choice; but first of all: the next one sets it free.
        Guard("FS_ACTION", HOLD_ACTION, frozenset((HOLD_ACTION, TERMINATE_ACTION)), p.PARAM_INT8, unfit_action),
        # Written for good into the vehicle's memory: without it a rover that loses us stays armed for ever.
        Guard("FS_GCS_ENABLE", 1.0, frozenset((1.0, 2.0)), p.PARAM_INT8),
    )
    reads: tuple[str, ...] = ("SYSID_MYGCS", "MAV_GCS_SYSID", "WP_SPEED")  # the second is the first's name from 4.7 on
    pose_checks: tuple[Check, ...] = (
        Check("VISO_TYPE", lambda v: "" if v else "VISO_TYPE must be 1, then a reboot, to take external poses"),
        Check("EK3_SRC1_POSXY", lambda v: "" if v == 6.0 else "EK3_SRC1_POSXY must be 6 to use external poses"),
        Check("EK3_SRC1_VELXY", lambda v: "EK3_SRC1_VELXY must not be 6: no velocity is sent" if v == 6.0 else ""),
        Check(
            "EK3_SRC1_YAW",
            lambda v: "" if v == 6.0 else "EK3_SRC1_YAW is not 6: the compass must agree with the external frame",
            needed=False,
        ),
    )

    def mode_name(self, custom_mode: int) -> str:
        """Return a mode's name, or its number."""
        return p.mode_name(custom_mode)

    def starting(self, heartbeat: p.Heartbeat) -> bool:
        """Tell whether it is still booting."""
        return heartbeat.custom_mode == p.Mode.INITIALISING

    def problem(self, known: Known) -> str:
        """Return whether its failsafe would watch another station."""
        for name in ("SYSID_MYGCS", "MAV_GCS_SYSID"):
            if known.get(name, float(STATION)) != STATION:
                return f"{name} is {known[name]:.0f}: its failsafe ignores us; set it to {STATION}"
        return ""

    def set_mode(self, encoder: StationEncoder, mode: int, confirmation: int) -> bytes:
        """Return the command for a mode."""
        return encoder.set_mode(mode, confirmation=confirmation)

    def applied(self, twist: Twist, limits: Limits, known: Known) -> Twist:
        """Clip to the limits and to its own, to which it clips silently."""
        return clip(twist, limits, known.get("WP_SPEED", 0.0))

    def setpoint(self, encoder: StationEncoder, twist: Twist, known: Known) -> bytes:
        """Return the set-point for a speed and a turn rate."""
        del known
        return encoder.drive(twist.linear_m_s, twist.angular_rad_s)


def clip(twist: Twist, limits: Limits, top_speed_m_s: float) -> Twist:
    """Clip a twist to the limits; `top_speed_m_s` is the vehicle's own, 0 if unknown."""
    speed = min(limits.speed_m_s, top_speed_m_s) if top_speed_m_s > 0.0 else limits.speed_m_s
    clipped = Twist(
        clamp(twist.linear_m_s, -speed if limits.can_reverse else 0.0, speed),
        clamp(twist.angular_rad_s, -limits.turn_rad_s, limits.turn_rad_s),
    )
    return STAND if clipped == STAND else clipped  # no minus zero


def unsupported(
    heartbeat: p.Heartbeat,
    known: Mapping[int, Autopilot],
    asked: Autopilot | None = None,
    driven: Autopilot | None = None,
) -> str:
    """Return why this vehicle must not be driven as a rover of one of the `known` autopilots; empty if it may.

    Parameters
    ----------
    asked
        What it must be by the URL.
    driven
        As what it is being driven now.
    """
    found = known.get(heartbeat.autopilot)
    if found is not None and asked is not None and found.number != asked.number:
        return f"the vehicle runs {found.make}, but its URL has autopilot={asked.key}: write autopilot={found.key}"
    if found is not None and driven is not None and found.number != driven.number:
        return f"it reports {found.make}, and reported {driven.make} before: give each vehicle a system id of its own"
    if heartbeat.autopilot not in known:
        names = ", ".join(f"{each.make} ({number})" for number, each in known.items())
        return f"autopilot {heartbeat.autopilot} is not supported: {names} are"
    if heartbeat.vehicle_type not in p.ROVER_TYPES:
        return f"it reports a vehicle of type {heartbeat.vehicle_type}, not a ground rover (10): not driven"
    return ""
