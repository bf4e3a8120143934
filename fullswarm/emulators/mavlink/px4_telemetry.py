"""The messages of the emulated PX4 rover, NED on the wire, and how often it sends them unasked."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import dialect
from fullswarm.emulators.mavlink.rover.chart import Chart
from fullswarm.simulation.bodies import BodyState


class Subject(Protocol):
    """What the messages tell of."""

    mode: int
    armed: bool
    failsafe: bool
    battery: float
    origin: tuple[int, int, int] | None
    chart: Chart

    def state(self) -> BodyState:
        """Return where the body is."""
        ...

    def booted(self, now_s: float) -> bool:
        """Whether it has finished starting."""
        ...

    def positioned(self, now_s: float) -> bool:
        """Whether the position filter has a position."""
        ...

    def fix(self, now_s: float) -> tuple[int, int]:
        """Return the type of the satellite fix, and when the last one was: milliseconds since power-on."""
        ...

    def boot_ms(self, now_s: float) -> int:
        """Return milliseconds since power-on."""
        ...


INTERVALS_S = {
    p.MESSAGE_HEARTBEAT: 1.0,
    p.MESSAGE_SYS_STATUS: 1.0,
    p.MESSAGE_ATTITUDE: 0.05,
    p.MESSAGE_LOCAL_POSITION: 0.1,
    p.MESSAGE_BATTERY: 2.0,
    p.MESSAGE_ESTIMATOR: 1.0,
    p.MESSAGE_GPS: 1.0,
}


def _heartbeat(subject: Subject, now_s: float) -> Any:
    base = p.BASE_MODE_CUSTOM | (p.BASE_MODE_ARMED if subject.armed else 0)
    status = p.STATUS_CRITICAL if subject.failsafe else p.STATUS_ACTIVE if subject.armed else 3
    if not subject.booted(now_s):
        status = 1
    return dialect().MAVLink_heartbeat_message(10, p.AUTOPILOT_PX4, base, subject.mode, status, 3)


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
        subject.boot_ms(now_s), *subject.chart.local(state.x_m, state.y_m), 0.0, north_m_s, east_m_s, 0.0
    )


def _estimator(subject: Subject, now_s: float) -> Any:
    flags = 831 if subject.positioned(now_s) else 1 | 4 | 32 | 128
    return dialect().MAVLink_estimator_status_message(
        subject.boot_ms(now_s) * 1000, flags, 0.1, 0.1, 0.1, 0.1, 0.0, 0.0, 0.5, 0.5
    )


def _satellites(subject: Subject, now_s: float) -> Any:
    fix, stamp_ms = subject.fix(now_s)
    return dialect().MAVLink_gps_raw_int_message(1000 * stamp_ms, fix, 0, 0, 0, 121, 200, 0, 0, 10 if fix > 1 else 0)


def _battery(subject: Subject, _: float) -> Any:
    cells = [12600] + [65535] * 9
    return dialect().MAVLink_battery_status_message(0, 0, 0, 32767, cells, 250, 0, 0, round(subject.battery * 100))


def _status(subject: Subject, _: float) -> Any:
    percent = round(subject.battery * 100)
    return dialect().MAVLink_sys_status_message(0, 0, 0, 100, 12600, 250, percent, 0, 0, 0, 0, 0, 0)


def _version(_: Subject, __: float) -> Any:
    zeros = [0] * 8
    return dialect().MAVLink_autopilot_version_message(0xE4EF, 0x011000FF, 0, 0, 0, zeros, zeros, zeros, 0, 0, 0)


def _origin(subject: Subject, _: float) -> Any:
    return None if subject.origin is None else dialect().MAVLink_gps_global_origin_message(*subject.origin)


MAKERS: dict[int, Callable[[Subject, float], Any]] = {
    p.MESSAGE_HEARTBEAT: _heartbeat,
    p.MESSAGE_SYS_STATUS: _status,
    p.MESSAGE_ATTITUDE: _attitude,
    p.MESSAGE_LOCAL_POSITION: _position,
    p.MESSAGE_BATTERY: _battery,
    p.MESSAGE_ESTIMATOR: _estimator,
    p.MESSAGE_GPS: _satellites,
    p.MESSAGE_VERSION: _version,
    p.MESSAGE_ORIGIN: _origin,
}
