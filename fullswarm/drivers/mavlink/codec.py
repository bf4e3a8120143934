"""Frames ↔ messages, through pymavlink's generated dialect. Bytes in, bytes out: no sockets, no clock.

pymavlink is imported at the first use, never with the package, and with ``MAVLINK20=1``: without it a mavutil
that is imported later in the same process would fall back to MAVLink 1 and accept unsigned frames.
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable
from typing import Any

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.errors import MissingExtra

MARKER_V1, MARKER_V2 = 0xFE, 0xFD
_HEADER = {MARKER_V1: 6, MARKER_V2: 10}
_SIGNED, _SIGNATURE_BYTES, _CRC_BYTES = 0x01, 13, 2
_UNKNOWN_VOLTAGE_MV, _UNKNOWN = 65535, -1


@functools.cache
def dialect() -> Any:
    """Return pymavlink's ``ardupilotmega`` dialect (a superset of ``common``).

    Raises
    ------
    MissingExtra
        pymavlink is not installed; says how to install it.
    """
    os.environ["MAVLINK20"] = "1"
    try:
        from pymavlink.dialects.v20 import ardupilotmega
    except ImportError as error:
        raise MissingExtra(
            "MAVLink rovers need pymavlink, which is not installed", hint="pip install 'fullswarm[mavlink]'"
        ) from error
    return ardupilotmega


class StreamParser:
    """Cuts a byte stream into MAVLink messages; console text, noise and torn frames are skipped, never raised.

    pymavlink's own parser drops a whole frame's length after a stray marker byte, real frames inside included.
    This one moves on by one byte, so a good frame is never lost to the noise before it.
    """

    def __init__(self) -> None:
        self._mav = dialect().MAVLink(None)
        self._buffer = bytearray()
        self.skipped_bytes = 0

    def feed(self, data: bytes) -> list[Any]:
        """Return the dialect's messages that `data` completes."""
        self._buffer += data
        buffer, messages, at = self._buffer, [], 0
        while at < len(buffer):
            length = _frame_length(buffer, at)
            if length is None or at + length > len(buffer):
                break
            message = self._decode(buffer[at : at + length]) if length else None
            if message is None:
                at += 1
                self.skipped_bytes += 1
            else:
                at += length
                messages.append(message)
        del buffer[:at]
        return messages

    def reset(self) -> None:
        """Forget a frame that has begun: the stream was torn (datagram boundary, reconnect)."""
        self.skipped_bytes += len(self._buffer)
        self._buffer.clear()

    def _decode(self, frame: bytearray) -> Any | None:
        try:
            return self._mav.decode(frame)
        except dialect().MAVError:
            return None


def _frame_length(buffer: bytearray, at: int) -> int | None:
    """Return the length of the frame that begins at `at`; 0 if none can, None if more bytes must come first.

    The header alone rules out most noise, so that a stray marker seldom holds up what follows. A message that
    the dialect does not know is searched through like noise: its checksum cannot be verified.
    """
    marker = buffer[at]
    if marker not in _HEADER:
        return 0
    if len(buffer) - at < _HEADER[marker]:
        return None
    payload, flags = buffer[at + 1], buffer[at + 2]
    if marker == MARKER_V1:
        kind = dialect().mavlink_map.get(buffer[at + 5])
        fits = kind is not None and payload <= kind.unpacker.size  # version 1 has no extensions
        return _HEADER[marker] + payload + _CRC_BYTES if fits else 0
    known = int.from_bytes(buffer[at + 7 : at + 10], "little") in dialect().mavlink_map
    if not known or flags & ~_SIGNED:
        return 0
    signature = _SIGNATURE_BYTES if flags & _SIGNED else 0
    return _HEADER[marker] + payload + _CRC_BYTES + signature


