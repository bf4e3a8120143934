"""Bytes ↔ messages, through pymavlink's generated dialect; no sockets, no clock.

pymavlink is imported at the first use, never with the package, and with ``MAVLINK20=1``: without it a mavutil
that is imported later in the same process would fall back to MAVLink 1 and accept unsigned frames.
"""

from __future__ import annotations

import functools
import math
import os
import re
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.errors import MissingExtra

MARKER_V1, MARKER_V2 = 0xFE, 0xFD
HEADER_BYTES = {MARKER_V1: 6, MARKER_V2: 10}
_SIGNED, _SIGNATURE_BYTES, _CRC_BYTES = 0x01, 13, 2
_MARKERS = re.compile(b"[\xfd\xfe]")


@functools.cache
def dialect() -> Any:
    """Return pymavlink's ``ardupilotmega`` dialect (a superset of ``common``).

    Raises
    ------
    MissingExtra
        pymavlink is not installed; the hint is how to install it.
    """
    os.environ["MAVLINK20"] = "1"
    try:
        from pymavlink.dialects.v20 import ardupilotmega
    except ImportError as error:
        raise MissingExtra(
            "MAVLink rovers need pymavlink, which is not installed", hint="pip install 'fullswarm[mavlink]'"
        ) from error
    return ardupilotmega


Believe = Callable[[bytearray, int, int], bool]
"""Whether a frame (its bytes, system, component) is authentic: see :mod:`.signing`."""


class StreamParser:
    """Cuts a byte stream into MAVLink messages; console text, noise and torn frames are skipped, never raised.

    pymavlink's own parser drops a whole frame's length after a stray marker byte, real frames inside included.
    This one moves on by one byte, so a good frame is never lost to the noise before it.

    Parameters
    ----------
    wanted
        Ids of the messages to return; others are checked and passed over without being unpacked. None: all.
    believe
        Asked for each whole frame; one that is not authentic is dropped.
    """

    def __init__(self, wanted: frozenset[int] | None = None, believe: Believe | None = None) -> None:
        self._dialect = dialect()
        self._mav = self._dialect.MAVLink(None)
        self._kinds = self._dialect.mavlink_map
        self._wanted, self._believe = wanted, believe
        self._buffer = bytearray()
        self.skipped_bytes = 0
        self.bad_checksums = 0
        self.rejected = 0

    def feed(self, data: bytes) -> list[Any]:
        """Return the dialect's messages that `data` completes."""
        self._buffer += data
        buffer, messages, at = self._buffer, [], 0
        while at < len(buffer):
            marker = _MARKERS.search(buffer, at)
            if marker is None:
                self.skipped_bytes += len(buffer) - at
                at = len(buffer)
                break
            self.skipped_bytes += marker.start() - at
            at = marker.start()
            length = self._frame_length(buffer, at)
            if length is None or at + length > len(buffer):
                break
            frame = buffer[at : at + length]
            if not length or not self._intact(frame):
                at += 1
                self.skipped_bytes += 1
                continue
            at += length
            message = self._message(frame)
            if message is not None:
                messages.append(message)
        del buffer[:at]
        return messages

    def reset(self) -> None:
        """Forget a frame that has begun: the stream was torn (datagram boundary, reconnect)."""
        self.skipped_bytes += len(self._buffer)
        self._buffer.clear()

    def _frame_length(self, buffer: bytearray, at: int) -> int | None:
        """Return the length of the frame that begins at `at`; 0 if none can, None if more bytes must come first.

        The header alone rules out most noise, so that a stray marker seldom holds up what follows. A message that
        the dialect does not know is searched through like noise: its checksum cannot be verified.
        """
        marker = buffer[at]
        if len(buffer) - at < HEADER_BYTES[marker]:
            return None
        payload, flags = buffer[at + 1], buffer[at + 2]
        if marker == MARKER_V1:
            kind = self._kinds.get(buffer[at + 5])
            fits = kind is not None and payload <= kind.unpacker.size  # version 1 has no extensions
            return HEADER_BYTES[marker] + payload + _CRC_BYTES if fits else 0
        if flags & ~_SIGNED or _message_id(buffer, at) not in self._kinds:
            return 0
        signature = _SIGNATURE_BYTES if flags & _SIGNED else 0
        return HEADER_BYTES[marker] + payload + _CRC_BYTES + signature

    def _intact(self, frame: bytearray) -> bool:
        """Tell whether the checksum is right; 16 bits, so one in 65 536 of what is no frame passes."""
        end = HEADER_BYTES[frame[0]] + frame[1]
        checksum = self._dialect.x25crc(frame[1:end] + bytes((self._kinds[_message_id(frame)].crc_extra,))).crc
        good: bool = checksum == frame[end] | frame[end + 1] << 8
        self.bad_checksums += not good
        return good

    def _message(self, frame: bytearray) -> Any | None:
        if self._wanted is not None and _message_id(frame) not in self._wanted:
            return None
        first = 3 if frame[0] == MARKER_V1 else 5
        if self._believe is not None and not self._believe(frame, frame[first], frame[first + 1]):
            self.rejected += 1
            return None
        try:
            return self._mav.decode(frame)
        except self._dialect.MAVError:
            return None


