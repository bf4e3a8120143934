"""ODrive CANSimple 0.5 and 0.6: 11-bit identifiers ``node << 5 | command``, little endian. Bytes only.

The two versions differ, for what a wheel needs, in the bits of the heartbeat's error word and in `GET_VERSION`,
which only 0.6 answers. Source: ODrive's CAN protocol pages and firmware 0.5.6.
"""

from __future__ import annotations

import enum
import math
import struct
from dataclasses import dataclass
from typing import Literal

from fullswarm.drivers.can.protocol import MAX_DATA, Beat, Frame, Mode, Motion, Report, Version, Wheel

Firmware = Literal["0.5", "0.6"]

MAX_NODE = 63
MAX_TURN_S = 1e4
"""No motor turns faster: a larger reported value is noise."""


class Command(enum.IntEnum):
    """Command part of the identifier."""

    GET_VERSION = 0x00  # 0.6
    HEARTBEAT = 0x01
    ESTOP = 0x02
    SET_STATE = 0x07
    ENCODER = 0x09
    SET_MODE = 0x0B
    SET_VELOCITY = 0x0D
    SET_LIMITS = 0x0F
    REBOOT = 0x16
    BUS_POWER = 0x17
    CLEAR_ERRORS = 0x18


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

VELOCITY_CONTROL = 2
PASSTHROUGH, VELOCITY_RAMP = 1, 2

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


# ---------------------------------------------------------------- frames
def frame(node: int, command: Command, data: bytes = b"", *, remote: bool = False) -> Frame:
    """Return the frame of `command` to or from `node`."""
    return Frame(node << 5 | command, extended=False, data=data, remote=remote)


def set_state(node: int, state: AxisState) -> Frame:
    """Ask for an axis state (4 bytes, as the maker's own clients send it)."""
    return frame(node, Command.SET_STATE, struct.pack("<I", state))


def set_mode(node: int, input_mode: int) -> Frame:
    """Choose velocity control with `input_mode` passthrough or ramp."""
    return frame(node, Command.SET_MODE, struct.pack("<II", VELOCITY_CONTROL, input_mode))


def set_velocity(node: int, turn_s: float, torque_nm: float = 0.0) -> Frame:
    """Set the input velocity of the motor in turn/s."""
    return frame(node, Command.SET_VELOCITY, struct.pack("<ff", turn_s, torque_nm))


def clear_errors(node: int) -> Frame:
    """Forget all errors of an axis."""
    return frame(node, Command.CLEAR_ERRORS)


def estop(node: int) -> Frame:
    """Disarm at once and latch ESTOP_REQUESTED until the errors are cleared."""
    return frame(node, Command.ESTOP)


def heartbeat(node: int, error: int, state: int, tail: bytes = bytes(3)) -> Frame:
    """Return what an axis sends every 100 ms; `tail` differs between 0.5 and 0.6."""
    return frame(node, Command.HEARTBEAT, struct.pack("<IB", error, state) + tail)


def encoder(node: int, position_turn: float, velocity_turn_s: float) -> Frame:
    """Return an axis' encoder estimates."""
    return frame(node, Command.ENCODER, struct.pack("<ff", position_turn, velocity_turn_s))


@dataclass(slots=True)
class OdriveCodec:
    """One axis as a :class:`~fullswarm.drivers.can.protocol.WheelCodec`.

    The axis' watchdog is off as delivered and no CANSimple command switches it on: do it once over USB with
    ``odrv0.axis0.config.watchdog_timeout = 0.5``, ``…enable_watchdog = True``, ``odrv0.save_configuration()``.
    (0.6 could be told through its parameter frames, but by numbers that change with every firmware build: a
    wrong one would write to another parameter.) When on, 0.5 is fed by every frame to the axis, 0.6 by
    set-points, so `keep_alive` is a set-point of zero.
    """

    node: int
    wheel: Wheel
    firmware: Firmware = "0.6"
    limit_turn_s: float = 2.0  # the axis' own vel_limit
    input_mode: int = PASSTHROUGH
    malformed: int = 0

    @property
    def max_speed_m_s(self) -> float:
        """Return the speed at the axis' ``vel_limit``; it disarms at 1.2 times that."""
        return abs(self.wheel.metres(self.limit_turn_s))

    def quantised(self, speed_m_s: float) -> float:
        """Return `speed_m_s` after its journey through a 32-bit float."""
        (turn_s,) = struct.unpack("<f", struct.pack("<f", self.wheel.turns(speed_m_s)))
        return self.wheel.metres(turn_s)

    def start(self) -> tuple[Frame, ...]:
        """Clear errors, velocity control, zero; 0.6 is asked for its version."""
        frames = (clear_errors(self.node), set_mode(self.node, self.input_mode), set_velocity(self.node, 0.0))
        ask = (frame(self.node, Command.GET_VERSION, remote=True),) if self.firmware == "0.6" else ()
        return frames + ask

    def engage(self) -> tuple[Frame, ...]:
        """Velocity control at zero, then closed loop. Errors are not cleared here: one may be an e-stop."""
        zero = set_velocity(self.node, 0.0)
        return set_mode(self.node, self.input_mode), zero, set_state(self.node, AxisState.CLOSED_LOOP)

    def drive(self, speed_m_s: float) -> tuple[Frame, ...]:
        """Set the input velocity."""
        return (set_velocity(self.node, self.wheel.turns(speed_m_s)),)

    def release(self) -> tuple[Frame, ...]:
        """Zero and IDLE: the wheel coasts."""
        return set_velocity(self.node, 0.0), set_state(self.node, AxisState.IDLE)

    def keep_alive(self) -> tuple[Frame, ...]:
        """Set zero, which an idle axis ignores but its watchdog counts."""
        return (set_velocity(self.node, 0.0),)

    def poll(self, *, motion_due: bool) -> tuple[Frame, ...]:
        """Ask for the encoder estimates when they do not come by themselves; heartbeats always do."""
        return (frame(self.node, Command.ENCODER, remote=True),) if motion_due else ()

    def decode(self, frame: Frame) -> Report | None:
        """Return what the axis tells: heartbeat, encoder estimates, version."""
        if frame.extended or frame.remote or frame.id >> 5 != self.node:
            return None
        report: Report | None
        match frame.id & 0x1F:
            case Command.HEARTBEAT:
                report = self._beat(frame.data)
            case Command.ENCODER:
                report = self._motion(frame.data)
            case Command.GET_VERSION if self.firmware == "0.6":
                report = _version(frame.data)
            case _:
                return None
        self.malformed += report is None
        return report

    def _beat(self, data: bytes) -> Beat | None:
        if not 5 <= len(data) <= MAX_DATA:
            return None
        error, state = struct.unpack_from("<IB", data)
        modes = {AxisState.IDLE: Mode.IDLE, AxisState.CLOSED_LOOP: Mode.DRIVING}
        is_estop = bool(error & error_bit("ESTOP_REQUESTED", self.firmware))
        return Beat(modes.get(state, Mode.BUSY), state_name(state), error_names(error, self.firmware), is_estop)

    def _motion(self, data: bytes) -> Motion | None:
        if len(data) != MAX_DATA:
            return None
        turns, turn_s = struct.unpack("<ff", data)
        if not (math.isfinite(turns) and abs(turn_s) <= MAX_TURN_S):
            return None
        return Motion(self.wheel.metres(turn_s), self.wheel.metres(turns))


def _version(data: bytes) -> Version | None:
    """Bytes 4 to 6 are the firmware's major, minor and revision."""
    return Version(f"ODrive {data[4]}.{data[5]}.{data[6]}") if 7 <= len(data) <= MAX_DATA else None
