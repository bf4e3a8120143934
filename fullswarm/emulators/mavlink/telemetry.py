"""What ArduRover sends: a maker for each message, which is due when, and the ports that sign and pack them.

NED and FRD on the wire. pymavlink's own signing does the work: the driver's is our own code, so that each is tested
against another's.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

from fullswarm.clock import wall_time_s
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import dialect
from fullswarm.emulators.mavlink.driving import CENTRE_US, FULL_M_S, SPAN_US, Sticks
from fullswarm.emulators.mavlink.position import ALTITUDE_M, FAILSAFE_S, Chart
from fullswarm.simulation.bodies import BodyState

GRAVITY_MG, GRAVITY_M_S2 = 1000, 9.80665
TRACK_M = 0.3  # between the wheels, for the servo outputs alone
FULL_V, EMPTY_V, CURRENT_CA = 12.6, 10.5, 250
SENSORS = 0x5161FC2F  # present, as in the firmware's simulator
MOTOR_OUTPUTS = 0x8000
MANUAL_MODES = frozenset({p.Mode.MANUAL, p.Mode.ACRO, p.Mode.STEERING, p.Mode.SIMPLE, p.Mode.INITIALISING})
AUTOPILOT_MODES = frozenset(
    {p.Mode.AUTO, p.Mode.GUIDED, p.Mode.RTL, p.Mode.SMART_RTL, p.Mode.LOITER, p.Mode.CIRCLE, p.Mode.DOCK}
)
BLIND, LOCATED = 1 | 4 | 32 | 128, 831
CALM = 0.007  # test ratios of velocity and position, as recorded
DEFAULT_S = 1.0
LONGEST_MS = 65_535
LOOP_HZ = 50.0
CAP = 0.8  # of the main loop's rate
LEGACY = {  # REQUEST_DATA_STREAM's groups: (messages, parameter)
    1: ((27, 116, 129, 29, 137), "RAW_SENS"), 2: ((1, 125, 152, 42, 24, 62), "EXT_STAT"), 3: ((36, 65), "RC_CHAN"),
    6: ((33, 32), "POSITION"), 10: ((30, 164, 178), "EXTRA1"), 11: ((74,), "EXTRA2"),
    12: ((163, 2, 147, 193, 241), "EXTRA3"),
}  # fmt: skip
TICKS_S = 100_000  # of a signature's timestamp: 10 µs
SIGNED = 0x01
TRUSTED = 0  # the first port (USB) accepts unsigned frames too


class Subject(Protocol):
    """What the messages report."""

    mode: int
    armed: bool
    failsafe: bool
    charge: float
    safety: bool
    sticks: Sticks
    chart: Chart

    @property
    def map_origin(self) -> tuple[float, float]:
        """Latitude and longitude of where its map begins, or would begin."""
        ...

    def fix(self, now_s: float) -> tuple[int, int]:
        """Return the type of the satellite fix, and when the last one was: milliseconds since power-on."""
        ...

    def unaided_s(self, now_s: float) -> float:
        """Return for how long nothing has measured the position."""
        ...

    def state(self) -> BodyState:
        """Return the state that the filter estimates."""
        ...

    def truth(self) -> BodyState:
        """Return where the body is."""
        ...

    def positioned(self, now_s: float) -> bool:
        """Whether the position filter has a position."""
        ...

    def boot_ms(self, now_s: float) -> int:
        """Return milliseconds since power-on."""
        ...


Maker = Callable[[Subject, float], Any]


def _heartbeat(subject: Subject, _: float) -> Any:
    base = p.BASE_MODE_CUSTOM | (64 if subject.mode in MANUAL_MODES else 0)
    base |= (8 if subject.mode in AUTOPILOT_MODES else 0) | (p.BASE_MODE_ARMED if subject.armed else 0)
    calm = 2 if subject.mode == p.Mode.INITIALISING else p.STATUS_ACTIVE
    status = p.STATUS_CRITICAL if subject.failsafe else calm
    return dialect().MAVLink_heartbeat_message(10, p.AUTOPILOT_ARDUPILOT, base, subject.mode, status, 3)


def _sys_status(subject: Subject, _: float) -> Any:
    enabled = SENSORS & ~(MOTOR_OUTPUTS if subject.safety else 0)
    volts, share = _pack(subject)
    return dialect().MAVLink_sys_status_message(
        SENSORS, enabled, SENSORS, 100, volts, CURRENT_CA, share, 0, 0, 0, 0, 0, 0
    )


def _pack(subject: Subject) -> tuple[int, int]:
    """Return the pack's voltage in mV and its charge in percent."""
    return round(1000 * (EMPTY_V + (FULL_V - EMPTY_V) * subject.charge)), round(100 * subject.charge)