def _message_id(buffer: bytearray, at: int = 0) -> int:
    return buffer[at + 5] if buffer[at] == MARKER_V1 else int.from_bytes(buffer[at + 7 : at + 10], "little")


_UNKNOWN_VOLTAGE_MV, _UNKNOWN = 65535, -1


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
    return p.EkfStatus(m.flags, strain=_worst(m.velocity_variance, m.pos_horiz_variance))


def _estimator(m: Any) -> p.Body:
    return p.EkfStatus(m.flags, p.ESTIMATOR_NEEDED, p.ESTIMATOR_BAD, _worst(m.vel_ratio, m.pos_horiz_ratio))


def _worst(*ratios: float) -> float:
    """Return the greatest test ratio; one that is no number is of a filter that has failed."""
    return max(ratios) if _finite(*ratios) else math.inf


def _satellites(m: Any) -> p.Body:
    return p.SatelliteFix(m.time_usec, m.fix_type)


def _origin(m: Any) -> p.Body:
    return p.Origin(m.latitude / 1e7, m.longitude / 1e7, m.altitude / 1e3)


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
        motors_off=_motors_off(m.onboard_control_sensors_present, m.onboard_control_sensors_enabled),
    )


def _motors_off(present: int, enabled: int) -> bool | None:
    return not enabled & p.SENSOR_MOTOR_OUTPUTS if present & p.SENSOR_MOTOR_OUTPUTS else None


def _share(percent: int) -> float | None:
    return percent / 100 if 0 <= percent <= 100 else None


def _text(m: Any) -> p.Body:
    return p.StatusText(m.severity, m.text, m.id, m.chunk_seq)


def _ack(m: Any) -> p.Body:
    return p.Ack(m.command, m.result, m.target_system, m.target_component)


def _parameter(m: Any) -> p.Body:
    # Straight from the frame: a float that is no number may change its bits on the way through Python.
    frame = bytes(m.get_msgbuf())
    value = frame[HEADER_BYTES[frame[0]] :][:4] if frame else struct.pack("<f", m.param_value)
    return p.Parameter(m.param_id, m.param_value, m.param_type, int.from_bytes(value, "little", signed=True))


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
    "ESTIMATOR_STATUS": _estimator,
    "GPS_RAW_INT": _satellites,
    "GPS_GLOBAL_ORIGIN": _origin,
    "BATTERY_STATUS": _battery,
    "SYS_STATUS": _sys_status,
    "STATUSTEXT": _text,
    "COMMAND_ACK": _ack,
    "PARAM_VALUE": _parameter,
    "AUTOPILOT_VERSION": _version,
}


def decoded_ids() -> frozenset[int]:
    """Return the ids of the messages that :func:`decode` understands; all others need not be unpacked."""
    return frozenset(number for number, kind in dialect().mavlink_map.items() if kind.msgname in _DECODERS)


# ---------------------------------------------------------------- encoding
@dataclass(frozen=True, slots=True)
class FrameSigner:
    """What it takes to sign frames."""

    key: bytes
    link_id: int
    timestamp: Callable[[], int]  # a new one for each frame


class Encoder:
    """Makes the frames of one sender, sequence numbers included, signed if there is a signer."""

    def __init__(self, system: int, component: int, signer: FrameSigner | None = None) -> None:
        self._mav = dialect().MAVLink(None, srcSystem=system, srcComponent=component)
        self._signer = signer
        if signer is not None:
            signing = self._mav.signing
            signing.secret_key, signing.link_id, signing.sign_outgoing = signer.key, signer.link_id, True

    def pack(self, message: Any) -> bytes:
        """Return a dialect's message as a MAVLink 2 frame."""
        if self._signer is not None:
            self._mav.signing.timestamp = self._signer.timestamp()
        frame: bytes = message.pack(self._mav)
        self._mav.seq = (self._mav.seq + 1) % 256
        return frame


