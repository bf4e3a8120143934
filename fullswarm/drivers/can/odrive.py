"""ODrive CANSimple 0.5 and 0.6: 11-bit identifiers ``node << 5 | command``, little endian. Bytes only.

A remote frame with the identifier of a message that the axis sends asks for it. Sources: ODrive's CAN protocol pages,
firmware 0.5.6, and the DBC files of 0.5.6 and 0.6.10.
"""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass
from typing import Any, Literal

from fullswarm.drivers.can.layout import Layout, Table
from fullswarm.drivers.can.protocol import Beat, Frame, Mode, Motion, Power, Report, Want, Wheel
from fullswarm.drivers.can.protocol import Version as WheelVersion

Firmware = Literal["0.5", "0.6"]

MAX_NODE = 63
VELOCITY_CONTROL = 2
PASSTHROUGH, VELOCITY_RAMP = 1, 2


# ---------------------------------------------------------------- what an axis reports
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


# ---------------------------------------------------------------- what is sent to it
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
    """Asked for remotely: which node has which serial number; sent: a node number for it (0.6)."""

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
    """Return the message in `frame`; None when this firmware has no such message or it is malformed."""
    if frame.extended or frame.remote or frame.id >> 5 > MAX_NODE:
        return None
    message: object | None = TABLES[firmware].unpack(frame.id & 0x1F, frame.data)
    return message


def request(node: int, kind: type[object], firmware: Firmware = "0.6") -> Frame:
    """Return the remote frame that asks `node` for a message of this kind."""
    return Frame(node << 5 | TABLES[firmware].by_kind[kind].command, extended=False, remote=True)


# ---------------------------------------------------------------- states and errors
class AxisState(enum.IntEnum):
    """What an axis does."""

    UNDEFINED = 0
    IDLE = 1
    STARTUP_SEQUENCE = 2
    FULL_CALIBRATION = 3
    MOTOR_CALIBRATION = 4
    ENCODER_INDEX_SEARCH = 6
    ENCODER_OFFSET_CALIBRATION = 7
    CLOSED_LOOP = 8
    LOCKIN_SPIN = 9
    ENCODER_DIR_FIND = 10
    HOMING = 11


_STATE_NAMES = {int(state): state.name for state in AxisState}

ERRORS: dict[Firmware, dict[int, str]] = {
    "0.5": {
        0x1: "INVALID_STATE",
        0x2: "DC_BUS_UNDER_VOLTAGE",
        0x4: "DC_BUS_OVER_VOLTAGE",
        0x8: "CURRENT_MEASUREMENT_TIMEOUT",
        0x10: "BRAKE_RESISTOR_DISARMED",
        0x20: "MOTOR_DISARMED",
        0x40: "MOTOR_FAILED",
        0x80: "SENSORLESS_ESTIMATOR_FAILED",
        0x100: "ENCODER_FAILED",
        0x200: "CONTROLLER_FAILED",
        0x800: "WATCHDOG_TIMER_EXPIRED",
        0x1000: "MIN_ENDSTOP_PRESSED",
        0x2000: "MAX_ENDSTOP_PRESSED",
        0x4000: "ESTOP_REQUESTED",
        0x20000: "HOMING_WITHOUT_ENDSTOP",
        0x40000: "OVER_TEMP",
        0x80000: "UNKNOWN_POSITION",
    },
    "0.6": {
        0x1: "INITIALIZING",
        0x2: "SYSTEM_LEVEL",
        0x4: "TIMING_ERROR",
        0x8: "MISSING_ESTIMATE",
        0x10: "BAD_CONFIG",
        0x20: "DRV_FAULT",
        0x40: "MISSING_INPUT",
        0x100: "DC_BUS_OVER_VOLTAGE",
        0x200: "DC_BUS_UNDER_VOLTAGE",
        0x400: "DC_BUS_OVER_CURRENT",
        0x800: "DC_BUS_OVER_REGEN_CURRENT",
        0x1000: "CURRENT_LIMIT_VIOLATION",
        0x2000: "MOTOR_OVER_TEMP",
        0x4000: "INVERTER_OVER_TEMP",
        0x8000: "VELOCITY_LIMIT_VIOLATION",
        0x10000: "POSITION_LIMIT_VIOLATION",
        0x1000000: "WATCHDOG_TIMER_EXPIRED",
        0x2000000: "ESTOP_REQUESTED",
        0x4000000: "SPINOUT_DETECTED",
        0x8000000: "BRAKE_RESISTOR_DISARMED",
        0x10000000: "THERMISTOR_DISCONNECTED",
        0x40000000: "CALIBRATION_ERROR",
    },
}


def error_names(bits: int, firmware: Firmware) -> str:
    """Return the names of the error bits, an unknown bit as its number; empty for none."""
    known = ERRORS[firmware]
    set_bits = (1 << shift for shift in range(32) if bits >> shift & 1)
    return ", ".join(known.get(bit, f"error bit {bit:#x}") for bit in set_bits)


def error_bit(name: str, firmware: Firmware) -> int:
    """Return the bit of a named error; ``KeyError`` for an unknown name."""
    return {text: bit for bit, text in ERRORS[firmware].items()}[name]


def state_name(state: int) -> str:
    """Return the name of an axis state, an unknown one as its number."""
    return _STATE_NAMES.get(state, f"state {state}")


