"""MAVLink as this package sees it: numbers, message types, and the only place where NED/FRD meets ENU/FLU.

Pure: no I/O, no clock, no pymavlink. Every value of the types below is already ENU/FLU, SI, in [-π, π].

Frames: ENU = (y, x, -z) of NED; FLU = (x, -y, -z) of FRD; heading = π/2 - yaw.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass, field
from typing import Final

from fullswarm.geometry import wrap

MESSAGE_HEARTBEAT: Final = 0
MESSAGE_SYS_STATUS: Final = 1
MESSAGE_GPS: Final = 24
MESSAGE_ATTITUDE: Final = 30
MESSAGE_LOCAL_POSITION: Final = 32
MESSAGE_ORIGIN: Final = 49
MESSAGE_BATTERY: Final = 147
MESSAGE_VERSION: Final = 148
MESSAGE_EKF: Final = 193  # ArduPilot's
MESSAGE_ESTIMATOR: Final = 230  # PX4's

COMMAND_SET_MODE: Final = 176
COMMAND_REBOOT: Final = 246
COMMAND_ARM: Final = 400
COMMAND_MESSAGE_INTERVAL: Final = 511
COMMAND_REQUEST_MESSAGE: Final = 512

AUTOPILOT_ARDUPILOT: Final = 3
AUTOPILOT_PX4: Final = 12
AUTOPILOT_NONE: Final = 8  # a ground station or a gimbal, not a vehicle
ROVER_TYPES: Final = frozenset({10, 11})  # GROUND_ROVER, SURFACE_BOAT: both run ArduRover
STATUS_ACTIVE: Final = 4
STATUS_CRITICAL: Final = 5  # a failsafe of the firmware is on

BASE_MODE_ARMED: Final = 128
BASE_MODE_CUSTOM: Final = 1

SENSOR_MOTOR_OUTPUTS: Final = 0x8000

FRAME_LOCAL_NED: Final = 1
FRAME_BODY_NED: Final = 8
FRAME_BODY_FRD: Final = 12
FRAME_LOCAL_FRD: Final = 20
OBEYED_FRAMES: Final = frozenset({1, 7, 8, 9})
MASK_SPEED_AND_TURN: Final = 1511  # use vx, vy and yaw rate; vy stays 0: speed is hypot(vx, vy)
MASK_TURN_ONLY: Final = 1535  # use the yaw rate alone
MASK_VELOCITY: Final = 3527  # use vx, vy and vz: PX4 takes all three or none

PARAM_INT8: Final = 2
PARAM_INT32: Final = 6
PARAM_REAL32: Final = 9

EKF_NEEDED: Final = 1 | 2 | 8 | 16  # attitude, horizontal velocity, relative and absolute position
EKF_BAD: Final = 128 | 1024  # constant-position mode, uninitialised
ESTIMATOR_NEEDED: Final = 1 | 2 | 8  # PX4: no absolute position without GPS
ESTIMATOR_BAD: Final = 128  # 1024 is a GPS glitch there
ESTIMATOR_MOCAP: Final = 6


class Mode(enum.IntEnum):
    """ArduRover's ``custom_mode``."""

    MANUAL = 0
    ACRO = 1
    STEERING = 3
    HOLD = 4
    LOITER = 5
    FOLLOW = 6
    SIMPLE = 7
    DOCK = 8
    CIRCLE = 9
    AUTO = 10
    RTL = 11
    SMART_RTL = 12
    GUIDED = 15
    INITIALISING = 16


class Result(enum.IntEnum):
    """``MAV_RESULT`` of a COMMAND_ACK."""

    ACCEPTED = 0
    TEMPORARILY_REJECTED = 1
    DENIED = 2
    UNSUPPORTED = 3
    FAILED = 4
    IN_PROGRESS = 5
    CANCELLED = 6
    COMMAND_LONG_ONLY = 7
    COMMAND_INT_ONLY = 8


_MODE_NAMES = {mode.value: mode.name for mode in Mode}
_RESULT_NAMES = {result.value: result.name for result in Result}


def mode_name(custom_mode: int) -> str:
    """Return the name of an ArduRover mode, or its number."""
    return _MODE_NAMES.get(custom_mode, f"mode {custom_mode}")


def result_name(result: int) -> str:
    """Return the name of a command result, or its number."""
    return _RESULT_NAMES.get(result, f"result {result}")


# ---------------------------------------------------------------- frames of reference
def enu_from_ned(north: float, east: float, down: float) -> tuple[float, float, float]:
    """Return a world vector (east, north, up) from (north, east, down); its own inverse."""
    return east, north, -down


def flu_from_frd(forward: float, right: float, down: float) -> tuple[float, float, float]:
    """Return a body vector (forward, left, up) from (forward, right, down); its own inverse."""
    return forward, -right, -down


def heading_from_yaw(yaw_rad: float) -> float:
    """Return the ENU heading (from east, counter-clockwise) of a NED yaw (from north, clockwise); its own inverse."""
    return wrap(math.pi / 2 - yaw_rad)


def forward_speed(vx_m_s: float, vy_m_s: float, heading_rad: float) -> float:
    """Return the speed along the heading of a world velocity, negative when reversing."""
    return vx_m_s * math.cos(heading_rad) + vy_m_s * math.sin(heading_rad)