class StationEncoder(Encoder):
    """Frames of the controlling station for one vehicle."""

    def __init__(self, system: int, component: int, vehicle: int, signer: FrameSigner | None = None) -> None:
        super().__init__(system, component, signer)
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

    def set_mode(self, mode: int, sub_mode: int = 0, *, confirmation: int = 0) -> bytes:
        """Ask for a mode; confirmed by a later heartbeat's ``custom_mode`` only."""
        return self.command(p.COMMAND_SET_MODE, p.BASE_MODE_CUSTOM, mode, sub_mode, confirmation=confirmation)

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

    def set_parameter(self, name: str, value: float, kind: int = p.PARAM_REAL32, *, bytewise: bool = False) -> bytes:
        """Set a parameter. The firmware checks no range.

        ArduPilot: any type travels as a plain float. PX4 (`bytewise`): an integer's four bytes stand in the float.
        """
        if not _finite(value):
            raise ValueError(f"{name} cannot be set to {value}")
        if bytewise and kind != p.PARAM_REAL32:
            value = struct.unpack("<f", struct.pack("<i", int(value)))[0]
        return self.pack(dialect().MAVLink_param_set_message(self._vehicle, 1, name.encode("ascii"), value, kind))

    def drive(self, speed_m_s: float, turn_rad_s: float) -> bytes:
        """Return ArduRover's set-point for a body velocity (x forward, counter-clockwise positive); zero stands.

        Raises
        ------
        ValueError
            Not finite, or beyond a 32-bit float: NaN in a used field makes the firmware abort or run away.
        """
        spin = speed_m_s == 0.0 and turn_rad_s != 0.0
        yaw_rate = p.flu_from_frd(0.0, 0.0, turn_rad_s)[2]
        return self._target(p.MASK_TURN_ONLY if spin else p.MASK_SPEED_AND_TURN, speed_m_s, 0.0, yaw_rate)

    def velocity(self, forward_m_s: float, left_m_s: float) -> bytes:
        """Return the set-point for a velocity in the body's frame and nothing else, as PX4 wants it.

        Raises
        ------
        ValueError
            Not finite, or beyond a 32-bit float.
        """
        return self._target(p.MASK_VELOCITY, *p.flu_from_frd(forward_m_s, left_m_s, 0.0)[:2], 0.0)

    def _target(self, mask: int, vx: float, vy: float, yaw_rate: float) -> bytes:
        if not _finite(vx, vy, yaw_rate) or max(abs(vx), abs(vy), abs(yaw_rate)) > 1e6:
            raise ValueError(f"a set-point must be finite, not {vx}, {vy} m/s, {yaw_rate} rad/s")
        return self.pack(
            dialect().MAVLink_set_position_target_local_ned_message(
                0, self._vehicle, 1, p.FRAME_BODY_NED, mask,
                0.0, 0.0, 0.0, vx, vy, 0.0, 0.0, 0.0, 0.0, 0.0, yaw_rate,
            )
        )  # fmt: skip

    def stand(self) -> bytes:
        """Return ArduRover's zero set-point."""
        return self.drive(0.0, 0.0)

    def set_origin(self, origin: p.Origin) -> bytes:
        """Say where on earth the local frame begins; obeyed once, confirmed by GPS_GLOBAL_ORIGIN."""
        return self.pack(
            dialect().MAVLink_set_gps_global_origin_message(
                self._vehicle, round(origin.latitude_deg * 1e7), round(origin.longitude_deg * 1e7),
                round(origin.altitude_m * 1e3),
            )
        )  # fmt: skip

    def odometry(self, fix: p.Fix, *, velocity: float) -> bytes:
        """Return an external pose: frame 20 (local FRD, x to the north), child frame 12 (body FRD).

        `velocity` stands for each component of the velocity, which was not measured: NaN or 0, whatever the
        autopilot bears.

        Raises
        ------
        ValueError
            The pose or its covariance is not finite.
        """
        north, east, _ = p.enu_from_ned(fix.x_m, fix.y_m, 0.0)
        half = p.heading_from_yaw(fix.heading_rad) / 2.0
        if not _finite(north, east, half, fix.position_var_m2, fix.heading_var_rad2):
            raise ValueError(f"a pose must be finite, not {fix}")
        return self.pack(
            dialect().MAVLink_odometry_message(
                fix.stamp_us, p.FRAME_LOCAL_FRD, p.FRAME_BODY_FRD, north, east, 0.0,
                [math.cos(half), 0.0, 0.0, math.sin(half)], velocity, velocity, velocity, 0.0, 0.0, 0.0,
                _diagonal(fix.position_var_m2, fix.heading_var_rad2), [math.nan, *[0.0] * 20],
                fix.resets % 256, p.ESTIMATOR_MOCAP, 100,
            )
        )  # fmt: skip


def _diagonal(position: float, heading: float) -> list[float]:
    """Return the upper triangle, row by row, of a 6 x 6 covariance: x, y, z, roll, pitch, yaw."""
    triangle = [0.0] * 21
    for index, variance in zip((0, 6, 11, 15, 18, 20), (position,) * 3 + (heading,) * 3, strict=True):
        triangle[index] = variance
    return triangle
