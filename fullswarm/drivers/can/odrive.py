"""ODrive CANSimple 0.5 and 0.6: 11-bit identifiers ``node << 5 | command``, little endian. Bytes only.

A remote frame with the identifier of a message that the axis sends asks for it. Sources: ODrive's CAN protocol pages,
firmware 0.5.6, and the DBC files of 0.5.6 and 0.6.10.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from fullswarm.drivers.can.layout import Layout, Table
from fullswarm.drivers.can.protocol import Frame

Firmware = Literal["0.5", "0.6"]

MAX_NODE = 63
VELOCITY_CONTROL = 2
PASSTHROUGH, VELOCITY_RAMP = 1, 2


# ---------------------------------------------------------------- what an axis tells
@dataclass(frozen=True, slots=True)
class Heartbeat05:
    """Every 100 ms; bit 0 of the three flag bytes: motor, encoder, controller error; bit 7 of the last: at its goal."""

    error: int
    state: int
    motor_flags: int = 0
    encoder_flags: int = 0
    controller_flags: int = 0


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """Every 100 ms from 0.6; bit 0 of the flags: trajectory done."""

    error: int
    state: int
    procedure_result: int = 0
    flags: int = 0


@dataclass(frozen=True, slots=True)
class Encoder:
    """Estimates of the motor's position and speed."""

    position_turn: float
    velocity_turn_s: float


@dataclass(frozen=True, slots=True)
class EncoderCount:
    """Raw counts (0.5)."""

    shadow: int
    in_cpr: int


@dataclass(frozen=True, slots=True)
class Version:
    """Who is there (0.6)."""

    protocol: int
    hardware_major: int
    hardware_minor: int
    hardware_variant: int
    major: int
    minor: int
    revision: int
    unreleased: int = 0


@dataclass(frozen=True, slots=True)
class MotorError:
    """Error word of the motor (0.5)."""

    error: int


@dataclass(frozen=True, slots=True)
class EncoderError:
    """Error word of the encoder (0.5)."""

    error: int


@dataclass(frozen=True, slots=True)
class SensorlessError:
    """Error word of the sensorless estimator (0.5)."""

    error: int


@dataclass(frozen=True, slots=True)
class ControllerError:
    """Error word of the controller (0.5)."""

    error: int


@dataclass(frozen=True, slots=True)
class Errors:
    """What is wrong now and why the axis disarmed last (0.6)."""

    active: int
    disarm_reason: int


@dataclass(frozen=True, slots=True)
class Iq:
    """Torque-making motor current, A."""

    setpoint_a: float
    measured_a: float


@dataclass(frozen=True, slots=True)
class Sensorless:
    """Estimates without an encoder (0.5)."""

    position_turn: float
    velocity_turn_s: float


@dataclass(frozen=True, slots=True)
class Temperature:
    """In °C; None where there is no thermistor (0.6)."""

    fet_c: float | None
    motor_c: float | None


@dataclass(frozen=True, slots=True)
class BusPower:
    """What the axis draws from its supply."""

    volts: float
    amperes: float


@dataclass(frozen=True, slots=True)
class AdcVoltage:
    """Of a pin (0.5)."""

    volts: float


@dataclass(frozen=True, slots=True)
class Torques:
    """In Nm (0.6)."""

    target_nm: float
    estimate_nm: float


@dataclass(frozen=True, slots=True)
class Powers:
    """In W (0.6)."""

    electrical_w: float
    mechanical_w: float


@dataclass(frozen=True, slots=True)
class SdoReply:
    """A parameter's value (0.6); numbers of parameters change with every firmware build."""

    reserved: int
    endpoint: int
    reserved_too: int
    value: int


# ---------------------------------------------------------------- what it is told
@dataclass(frozen=True, slots=True)
class Estop:
    """Disarm at once and latch ESTOP_REQUESTED until the errors are cleared."""


@dataclass(frozen=True, slots=True)
class SdoRequest:
    """Read (0) or write (1) a parameter (0.6)."""

    opcode: int
    endpoint: int
    reserved: int = 0
    value: int = 0


@dataclass(frozen=True, slots=True)
class SetNode:
    """Another node number (0.5)."""

    node: int


@dataclass(frozen=True, slots=True)
class Address:
    """Asked for remotely: who has which serial number; sent: a node number for it (0.6)."""

    node: int
    serial: bytes  # 6, little endian


@dataclass(frozen=True, slots=True)
class SetState:
    """Ask for an axis state; four bytes, as the maker's own clients send it."""

    state: int


@dataclass(frozen=True, slots=True)
class SetMode:
    """Choose control mode and input mode."""

    control: int = VELOCITY_CONTROL
    input: int = PASSTHROUGH


@dataclass(frozen=True, slots=True)
class SetPosition:
    """Input position with feed-forwards of speed and torque."""

    position_turn: float
    velocity_turn_s: float = 0.0
    torque_nm: float = 0.0


@dataclass(frozen=True, slots=True)
class SetVelocity:
    """Input velocity of the motor with a feed-forward of torque."""

    velocity_turn_s: float
    torque_nm: float = 0.0


@dataclass(frozen=True, slots=True)
class SetTorque:
    """Input torque."""

    torque_nm: float


@dataclass(frozen=True, slots=True)
class SetLimits:
    """Greatest speed and current."""

    velocity_turn_s: float
    current_a: float