# ---------------------------------------------------------------- what a vehicle sends
@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Who is there, in which mode, armed or not."""

    vehicle_type: int
    autopilot: int
    base_mode: int
    custom_mode: int
    status: int

    @property
    def armed(self) -> bool:
        """Only this bit shows that motors may turn; `status` is ACTIVE also when disarmed."""
        return bool(self.base_mode & BASE_MODE_ARMED)

    @property
    def is_vehicle(self) -> bool:
        """Whether an autopilot sent it, not a ground station or a gimbal."""
        return self.autopilot != AUTOPILOT_NONE


@dataclass(frozen=True, slots=True)
class LocalPosition:
    """Position (m) and velocity (m/s), ENU, relative to the EKF origin."""

    boot_ms: int
    x_m: float
    y_m: float
    z_m: float
    vx_m_s: float
    vy_m_s: float
    vz_m_s: float


@dataclass(frozen=True, slots=True)
class Attitude:
    """Orientation of the FLU body in ENU, and its turn rates about the FLU axes."""

    boot_ms: int
    roll_rad: float
    pitch_rad: float
    heading_rad: float
    roll_rad_s: float
    pitch_rad_s: float
    turn_rad_s: float


@dataclass(frozen=True, slots=True)
class EkfStatus:
    """Which of its estimates the EKF trusts; the two autopilots number their flags differently from 1024 on."""

    flags: int
    needed: int = EKF_NEEDED
    bad: int = EKF_BAD
    strain: float = 0.0  # the worse innovation test ratio of velocity and horizontal position; from 1 on rejected

    @property
    def good(self) -> bool:
        """Whether the vehicle knows where it is."""
        return self.flags & self.needed == self.needed and not self.flags & self.bad


@dataclass(frozen=True, slots=True)
class SatelliteFix:
    """The state of the satellite receiver."""

    stamp_us: int  # of its last fix, on a clock of the vehicle: it stands still while nothing new comes
    fix_type: int  # 3 and above: a position in space


@dataclass(frozen=True, slots=True)
class Battery:
    """Pack voltage (V), current (A) and charge (0 to 1); None: not measured."""

    voltage_v: float | None
    current_a: float | None
    remaining: float | None
    motors_off: bool | None = None  # the safety switch cuts the motors' power; None: not reported


@dataclass(frozen=True, slots=True)
class StatusText:
    """A line of text, or with `text_id` other than 0 one chunk of a longer one."""

    severity: int  # 0 emergency … 7 debug
    text: str
    text_id: int = 0
    chunk: int = 0

    @property
    def last(self) -> bool:
        """Whether no further chunk follows: a full chunk of 50 characters announces another."""
        return self.text_id == 0 or len(self.text) < TEXT_CHUNK


TEXT_CHUNK: Final = 50


@dataclass(frozen=True, slots=True)
class Ack:
    """The answer to a command. ACCEPTED is not done: confirm by state."""

    command: int
    result: int
    target_system: int = 0
    target_component: int = 0


@dataclass(frozen=True, slots=True)
class Parameter:
    """The value of a parameter: a plain float (ArduPilot) or, for integers, the bits of one (PX4)."""

    name: str
    value: float
    kind: int = field(default=PARAM_REAL32, compare=False)
    bits: int = field(default=0, compare=False)  # of the float as it came, signed

    @property
    def bytewise(self) -> float:
        """The value of an autopilot that puts an integer's bytes into the float."""
        return self.value if self.kind == PARAM_REAL32 else float(self.bits)


@dataclass(frozen=True, slots=True)
class Origin:
    """Where on earth the vehicle's local frame begins."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float


@dataclass(frozen=True, slots=True)
class Version:
    """The firmware's version."""

    major: int
    minor: int
    patch: int

    def __str__(self) -> str:
        return f"{self.major}.{self.minor}.{self.patch}"


Body = (
    Heartbeat
    | LocalPosition
    | Attitude
    | EkfStatus
    | SatelliteFix
    | Battery
    | StatusText
    | Ack
    | Parameter
    | Origin
    | Version
)


@dataclass(frozen=True, slots=True)
class Received:
    """A decoded message and its sender."""

    system: int
    component: int
    body: Body


# ---------------------------------------------------------------- what we send
@dataclass(frozen=True, slots=True)
class Fix:
    """A pose measured from outside, ENU, for ODOMETRY."""

    stamp_us: int  # of any clock that does not jump
    x_m: float
    y_m: float
    heading_rad: float
    position_var_m2: float
    heading_var_rad2: float
    resets: int = 0  # counts the jumps of what measures it


class TextAssembler:
    """Joins the chunks of STATUSTEXT messages of one sender."""

    def __init__(self) -> None:
        self._text_id = 0
        self._chunks: dict[int, str] = {}

    def add(self, part: StatusText) -> str | None:
        """Return the whole text once its last chunk is here, else None; lost chunks leave ``…``."""
        if part.text_id == 0:
            return part.text
        if part.text_id != self._text_id:
            self._text_id, self._chunks = part.text_id, {}
        self._chunks[part.chunk] = part.text
        if not part.last:
            return None
        whole = "".join(self._chunks.get(index, "…") for index in range(part.chunk + 1))
        self._text_id, self._chunks = 0, {}
        return whole
