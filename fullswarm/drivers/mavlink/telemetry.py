"""The emulated rover's streams: what it sends, how often, and the rate cap. NED on the wire."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.body import BodyState
from fullswarm.drivers.mavlink.codec import dialect

DEFAULT_S = 1.0
LOOP_HZ = 50.0


class Subject(Protocol):
    """What the streams tell of."""

    mode: int
    armed: bool
    failsafe: bool

    def state(self) -> BodyState:
        """Return where the body is."""
        ...

    def positioned(self, now_s: float) -> bool:
        """Whether the position filter has a position."""
        ...

    def boot_ms(self, now_s: float) -> int:
        """Return milliseconds since power-on."""
        ...


@dataclass(slots=True)
class _Stream:
    interval_s: float
    due_s: float


class Streams:
    """Which message is due when. Everything starts at 1 Hz; intervals are forgotten at power-on."""

    def __init__(self, subject: Subject, first_s: float, loop_hz: float = LOOP_HZ) -> None:
        self._subject, self._loop_hz = subject, loop_hz
        self._streams = {message: _Stream(DEFAULT_S, first_s) for message in _MAKERS}

    def set_interval(self, message: int, interval_us: float, now_s: float) -> str:
        """Set a rate; return why it is denied, empty when it is granted."""
        if message not in _MAKERS:
            return f"No ap_message for mavlink id ({message})"
        if interval_us < -1:
            return "bad interval"
        if 0 < interval_us < 1e6 / (0.8 * self._loop_hz):
            return f"Requested rate for message ID {message} too fast. Increase SCHED_LOOP_RATE"
        whole_ms_s = int(interval_us / 1000) / 1000
        interval_s = {-1: math.inf, 0: DEFAULT_S}.get(int(interval_us), whole_ms_s)
        self._streams[message] = _Stream(interval_s, now_s + interval_s)
        return ""

    def heartbeat_now(self) -> None:
        """A mode change is told at once; arming is not."""
        self._streams[p.MESSAGE_HEARTBEAT].due_s = -math.inf

    def due(self, now_s: float) -> list[Any]:
        """Return the dialect's messages that are due."""
        messages = []
        for number, stream in self._streams.items():
            if now_s >= stream.due_s:
                late = now_s - stream.due_s > stream.interval_s
                stream.due_s = (now_s if late else stream.due_s) + stream.interval_s
                messages += self.make(number, now_s)
        return messages

    def make(self, number: int, now_s: float) -> list[Any]:
        """Return the message `number` as it is now; empty if it is unknown or there is nothing to tell."""
        maker = _MAKERS.get(number) or _ON_REQUEST.get(number)
        message = maker(self._subject, now_s) if maker else None
        return [] if message is None else [message]


def _heartbeat(subject: Subject, _: float) -> Any:
    starting = subject.mode == p.Mode.INITIALISING
    base = p.BASE_MODE_CUSTOM | (64 if starting or subject.mode == p.Mode.MANUAL else 0)
    base |= (8 if subject.mode == p.Mode.GUIDED else 0) | (p.BASE_MODE_ARMED if subject.armed else 0)
    status = 2 if starting else p.STATUS_CRITICAL if subject.failsafe else p.STATUS_ACTIVE
    return dialect().MAVLink_heartbeat_message(10, p.AUTOPILOT_ARDUPILOT, base, subject.mode, status, 3)


def _attitude(subject: Subject, now_s: float) -> Any:
    state = subject.state()
    yaw = p.heading_from_yaw(state.heading_rad)
    return dialect().MAVLink_attitude_message(subject.boot_ms(now_s), 0, 0, yaw, 0, 0, -state.turn_rad_s)


def _position(subject: Subject, now_s: float) -> Any:
    if not subject.positioned(now_s):
        return None
    state = subject.state()
    north_m_s = state.speed_m_s * math.sin(state.heading_rad)
    east_m_s = state.speed_m_s * math.cos(state.heading_rad)
    return dialect().MAVLink_local_position_ned_message(
        subject.boot_ms(now_s), state.y_m, state.x_m, 0.0, north_m_s, east_m_s, 0.0
    )


def _ekf(subject: Subject, now_s: float) -> Any:
    flags = 831 if subject.positioned(now_s) else 1 | 4 | 32 | 128
    return dialect().MAVLink_ekf_status_report_message(flags, 0.1, 0.1, 0.1, 0.1, 0.0, 0.0)


def _battery(_: Subject, __: float) -> Any:
    cells = [12600] + [65535] * 9  # cells unknown: the whole pack stands in the first
    return dialect().MAVLink_battery_status_message(0, 0, 0, 32767, cells, 250, 0, 0, 87)


def _status(_: Subject, __: float) -> Any:
    return dialect().MAVLink_sys_status_message(0, 0, 0, 100, 12600, 250, 87, 0, 0, 0, 0, 0, 0)


def _version(_: Subject, __: float) -> Any:
    zeros = [0] * 8
    return dialect().MAVLink_autopilot_version_message(0xF1EF, 0x040603FF, 0, 0, 0, zeros, zeros, zeros, 0, 0, 0)


_MAKERS = {
    p.MESSAGE_HEARTBEAT: _heartbeat,
    p.MESSAGE_SYS_STATUS: _status,
    p.MESSAGE_ATTITUDE: _attitude,
    p.MESSAGE_LOCAL_POSITION: _position,
    p.MESSAGE_BATTERY: _battery,
    p.MESSAGE_EKF: _ekf,
}
_ON_REQUEST = {p.MESSAGE_VERSION: _version}