@dataclass(frozen=True, slots=True)
class StartAnticogging:
    """Calibrate against cogging (0.5)."""


@dataclass(frozen=True, slots=True)
class SetTrajectoryVelocity:
    """Cruise speed of planned moves."""

    velocity_turn_s: float


@dataclass(frozen=True, slots=True)
class SetTrajectoryAcceleration:
    """Accelerations of planned moves."""

    accel_turn_s2: float
    decel_turn_s2: float


@dataclass(frozen=True, slots=True)
class SetTrajectoryInertia:
    """Inertia for planned moves."""

    inertia_nm_turn_s2: float


@dataclass(frozen=True, slots=True)
class Reboot:
    """0.6: 0 restart, 1 save the configuration first, 2 erase it first; 0.5 just restarts."""

    action: int = 0


@dataclass(frozen=True, slots=True)
class ClearErrors:
    """Forget all errors of an axis; 0.6 may blink at it."""

    identify: int = 0


@dataclass(frozen=True, slots=True)
class SetLinearCount:
    """The encoder's count is this now (0.5)."""

    count: int


@dataclass(frozen=True, slots=True)
class SetAbsolutePosition:
    """The encoder's position is this now (0.6)."""

    position_turn: float


@dataclass(frozen=True, slots=True)
class SetPositionGain:
    """In (turn/s)/turn."""

    gain: float


@dataclass(frozen=True, slots=True)
class SetVelocityGains:
    """In Nm/(turn/s), and that per second."""

    proportional: float
    integral: float


@dataclass(frozen=True, slots=True)
class EnterDfu:
    """Wait for new firmware (0.6)."""


_BOTH = (
    Layout(0x02, Estop), Layout(0x07, SetState, "<I"), Layout(0x09, Encoder, "<ff"),
    Layout(0x0B, SetMode, "<II", least=4), Layout(0x0C, SetPosition, "<fhh", (1.0, 1e3, 1e3), least=4),
    Layout(0x0D, SetVelocity, "<ff", least=4), Layout(0x0E, SetTorque, "<f"), Layout(0x0F, SetLimits, "<ff"),
    Layout(0x11, SetTrajectoryVelocity, "<f"), Layout(0x12, SetTrajectoryAcceleration, "<ff"),
    Layout(0x13, SetTrajectoryInertia, "<f"), Layout(0x14, Iq, "<ff"), Layout(0x17, BusPower, "<ff"),
    Layout(0x1A, SetPositionGain, "<f"), Layout(0x1B, SetVelocityGains, "<ff"),
)  # fmt: skip
_ONLY_05 = (
    Layout(0x01, Heartbeat05, "<IBBBB", least=5), Layout(0x03, MotorError, "<Q", least=4),
    Layout(0x04, EncoderError, "<Ixxxx", least=4), Layout(0x05, SensorlessError, "<Ixxxx", least=4),
    Layout(0x06, SetNode, "<I"),
    Layout(0x0A, EncoderCount, "<ii"), Layout(0x10, StartAnticogging), Layout(0x15, Sensorless, "<ff"),
    Layout(0x16, Reboot), Layout(0x18, ClearErrors), Layout(0x19, SetLinearCount, "<i"),
    Layout(0x1C, AdcVoltage, "<fxxxx", least=4), Layout(0x1D, ControllerError, "<Ixxxx", least=4),
)  # fmt: skip
_ONLY_06 = (
    Layout(0x00, Version, "<BBBBBBBB", least=7), Layout(0x01, Heartbeat, "<IBBBx", least=5),
    Layout(0x03, Errors, "<II"), Layout(0x04, SdoRequest, "<BHBI", least=4), Layout(0x05, SdoReply, "<BHBI", least=4),
    Layout(0x06, Address, "<B6s"), Layout(0x15, Temperature, "<ff", unknown=True), Layout(0x16, Reboot, "<B", least=0),
    Layout(0x18, ClearErrors, "<B", least=0), Layout(0x19, SetAbsolutePosition, "<f"), Layout(0x1C, Torques, "<ff"),
    Layout(0x1D, Powers, "<ff"), Layout(0x1F, EnterDfu),
)  # fmt: skip
TABLES: dict[Firmware, Table[Any]] = {"0.5": Table(_BOTH + _ONLY_05), "0.6": Table(_BOTH + _ONLY_06)}


def encode(node: int, message: object, firmware: Firmware = "0.6") -> Frame:
    """Return the frame of `message` to or from `node`.

    Raises ``KeyError`` when this firmware does not know it, ``ValueError`` when a value does not fit.
    """
    command, data = TABLES[firmware].pack(message)
    return Frame(node << 5 | command, extended=False, data=data)


def decode(frame: Frame, firmware: Firmware = "0.6") -> object | None:
    """Return what `frame` says; None when this firmware has no such message or it is malformed."""
    if frame.extended or frame.remote or frame.id >> 5 > MAX_NODE:
        return None
    message: object | None = TABLES[firmware].unpack(frame.id & 0x1F, frame.data)
    return message


def request(node: int, kind: type[object], firmware: Firmware = "0.6") -> Frame:
    """Return the remote frame that asks `node` for a message of this kind."""
    return Frame(node << 5 | TABLES[firmware].by_kind[kind].command, extended=False, remote=True)