# ---------------------------------------------------------------- decoding
def decode(message: Any) -> p.Received | None:
    """Return a dialect's message as our own type; None if it is not one we use or holds non-finite numbers."""
    decoder = _DECODERS.get(message.get_type())
    body = decoder(message) if decoder else None
    return None if body is None else p.Received(message.get_srcSystem(), message.get_srcComponent(), body)


def _heartbeat(m: Any) -> p.Body:
    return p.Heartbeat(m.type, m.autopilot, m.base_mode, m.custom_mode, m.system_status)


def _local_position(m: Any) -> p.Body | None:
    if not _finite(m.x, m.y, m.z, m.vx, m.vy, m.vz):
        return None
    position, velocity = p.enu_from_ned(m.x, m.y, m.z), p.enu_from_ned(m.vx, m.vy, m.vz)
    return p.LocalPosition(m.time_boot_ms, *position, *velocity)


def _attitude(m: Any) -> p.Body | None:
    if not _finite(m.roll, m.pitch, m.yaw, m.rollspeed, m.pitchspeed, m.yawspeed):
        return None
    rates = p.flu_from_frd(m.rollspeed, m.pitchspeed, m.yawspeed)
    return p.Attitude(m.time_boot_ms, m.roll, -m.pitch, p.heading_from_yaw(m.yaw), *rates)


def _ekf(m: Any) -> p.Body:
    return p.EkfStatus(m.flags)


def _battery(m: Any) -> p.Body | None:
    if m.id != 0:
        return None  # the first pack is the one that drives
    cells_mv = [mv for mv in m.voltages if mv != _UNKNOWN_VOLTAGE_MV]
    return p.Battery(
        voltage_v=sum(cells_mv) / 1000 if cells_mv else None,
        current_a=None if m.current_battery == _UNKNOWN else m.current_battery / 100,
        remaining=_share(m.battery_remaining),
    )


def _sys_status(m: Any) -> p.Body:
    return p.Battery(
        voltage_v=None if m.voltage_battery == _UNKNOWN_VOLTAGE_MV else m.voltage_battery / 1000,
        current_a=None if m.current_battery == _UNKNOWN else m.current_battery / 100,
        remaining=_share(m.battery_remaining),
    )


def _share(percent: int) -> float | None:
    return percent / 100 if 0 <= percent <= 100 else None


def _text(m: Any) -> p.Body:
    return p.StatusText(m.severity, m.text, m.id, m.chunk_seq)


def _ack(m: Any) -> p.Body:
    return p.Ack(m.command, m.result, m.target_system, m.target_component)


def _parameter(m: Any) -> p.Body | None:
    return p.Parameter(m.param_id, m.param_value) if _finite(m.param_value) else None


def _version(m: Any) -> p.Body:
    number = m.flight_sw_version
    return p.Version(number >> 24 & 0xFF, number >> 16 & 0xFF, number >> 8 & 0xFF)


def _finite(*values: float) -> bool:
    return all(map(math.isfinite, values))


_DECODERS: dict[str, Callable[[Any], p.Body | None]] = {
    "HEARTBEAT": _heartbeat,
    "LOCAL_POSITION_NED": _local_position,
    "ATTITUDE": _attitude,
    "EKF_STATUS_REPORT": _ekf,
    "BATTERY_STATUS": _battery,
    "SYS_STATUS": _sys_status,
    "STATUSTEXT": _text,
    "COMMAND_ACK": _ack,
    "PARAM_VALUE": _parameter,
    "AUTOPILOT_VERSION": _version,
}


# ---------------------------------------------------------------- encoding
class Encoder:
    """Makes the frames of one sender, sequence numbers included."""

    def __init__(self, system: int, component: int) -> None:
        self._mav = dialect().MAVLink(None, srcSystem=system, srcComponent=component)

    def pack(self, message: Any) -> bytes:
        """Return a dialect's message as a MAVLink 2 frame."""
        frame: bytes = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame


