"""VESC: 29-bit identifiers ``command << 8 | node``, big endian, no acknowledgements. Bytes only.

Source: VESC firmware ``comm_can.c``, ``datatypes.h``.
"""

from __future__ import annotations

import enum
import struct
from dataclasses import dataclass

from fullswarm.drivers.can.protocol import MAX_DATA, Beat, Frame, Mode, Motion, Report, Wheel

MAX_NODE = 254
EVERYBODY = 255
MAX_ERPM = 2_000_000
"""No motor turns faster: a larger reported value is noise."""
TACHO_PER_TURN = 6
"""Tachometer counts per electrical turn."""
FIRMWARE_TIMEOUT_S = 1.0
"""As delivered: without a SET command for that long the motor is let go."""


class Command(enum.IntEnum):
    """Command part of the identifier."""

    SET_DUTY = 0
    SET_CURRENT = 1
    SET_BRAKE = 2
    SET_ERPM = 3
    STATUS_1 = 9
    PING = 17
    PONG = 18
    STATUS_5 = 27


def frame(node: int, command: Command, data: bytes) -> Frame:
    """Return the frame of `command` to or from `node`."""
    return Frame(command << 8 | node, extended=True, data=data)


def set_current(node: int, current_a: float) -> Frame:
    """Drive with a motor current; zero lets the motor go."""
    return frame(node, Command.SET_CURRENT, struct.pack(">i", round(current_a * 1e3)))


def set_brake(node: int, current_a: float) -> Frame:
    """Brake with a motor current; without effect at rest."""
    return frame(node, Command.SET_BRAKE, struct.pack(">i", round(current_a * 1e3)))


def set_erpm(node: int, erpm: int) -> Frame:
    """Regulate the electrical speed; below the firmware's minimum the motor is let go."""
    return frame(node, Command.SET_ERPM, struct.pack(">i", erpm))


def ping(node: int, host: int) -> Frame:
    """Ask for a sign of life, to be sent to `host`."""
    return frame(node, Command.PING, bytes([host]))


def pong(host: int, node: int) -> Frame:
    """Return the answer of `node` to `host`; the second byte is the hardware type."""
    return frame(host, Command.PONG, bytes([node, 0]))


def status_1(node: int, erpm: int, current_a: float, duty: float) -> Frame:
    """Return the first status message."""
    return frame(node, Command.STATUS_1, struct.pack(">ihh", erpm, round(current_a * 10), round(duty * 1e3)))


def status_5(node: int, tacho: int, volts: float) -> Frame:
    """Return the fifth status message: tachometer and input voltage."""
    return frame(node, Command.STATUS_5, struct.pack(">ihh", tacho, round(volts * 10), 0))


@dataclass(slots=True)
class VescCodec:
    """One controller as a :class:`~fullswarm.drivers.can.protocol.WheelCodec`.

    The protocol has no states and its status messages no faults: life is shown by answering a ping, and a
    controller in fault only by a wheel that does not turn. Status messages 1 and 5 are off as delivered and its
    timeout (1 s, then the motor coasts) is set in VESC Tool only; just SET commands feed it. A set-point inside
    the dead band is sent as a brake current, because the regulator would let the wheel roll.
    """

    node: int
    wheel: Wheel
    host: int = 253  # our own address, for pongs
    min_erpm: float = 900.0  # s_pid_min_erpm
    brake_a: float = 5.0
    malformed: int = 0

    @property
    def max_speed_m_s(self) -> float:
        """Return ``inf``: the controller's own limit is not to be had on the bus."""
        return float("inf")

    def quantised(self, speed_m_s: float) -> float:
        """Return the speed of the nearest whole ERPM, zero below the firmware's minimum."""
        return self.wheel.speed_of_erpm(self._erpm(speed_m_s))

    def _erpm(self, speed_m_s: float) -> int:
        erpm = round(max(-MAX_ERPM, min(MAX_ERPM, self.wheel.erpm(speed_m_s))))
        return erpm if abs(erpm) >= self.min_erpm else 0

    def start(self) -> tuple[Frame, ...]:
        """Nothing to clear and no mode to choose: let the motor go."""
        return self.release()

    def engage(self) -> tuple[Frame, ...]:
        """Hold the wheel."""
        return self.drive(0.0)

    def drive(self, speed_m_s: float) -> tuple[Frame, ...]:
        """Regulate the speed, or brake when it is zero or too slow to be regulated."""
        erpm = self._erpm(speed_m_s)
        return (set_erpm(self.node, erpm) if erpm else set_brake(self.node, self.brake_a),)

    def release(self) -> tuple[Frame, ...]:
        """Current zero: the wheel coasts."""
        return (set_current(self.node, 0.0),)

    def keep_alive(self) -> tuple[Frame, ...]:
        """Nothing: an idle controller that times out stays idle."""
        return ()

    def poll(self, *, motion_due: bool) -> tuple[Frame, ...]:
        """Ping; status messages cannot be asked for."""
        del motion_due
        return (ping(self.node, self.host),)

    def decode(self, frame: Frame) -> Report | None:
        """Return what the controller tells: pong, speed, tachometer."""
        if not frame.extended or frame.remote:
            return None
        command, address, data = frame.id >> 8, frame.id & 0xFF, frame.data
        if command == Command.PONG and address == self.host:
            if not 1 <= len(data) <= MAX_DATA:
                self.malformed += 1
            return Beat(Mode.UNKNOWN) if data[:1] == bytes([self.node]) and len(data) <= MAX_DATA else None
        if address != self.node or command not in (Command.STATUS_1, Command.STATUS_5):
            return None
        report = self._motion(command, data)
        self.malformed += report is None
        return report

    def _motion(self, command: int, data: bytes) -> Motion | None:
        if not (6 if command == Command.STATUS_5 else 8) <= len(data) <= MAX_DATA:
            return None
        (value,) = struct.unpack_from(">i", data)
        if command == Command.STATUS_5:
            return Motion(None, self.wheel.metres(value / (TACHO_PER_TURN * self.wheel.pole_pairs)))
        return Motion(self.wheel.speed_of_erpm(value), None) if abs(value) <= MAX_ERPM else None