def _battery(subject: Subject, _: float) -> Any:
    volts, share = _pack(subject)
    cells = [volts] + [65535] * 9  # cells unknown: the whole pack stands in the first
    return dialect().MAVLink_battery_status_message(0, 0, 0, 32767, cells, CURRENT_CA, 0, 0, share)


def _velocity(state: BodyState) -> tuple[float, float]:
    """Return the velocity north and east."""
    return state.speed_m_s * math.sin(state.heading_rad), state.speed_m_s * math.cos(state.heading_rad)


def _yaw(state: BodyState) -> float:
    return p.heading_from_yaw(state.heading_rad)


def _bearing_deg(state: BodyState) -> float:
    return math.degrees(_yaw(state)) % 360.0


def _degrees(subject: Subject, state: BodyState) -> tuple[int, int]:
    latitude, longitude = subject.chart.degrees(state.x_m, state.y_m)
    return round(latitude * 1e7), round(longitude * 1e7)


def _attitude(subject: Subject, now_s: float) -> Any:
    state = subject.state()
    return dialect().MAVLink_attitude_message(subject.boot_ms(now_s), 0, 0, _yaw(state), 0, 0, -state.turn_rad_s)


def _attitude_quaternion(subject: Subject, now_s: float) -> Any:
    state = subject.state()
    half = _yaw(state) / 2.0
    return dialect().MAVLink_attitude_quaternion_message(
        subject.boot_ms(now_s), math.cos(half), 0, 0, math.sin(half), 0, 0, -state.turn_rad_s
    )


def _local_position(subject: Subject, now_s: float) -> Any:
    if not subject.positioned(now_s):
        return None
    state = subject.state()
    return dialect().MAVLink_local_position_ned_message(
        subject.boot_ms(now_s), *subject.chart.local(state.x_m, state.y_m), 0.0, *_velocity(state), 0.0
    )


def _global_position(subject: Subject, now_s: float) -> Any:
    state = subject.state()
    north, east = _velocity(state)
    height_mm, bearing = round(ALTITUDE_M * 1000), round(100 * _bearing_deg(state)) % 36000
    return dialect().MAVLink_global_position_int_message(
        subject.boot_ms(now_s),
        *_degrees(subject, state),
        height_mm,
        0,
        round(100 * north),
        round(100 * east),
        0,
        bearing,
    )


def _vfr_hud(subject: Subject, _: float) -> Any:
    state = subject.state()
    speed, throttle = abs(state.speed_m_s), round(100 * min(abs(state.speed_m_s) / FULL_M_S, 1.0))
    return dialect().MAVLink_vfr_hud_message(speed, speed, round(_bearing_deg(state)) % 360, throttle, ALTITUDE_M, 0.0)


def _servos(subject: Subject, now_s: float) -> Any:
    state = subject.truth()
    powered = subject.armed and not subject.safety
    left, right = (
        round(CENTRE_US + SPAN_US * max(-1.0, min(1.0, (state.speed_m_s + side * state.turn_rad_s) / FULL_M_S)))
        if powered else round(CENTRE_US)
        for side in (-TRACK_M / 2, TRACK_M / 2)
    )  # fmt: skip
    return dialect().MAVLink_servo_output_raw_message(
        1000 * subject.boot_ms(now_s) & 0xFFFFFFFF, 0, left, 0, right, 0, 0, 0, 0, 0
    )


def _rc(subject: Subject, now_s: float) -> Any:
    sticks = subject.sticks
    channels = [round(sticks.steering_us), 1500, round(sticks.throttle_us), *[1500] * 5, *[0] * 10]
    return dialect().MAVLink_rc_channels_message(subject.boot_ms(now_s), 16, *channels, 255)