class StationEncoder(Encoder):
    """Frames of the controlling station for one vehicle."""

    def __init__(self, system: int, component: int, vehicle: int) -> None:
        super().__init__(system, component)
        self._vehicle = vehicle

    def heartbeat(self) -> bytes:
        """Return our own heartbeat: a ground station (type 6), no autopilot."""
        return self.pack(dialect().MAVLink_heartbeat_message(6, p.AUTOPILOT_NONE, 0, 0, p.STATUS_ACTIVE, 3))

    def command(self, command: int, *values: float, confirmation: int = 0) -> bytes:
        """Return COMMAND_LONG with up to seven parameters, the rest 0.

        Raises
        ------
        ValueError
            A parameter is not finite: some make the firmware abort.
        """
        if not _finite(*values):
            raise ValueError(f"a parameter of command {command} is not finite: {values}")
        seven = [*map(float, values), *[0.0] * (7 - len(values))]
        return self.pack(dialect().MAVLink_command_long_message(self._vehicle, 1, command, confirmation & 0xFF, *seven))

    def set_mode(self, mode: int, confirmation: int = 0) -> bytes:
        """Ask for a mode; confirmed by a later heartbeat's ``custom_mode`` only."""
        return self.command(p.COMMAND_SET_MODE, p.BASE_MODE_CUSTOM, mode, confirmation=confirmation)

    def arm(self, arm: bool, confirmation: int = 0) -> bytes:
        """Ask to arm or disarm, never by force; confirmed by a later heartbeat's ``base_mode`` only."""
        return self.command(p.COMMAND_ARM, float(arm), confirmation=confirmation)

    def message_interval(self, message: int, rate_hz: float, confirmation: int = 0) -> bytes:
        """Ask for a message at `rate_hz`; 0.8 of the firmware's loop rate (40 Hz of 50) is the most it grants."""
        interval_us = round(1e6 / rate_hz)
        return self.command(p.COMMAND_MESSAGE_INTERVAL, message, interval_us, confirmation=confirmation)

    def request_message(self, message: int, confirmation: int = 0) -> bytes:
        """Ask for one message now."""
        return self.command(p.COMMAND_REQUEST_MESSAGE, message, confirmation=confirmation)

    def read_parameter(self, name: str) -> bytes:
        """Ask for a parameter; an unknown name is answered by silence."""
        return self.pack(dialect().MAVLink_param_request_read_message(self._vehicle, 1, name.encode("ascii"), -1))

    def set_parameter(self, name: str, value: float, kind: int = p.PARAM_REAL32) -> bytes:
        """Set a parameter (ArduPilot: any type travels as a plain float). The firmware checks no range."""
        if not _finite(value):
            raise ValueError(f"{name} cannot be set to {value}")
        return self.pack(dialect().MAVLink_param_set_message(self._vehicle, 1, name.encode("ascii"), value, kind))

    def drive(self, speed_m_s: float, turn_rad_s: float) -> bytes:
        """Return the set-point for a body velocity (x forward, counter-clockwise positive); zero stands.

        Raises
        ------
        ValueError
            Not finite, or beyond a 32-bit float: NaN in a used field makes the firmware abort or run away.
        """
        if not _finite(speed_m_s, turn_rad_s) or max(abs(speed_m_s), abs(turn_rad_s)) > 1e6:
            raise ValueError(f"a set-point must be finite, not {speed_m_s} m/s, {turn_rad_s} rad/s")
        spin = speed_m_s == 0.0 and turn_rad_s != 0.0
        yaw_rate = p.flu_from_frd(0.0, 0.0, turn_rad_s)[2]
        return self.pack(
            dialect().MAVLink_set_position_target_local_ned_message(
                0, self._vehicle, 1, p.FRAME_BODY_NED, p.MASK_TURN_ONLY if spin else p.MASK_SPEED_AND_TURN,
                0.0, 0.0, 0.0, speed_m_s, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, yaw_rate,
            )
        )  # fmt: skip

    def stand(self) -> bytes:
        """Return the zero set-point."""
        return self.drive(0.0, 0.0)