# ---------------------------------------------------------------- one wheel
MAX_TURN_S = 1e4
"""No motor turns faster: a larger reported value is noise."""
ESTOP = "ESTOP_REQUESTED"
_OTHER: dict[Firmware, Firmware] = {"0.5": "0.6", "0.6": "0.5"}
_MODES: dict[int, Mode] = {AxisState.IDLE: Mode.IDLE, AxisState.CLOSED_LOOP: Mode.DRIVING}
_OURS: dict[Firmware, frozenset[int]] = {
    "0.5": frozenset({0x01, 0x09, 0x17}),
    "0.6": frozenset({0, 0x01, 0x09, 0x17}),
}


@dataclass(slots=True)
class OdriveCodec:
    """One axis as a :class:`~fullswarm.drivers.can.protocol.WheelCodec`.

    The axis' watchdog is off as delivered and no CANSimple command switches it on: do it once over USB with
    ``odrv0.axis0.config.watchdog_timeout = 0.5``, ``…enable_watchdog = True``, ``odrv0.save_configuration()``.
    (0.6 could be set through its parameter frames, but by numbers that change with every firmware build: a
    wrong one would write to another parameter.) When on, 0.5 is fed by every frame to the axis, 0.6 by
    set-points, so `keep_alive` is a set-point of zero.
    """

    node: int
    wheel: Wheel
    firmware: Firmware = "0.6"
    limit_turn_s: float = 2.0  # the axis' own vel_limit
    input_mode: int = PASSTHROUGH
    malformed: int = 0
    identified: bool = False  # its version is known, which only 0.6 reports

    @property
    def max_speed_m_s(self) -> float:
        """Return the speed at the axis' ``vel_limit``; it disarms at 1.2 times that."""
        return abs(self.wheel.metres(self.limit_turn_s))

    @property
    def generic_firmware(self) -> str:
        """Return what is known when the axis does not report it: 0.5 cannot."""
        return f"ODrive CANSimple {self.firmware}"

    def quantised(self, speed_m_s: float) -> float:
        """Return `speed_m_s` after its journey through a 32-bit float."""
        (turn_s,) = struct.unpack("<f", struct.pack("<f", self.wheel.turns(speed_m_s)))
        return self.wheel.metres(turn_s)

    def start(self) -> tuple[Frame, ...]:
        """Clear errors, velocity control, zero; 0.6 is asked for its version."""
        return (*self._send(ClearErrors(), self._mode, SetVelocity(0.0)), *self.poll(Want.VERSION))

    def engage(self) -> tuple[Frame, ...]:
        """Velocity control at zero, then closed loop. Errors are not cleared here: one may be an e-stop."""
        return self._send(self._mode, SetVelocity(0.0), SetState(AxisState.CLOSED_LOOP))

    def drive(self, speed_m_s: float) -> tuple[Frame, ...]:
        """Set the input velocity."""
        return self._send(SetVelocity(self.wheel.turns(speed_m_s)))

    def release(self) -> tuple[Frame, ...]:
        """Zero and IDLE: the wheel coasts."""
        return self._send(SetVelocity(0.0), SetState(AxisState.IDLE))

    def keep_alive(self) -> tuple[Frame, ...]:
        """Set zero, which an idle axis ignores but its watchdog counts."""
        return self._send(SetVelocity(0.0))

    def poll(self, wants: Want) -> tuple[Frame, ...]:
        """Ask for what does not come by itself; heartbeats always do, a version only from 0.6."""
        kinds: list[type[object]] = []
        if Want.MOTION in wants:
            kinds.append(Encoder)
        if Want.POWER in wants:
            kinds.append(BusPower)
        if Want.VERSION in wants and self.firmware == "0.6":
            kinds.append(Version)
        return tuple(request(self.node, kind, self.firmware) for kind in kinds)

    def decode(self, frame: Frame) -> Report | None:
        """Return what the axis reports: heartbeat, encoder estimates, bus voltage, version."""
        if frame.extended or frame.remote or frame.id >> 5 != self.node or frame.id & 0x1F not in _OURS[self.firmware]:
            return None
        report = self._report(decode(frame, self.firmware))
        self.malformed += report is None
        return report

    def _report(self, message: object) -> Report | None:
        match message:
            case Encoder(position_turn=turns, velocity_turn_s=turn_s) if abs(turn_s) <= MAX_TURN_S:
                return Motion(self.wheel.metres(turn_s), self.wheel.metres(turns))
            case Heartbeat(error=error, state=state) | Heartbeat05(error=error, state=state):
                return self._beat(error, state)
            case BusPower(volts=volts) if volts >= 0.0:
                return Power(volts)
            case Version(major=major, minor=minor, revision=revision):
                self.identified = True
                return WheelVersion(f"ODrive {major}.{minor}.{revision}")
        return None

    def _beat(self, error: int, state: int) -> Beat:
        is_estop = bool(error & error_bit(ESTOP, self.firmware))
        names = error_names(error, self.firmware)
        if not is_estop and not self.identified and error & error_bit(ESTOP, _OTHER[self.firmware]):
            # The URL may name the wrong generation, and an e-stop must not be cleared for that.
            is_estop, names = True, f"{names} (or, with firmware={_OTHER[self.firmware]} in its URL, {ESTOP})"
        # An unknown state is as good as a calibration: the wheel does not obey.
        return Beat(_MODES.get(state, Mode.BUSY), state_name(state), names, is_estop)

    @property
    def _mode(self) -> SetMode:
        return SetMode(VELOCITY_CONTROL, self.input_mode)

    def _send(self, *messages: object) -> tuple[Frame, ...]:
        return tuple(encode(self.node, message, self.firmware) for message in messages)