def _rc_scaled(subject: Subject, now_s: float) -> Any:
    sticks = subject.sticks
    steering, throttle = round(1e4 * sticks.steering), round(1e4 * sticks.throttle)
    return dialect().MAVLink_rc_channels_scaled_message(
        subject.boot_ms(now_s), 0, steering, 0, throttle, 0, 0, 0, 0, 0, 255
    )


def _gyro_mrad_s(subject: Subject) -> int:
    return round(-1000 * subject.state().turn_rad_s)


def _raw_imu(subject: Subject, now_s: float) -> Any:
    stamp, turn = 1000 * subject.boot_ms(now_s), _gyro_mrad_s(subject)
    return dialect().MAVLink_raw_imu_message(stamp, 0, 0, -GRAVITY_MG, 0, 0, turn, 230, 60, -530, 0, 4500)


def _scaled_imu2(subject: Subject, now_s: float) -> Any:
    turn = _gyro_mrad_s(subject)
    return dialect().MAVLink_scaled_imu2_message(
        subject.boot_ms(now_s), 0, 0, -GRAVITY_MG, 0, 0, turn, 230, 60, -530, 4500
    )


def _scaled_imu3(subject: Subject, now_s: float) -> Any:
    turn = _gyro_mrad_s(subject)
    return dialect().MAVLink_scaled_imu3_message(
        subject.boot_ms(now_s), 0, 0, -GRAVITY_MG, 0, 0, turn, 230, 60, -530, 4500
    )


def _highres_imu(subject: Subject, now_s: float) -> Any:
    turn = -subject.state().turn_rad_s
    return dialect().MAVLink_highres_imu_message(
        1000 * subject.boot_ms(now_s),
        0,
        0,
        -GRAVITY_M_S2,
        0,
        0,
        turn,
        0.23,
        0.06,
        -0.53,
        945.0,
        0,
        ALTITUDE_M,
        45.0,
        63,
    )


def _gps(subject: Subject, now_s: float) -> Any:
    state, (fix, stamp_ms) = subject.state(), subject.fix(now_s)
    course = round(100 * _bearing_deg(state)) % 36000
    speed = round(100 * abs(state.speed_m_s))
    place = (*_degrees(subject, state), round(ALTITUDE_M * 1000)) if fix > 1 else (0, 0, 0)
    return dialect().MAVLink_gps_raw_int_message(
        1000 * stamp_ms, fix, *place, 121, 200, speed, course, 10 if fix > 1 else 0
    )


def _ekf(subject: Subject, now_s: float) -> Any:
    """Return the filter's state: its test ratios rise while nothing aids it, and its flags stay good for 7 s."""
    flags, variance = BLIND, 1.0
    if subject.positioned(now_s):
        flags, variance = LOCATED, max(CALM, min(1.0, (subject.unaided_s(now_s) / FAILSAFE_S) ** 2))
    return dialect().MAVLink_ekf_status_report_message(flags, variance, variance, 0.02, 0.006, 0.0, 0.0)


def _simstate(subject: Subject, _: float) -> Any:
    state = subject.truth()
    return dialect().MAVLink_simstate_message(
        0, 0, _yaw(state), 0, 0, -GRAVITY_M_S2, 0, 0, -state.turn_rad_s, *_degrees(subject, state)
    )


def _sim_state(subject: Subject, _: float) -> Any:
    state = subject.truth()
    (latitude, longitude), (north, east), half = _degrees(subject, state), _velocity(state), _yaw(state) / 2
    return dialect().MAVLink_sim_state_message(
        math.cos(half), 0, 0, math.sin(half), 0, 0, _yaw(state), 0, 0, -GRAVITY_M_S2, 0, 0, -state.turn_rad_s,
        latitude, longitude, ALTITUDE_M, 0, 0, north, east, 0, latitude, longitude,  # sic: degrees times 1e7, twice
    )  # fmt: skip


def _home(subject: Subject, now_s: float) -> Any:
    latitude, longitude = (round(each * 1e7) for each in subject.map_origin)
    return dialect().MAVLink_home_position_message(
        latitude, longitude, round(ALTITUDE_M * 1000), 0, 0, 0, [1, 0, 0, 0], 0, 0, 0, round(now_s * 1e6)
    )


def _origin(subject: Subject, now_s: float) -> Any:
    if subject.chart.origin is None and not subject.positioned(now_s):
        return None
    latitude, longitude = (round(each * 1e7) for each in subject.map_origin)
    return dialect().MAVLink_gps_global_origin_message(latitude, longitude, round(ALTITUDE_M * 1000))


def _navigation(subject: Subject, _: float) -> Any:
    if subject.mode != p.Mode.GUIDED:
        return None
    bearing = round(math.degrees(_yaw(subject.state())))
    return dialect().MAVLink_nav_controller_output_message(0, 0, bearing, bearing, 0, 0, 0, 0)


def _version(_: Subject, __: float) -> Any:
    custom = [*b"3fc7011a"]
    return dialect().MAVLink_autopilot_version_message(
        0xF1EF & ~32, 0x040603FF, 0, 0, 0, custom, [0] * 8, [0] * 8, 0, 0, 0
    )  # without 32: MAVProxy would try FILE_TRANSFER_PROTOCOL, which is not emulated


def _time(subject: Subject, now_s: float) -> Any:
    return dialect().MAVLink_system_time_message(round(wall_time_s() * 1e6), subject.boot_ms(now_s))


def _nothing(_: Subject, __: float) -> Any:
    return None


# Sent once a second on each port.
BY_DEFAULT: dict[int, Maker] = {
    0: _heartbeat, 1: _sys_status, 2: _time, 24: _gps, 27: _raw_imu, 30: _attitude, 32: _local_position,
    33: _global_position, 34: _rc_scaled, 36: _servos, 62: _navigation, 65: _rc, 74: _vfr_hud, 116: _scaled_imu2,
    129: _scaled_imu3, 147: _battery, 164: _simstate, 193: _ekf,
    29: lambda subject, now_s: dialect().MAVLink_scaled_pressure_message(subject.boot_ms(now_s), 945.0, 0, 3500, 0),
    42: lambda _, __: dialect().MAVLink_mission_current_message(0, 0, 1, 0),
    125: lambda _, __: dialect().MAVLink_power_status_message(5000, 0, 0),
    137: lambda subject, now_s: dialect().MAVLink_scaled_pressure2_message(subject.boot_ms(now_s), 945.0, 0, 3500, 0),
    152: lambda _, __: dialect().MAVLink_meminfo_message(0, 65535, 131072),
    163: lambda _, __: dialect().MAVLink_ahrs_message(0, 0, 0, 0, 0, 0.001, 0.001),
    178: lambda subject, _: dialect().MAVLink_ahrs2_message(
        0, 0, _yaw(subject.state()), ALTITUDE_M, *_degrees(subject, subject.state())),
    241: lambda subject, now_s: dialect().MAVLink_vibration_message(1000 * subject.boot_ms(now_s), 0, 0, 0, 0, 0, 0),
}  # fmt: skip
# Sent on request; the firmware grants the last five and never sends them.
ASKED_FOR: dict[int, Maker] = {
    31: _attitude_quaternion, 49: _origin, 105: _highres_imu, 108: _sim_state, 242: _home,
    245: lambda _, __: dialect().MAVLink_extended_sys_state_message(0, 1),
    85: _nothing, 132: _nothing, 162: _nothing, 168: _nothing, 194: _nothing,
}  # fmt: skip
ONCE: dict[int, Maker] = {148: _version}
MAKERS: dict[int, Maker] = {**BY_DEFAULT, **ASKED_FOR, **ONCE}


# ---------------------------------------------------------------- which message is due when
@dataclass(slots=True)
class _Stream:
    interval_s: float
    due_s: float


class Streams:
    """The streams of one port; intervals are forgotten at power-on, not at a reconnect."""

    def __init__(self, subject: Subject, first_s: float, loop_hz: float = LOOP_HZ) -> None:
        self._subject, self._loop_hz = subject, loop_hz
        self._streams = {message: _Stream(DEFAULT_S, first_s) for message in BY_DEFAULT}
        self._streams |= {message: _Stream(math.inf, math.inf) for message in ASKED_FOR}

    def set_interval(self, message: int, interval_us: float, now_s: float) -> str:
        """Set a rate; return why it is denied, empty when it is granted."""
        if message not in self._streams:
            return f"No ap_message for mavlink id ({message})"
        if interval_us < -1:
            return "bad interval"
        if 0 < interval_us < 1e6 / (CAP * self._loop_hz):
            return f"Requested rate for message ID {message} too fast. Increase SCHED_LOOP_RATE"
        usual_s = DEFAULT_S if message in BY_DEFAULT else math.inf
        interval_s = {-1: math.inf, 0: usual_s}.get(int(interval_us), min(int(interval_us / 1000), LONGEST_MS) / 1000)
        self._streams[message] = _Stream(interval_s, now_s + interval_s)
        return ""

    def interval_us(self, message: int) -> int | None:
        """Return what MESSAGE_INTERVAL says: -1 off; None: no such stream."""
        stream = self._streams.get(message)
        if stream is None:
            return None
        return round(stream.interval_s * 1e6) if math.isfinite(stream.interval_s) else -1

    def set_group(self, group: int, rate_hz: float, now_s: float) -> list[str]:
        """Apply REQUEST_DATA_STREAM; return the parameters (without their port) that it writes."""
        groups = [LEGACY[group]] if group in LEGACY else list(LEGACY.values()) if group == 0 else []
        for messages, _ in groups:
            for message in messages:
                self.set_interval(message, 1e6 / min(rate_hz, CAP * self._loop_hz) if rate_hz > 0 else -1, now_s)
        return [name for _, name in groups]

    def heartbeat_now(self) -> None:
        """Send a mode change at once; arming is not."""
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
        """Return the message `number` as it is now; empty if it is unknown or there is none now."""
        maker = MAKERS.get(number)
        message = maker(self._subject, now_s) if maker else None
        return [] if message is None else [message]


# ---------------------------------------------------------------- one port
class KeyRing:
    """The signing key, which all ports and restarts share."""

    def __init__(self) -> None:
        self._verifier = dialect().MAVLink(None)
        self._moved_s = 0.0

    @property
    def key(self) -> bytes | None:
        """The key; None: signing is off."""
        key: bytes | None = self._verifier.signing.secret_key
        return key

    def set_up(self, key: bytes, timestamp: int, now_s: float) -> None:
        """Take SETUP_SIGNING: a zero key with timestamp 0 ends signing."""
        self._verifier = dialect().MAVLink(None)
        self._verifier.signing.secret_key = key if any(key) or timestamp else None
        self._verifier.signing.timestamp, self._moved_s = timestamp, now_s

    def next_timestamp(self, now_s: float) -> int:
        """Return the timestamp of an outgoing frame; it follows the clock, and jumps ahead with received frames."""
        signing = self._verifier.signing
        passed_s, self._moved_s = max(0.0, now_s - self._moved_s), now_s
        signing.timestamp += 1 + int(passed_s * TICKS_S)
        return int(signing.timestamp)

    def accepts(self, message: Any, now_s: float) -> bool:
        """Whether a frame bears a right signature that is not older than those received."""
        frame = message.get_msgbuf()
        if frame[0] != 0xFD or not frame[2] & SIGNED:
            return False
        self.next_timestamp(now_s)
        return bool(self._verifier.check_signature(frame, message.get_srcSystem(), message.get_srcComponent()))


class Channel:
    """One port. `number` is its MAVLink channel, and its link id in signatures."""

    def __init__(self, number: int, system: int, keys: KeyRing) -> None:
        self.number = number
        self.streams: Streams | None = None  # none before power-on
        self._keys = keys
        self._mav = dialect().MAVLink(None, srcSystem=system, srcComponent=1)
        self._mav.signing.link_id = number
        self._out: list[bytes] = []

    def send(self, message: Any, now_s: float) -> None:
        """Pack a message of the dialect, signed if there is a key."""
        signing = self._mav.signing
        signing.secret_key = self._keys.key
        signing.sign_outgoing = signing.secret_key is not None
        if signing.sign_outgoing:
            signing.timestamp = self._keys.next_timestamp(now_s)
        self._out.append(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) % 256

    def print(self, text: bytes) -> None:
        """Put console text between the frames."""
        self._out.append(text)

    def accepts(self, message: Any, now_s: float) -> bool:
        """Whether what arrived here is acted upon."""
        if self._keys.key is None:
            return True
        return self._keys.accepts(message, now_s) or self.number == TRUSTED

    def take(self) -> list[bytes]:
        """Return what goes out, and forget it."""
        out, self._out = self._out, []
        return out

    def clear(self) -> None:
        """Drop what would have gone out."""
        self._out.clear()
