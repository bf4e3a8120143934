"""PX4 on a differential rover as its wire shows it. No I/O, no clock of its own.

From PX4's sources and guides, not measured: see ``px4.py`` for what it makes of set-points. Faithful where drivers
get hurt: no OFFBOARD without set-points, out of it 1.0 s after the last one, a heartbeat of 1 Hz whatever is
requested, integers bytewise in parameters, a zero velocity that turns it to the north.

Left out: missions, positions as set-points, radio input, magnetic interference.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink import px4
from fullswarm.drivers.mavlink.codec import Encoder, FrameSigner, dialect
from fullswarm.drivers.mavlink.maps import SphereMap
from fullswarm.emulators.mavlink.position import ALTITUDE_M, Chart, FilterNoise
from fullswarm.geometry import clamp, wrap
from fullswarm.simulation.bodies import Body, BodyState

STEP_S = 0.01
RECORDS = 20_000
ACCEL_M_S2, DECEL_M_S2, TURN_ACCEL_RAD_S2 = 1.5, 2.0, 4.0
COAST_S = 0.3
SIGNAL_S = 0.5
"""Set-points count as a stream when none is further from the next than this."""
FIX_S = 0.3
NOAID_S = 5.0
"""EKF2_NOAID_TOUT: dead reckoning counts as a position for so long."""
SATELLITES_S = 0.2
INT32, REAL32 = p.PARAM_INT32, p.PARAM_REAL32
FRESH_PARAMETERS: dict[str, tuple[float, int]] = {
    "COM_OF_LOSS_T": (1.0, REAL32), "COM_OBL_RC_ACT": (0, INT32), "RO_SPEED_LIM": (2.0, REAL32),
    "RO_YAW_P": (5.0, REAL32), "RO_YAW_RATE_LIM": (180.0, REAL32), "RD_TRANS_DRV_TRN": (0.174533, REAL32),
    "RD_TRANS_TRN_DRV": (0.0872665, REAL32), "EKF2_EV_CTRL": (0, INT32), "MAV_SYS_ID": (1, INT32),
    "NAV_DLL_ACT": (-1, INT32),
}  # fmt: skip
INTERVALS_S = {
    p.MESSAGE_HEARTBEAT: 1.0,
    p.MESSAGE_SYS_STATUS: 1.0,
    p.MESSAGE_ATTITUDE: 0.05,
    p.MESSAGE_LOCAL_POSITION: 0.1,
    p.MESSAGE_BATTERY: 2.0,
    p.MESSAGE_ESTIMATOR: 1.0,
    p.MESSAGE_GPS: 1.0,
}
"""Which messages it sends unasked, and how often."""


@dataclass(frozen=True, slots=True)
class Px4Setpoint:
    """A set-point that arrived; for tests."""

    at_s: float
    armed: bool
    mode: int
    mask: int
    frame: int
    forward_m_s: float
    left_m_s: float


@dataclass(slots=True)
class Px4Firmware:
    """One rover's autopilot on one link.

    Parameters
    ----------
    body
        What it drives.
    boot_s
        Power-on to armable.
    refuse_arm
        Text with which arming is refused; empty: it is not.
    gps
        Whether it has GPS; without, its position comes only from ODOMETRY.
    seed
        Of its position filter's noise, which is that of ArduRover here.
    """

    body: Body
    system: int = 1
    boot_s: float = 0.2
    refuse_arm: str = ""
    gps: bool = True
    seed: int = 0
    signer: FrameSigner | None = None
    parameters: dict[str, tuple[float, int]] = field(default_factory=lambda: dict(FRESH_PARAMETERS))
    setpoints: deque[Px4Setpoint] = field(default_factory=lambda: deque(maxlen=RECORDS))
    fixes: deque[Any] = field(default_factory=lambda: deque(maxlen=RECORDS))  # ODOMETRY messages
    located: bool = True  # False: position estimate lost
    charge: float = 0.87
    origin: tuple[int, int, int] | None = None
    chart: Chart = field(default_factory=lambda: Chart(map=SphereMap()))
    mode: int = px4.HOLD
    armed: bool = False
    failsafe: bool = False
    _out: list[bytes] = field(default_factory=list)
    _booted_s: float = 0.0
    _stepped_s: float = 0.0
    _target: tuple[float, float] | None = None  # speed, heading
    _target_s: float = -math.inf
    _streaming_s: float = math.inf  # since when there is a stream
    _fix_s: float = -math.inf
    _satellites_s: float = -math.inf
    _stuck: BodyState | None = None
    _spot: bool = False
    _speed: float = 0.0
    _turn: float = 0.0
    _due_s: dict[int, float] = field(default_factory=dict)
    _interval_s: dict[int, float] = field(default_factory=dict)
    _encoder: Encoder = field(init=False)
    noise: FilterNoise = field(init=False)

    def __post_init__(self) -> None:
        self.noise = FilterNoise(self.seed)
        self._encoder = Encoder(self.system, 1, self.signer)

    # ------------------------------------------------------------ power and time
    def power_on(self, now_s: float, *, again: bool = False) -> None:
        """Start from nothing; parameters are kept."""
        del again  # it starts as fast
        self._booted_s = self._stepped_s = now_s
        self.mode, self.armed, self.failsafe, self.origin = px4.HOLD, False, False, None
        self.chart.origin = None
        self._target, self._target_s, self._streaming_s, self._fix_s = None, -math.inf, math.inf, -math.inf
        self._satellites_s = -math.inf
        self._interval_s = dict(INTERVALS_S)
        self._due_s = dict.fromkeys(INTERVALS_S, now_s + 0.1 * self.boot_s)
        self._out = []

    def booted(self, now_s: float) -> bool:
        """Whether it has finished starting."""
        return now_s - self._booted_s >= self.boot_s

    @property
    def next_due_s(self) -> float:
        """When :meth:`tick` has something to do."""
        return min(self._stepped_s + STEP_S, *self._due_s.values())

    def restarts(self, now_s: float) -> bool:
        """Return False: it never restarts by itself."""
        del now_s
        return False

    def tick(self, now_s: float) -> list[bytes]:
        """Run the main loop up to `now_s`; return what goes out."""
        while self._stepped_s + STEP_S <= now_s:
            self._stepped_s += STEP_S
            self._step(self._stepped_s)
        for number, due_s in self._due_s.items():
            if now_s >= due_s:
                interval_s = self._interval_s[number]
                self._due_s[number] = max(due_s, now_s - interval_s) + interval_s
                self.send(number, now_s)
        return self.take(0)

    def take(self, port: int) -> list[bytes]:
        """Return the frames that go out on its only port, and forget them."""
        del port
        out, self._out = self._out, []
        return out

    def _step(self, now_s: float) -> None:
        if self.gps and now_s - self._satellites_s >= SATELLITES_S - 1e-6:
            self._satellites_s = now_s
        by_satellites = math.isfinite(self._satellites_s)
        unaided_s = now_s - max(self._satellites_s, self._fix_s)
        self.noise.step(now_s - self._booted_s, unaided_s, STEP_S, by_satellites=by_satellites)
        if self.origin is None and self.gps and not self._by_vision and self.booted(now_s):
            self._begin_map(now_s)
        offboard = self.mode == px4.OFFBOARD
        if offboard and now_s - self._target_s > self.parameters["COM_OF_LOSS_T"][0]:
            self._lose_offboard()
        if self.armed and self.mode == px4.OFFBOARD and self._target is not None:
            self._approach(*self._steer(*self._target))
        elif self.armed:
            self._approach(0.0, 0.0)
        else:
            left = math.exp(-STEP_S / COAST_S)
            self._speed, self._turn = self._speed * left, self._turn * left
        self.body.drive(self._speed, self._turn)

    def _begin_map(self, now_s: float) -> None:
        """Set the map's origin where the rover stands, and send it."""
        truth = self.body.state()
        self.chart.begin(truth.x_m, truth.y_m)
        latitude, longitude = self.chart.origin or self.chart.world
        self.origin = round(latitude * 1e7), round(longitude * 1e7), round(ALTITUDE_M * 1e3)
        self.send(p.MESSAGE_ORIGIN, now_s)

    @property
    def _by_vision(self) -> bool:
        """Whether poses from outside count."""
        return int(self.parameters["EKF2_EV_CTRL"][0]) & 0b1001 == 0b1001

    def _lose_offboard(self) -> None:
        self._target = None
        if not self.armed:
            self.mode = px4.HOLD
            return
        action, self.failsafe = self.parameters["COM_OBL_RC_ACT"][0], True
        self.mode = px4.HOLD if action in (5, 7) else px4.custom_mode(px4.MainMode.POSCTL)
        self.armed = action != 7
        self.text("Failsafe activated: offboard signal lost", severity=2)

    def _steer(self, speed: float, heading: float) -> tuple[float, float]:
        """Turn towards the vector; drive along it unless it is too far aside. Never backwards."""
        value = {name: pair[0] for name, pair in self.parameters.items()}
        error = wrap(heading - self.body.state().heading_rad)
        if abs(error) > value["RD_TRANS_DRV_TRN"]:
            self._spot = True
        elif abs(error) < value["RD_TRANS_TRN_DRV"]:
            self._spot = False
        limit = math.radians(value["RO_YAW_RATE_LIM"])
        turn = clamp(value["RO_YAW_P"] * error, -limit, limit)
        return (0.0 if self._spot else min(speed, value["RO_SPEED_LIM"])), turn

    def _approach(self, speed: float, turn: float) -> None:
        rate = ACCEL_M_S2 if abs(speed) > abs(self._speed) else DECEL_M_S2
        self._speed += clamp(speed - self._speed, -rate * STEP_S, rate * STEP_S)
        step = TURN_ACCEL_RAD_S2 * STEP_S
        self._turn += clamp(turn - self._turn, -step, step)

    # ------------------------------------------------------------ what people do to it
    def pilot_mode(self, mode: int) -> None:
        """Turn the pilot's mode switch."""
        self.mode, self.failsafe = mode, False

    def stick_sensors(self, on: bool) -> None:
        """Repeat the present measurements from now on, or stop that."""
        self._stuck = self.body.state() if on else None

    def text(self, text: str, severity: int = 4) -> None:
        """Send a line of text, in chunks if it is long."""
        data = text.encode("ascii", "replace")
        chunks = [data[at : at + p.TEXT_CHUNK] for at in range(0, len(data), p.TEXT_CHUNK)]
        for index, chunk in enumerate(chunks):
            self._send(dialect().MAVLink_statustext_message(severity, chunk, 0 if len(chunks) == 1 else 7, index))

    # ------------------------------------------------------------ what arrives
    def receive(self, message: Any, now_s: float, port: int = 0) -> None:
        """Take one of the dialect's messages; those for other systems are dropped."""
        del port
        if getattr(message, "target_system", 0) not in (0, self.system) or now_s < self._booted_s + 0.1 * self.boot_s:
            return
        handler = _HANDLERS.get(message.get_type())
        if handler is not None:
            handler(self, message, now_s)

    def on_command(self, message: Any, now_s: float) -> None:
        """Answer COMMAND_LONG to its sender."""
        values = [getattr(message, f"param{index}") for index in range(1, 8)]
        values = [value if math.isfinite(value) else 0.0 for value in values]  # NaN: not given
        run = _COMMANDS.get(message.command)
        result = p.Result.UNSUPPORTED if run is None else run(self, values, now_s)
        self._send(
            dialect().MAVLink_command_ack_message(
                message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
            )
        )

    def command_mode(self, values: list[float], now_s: float) -> p.Result:
        """Run DO_SET_MODE: main mode and sub mode; OFFBOARD only while set-points stream in."""
        if not int(values[0]) & p.BASE_MODE_CUSTOM:
            return p.Result.DENIED
        main, sub = int(values[1]), int(values[2]) & 0xFF
        if main not in px4.MainMode.__members__.values():
            return p.Result.DENIED
        if main == px4.MainMode.OFFBOARD and not self._streaming(now_s):
            self.text("Switching to mode 'Offboard' is currently not possible: no offboard signal")
            return p.Result.TEMPORARILY_REJECTED
        self.mode, self.failsafe, self._target = px4.custom_mode(px4.MainMode(main), sub), False, None
        return p.Result.ACCEPTED

    def _streaming(self, now_s: float) -> bool:
        """Whether set-points have come at 2 Hz or more for a second."""
        return now_s - self._target_s <= SIGNAL_S and now_s - self._streaming_s >= 1.0

    def command_arm(self, values: list[float], now_s: float) -> p.Result:
        """Run COMPONENT_ARM_DISARM."""
        if values[0] == 0.0:
            self.armed, self.failsafe = False, False
            return p.Result.ACCEPTED
        reason = "" if self.armed else self._arm_check(now_s)
        if reason:
            self.text(f"Arming denied: {reason}", severity=2)
            return p.Result.TEMPORARILY_REJECTED
        self.armed = True
        return p.Result.ACCEPTED

    def _arm_check(self, now_s: float) -> str:
        if not self.booted(now_s) or not self.positioned(now_s):
            return "Resolve system health failures first"
        return self.refuse_arm

    def command_interval(self, values: list[float], now_s: float) -> p.Result:
        """Run SET_MESSAGE_INTERVAL; the heartbeat keeps its 1 Hz."""
        number = int(values[0])
        if number not in MAKERS or values[1] < -1:
            return p.Result.FAILED
        if number != p.MESSAGE_HEARTBEAT:
            interval_s = {-1: math.inf, 0: INTERVALS_S.get(number, math.inf)}.get(int(values[1]), values[1] / 1e6)
            self._interval_s[number], self._due_s[number] = interval_s, now_s + interval_s
        return p.Result.ACCEPTED

    def command_request(self, values: list[float], now_s: float) -> p.Result:
        """Run REQUEST_MESSAGE."""
        return p.Result.ACCEPTED if self.send(int(values[0]), now_s) else p.Result.FAILED

    def on_parameter_read(self, message: Any, now_s: float) -> None:
        """Answer for a known name; an unknown one has no answer."""
        del now_s
        if message.param_id in self.parameters:
            self._send_parameter(message.param_id)

    def on_parameter_set(self, message: Any, now_s: float) -> None:
        """Take a value of the right type and echo it."""
        del now_s
        name = message.param_id
        if name in self.parameters and message.param_type == self.parameters[name][1]:
            value = message.param_value
            if message.param_type == INT32:
                value = struct.unpack("<i", struct.pack("<f", value))[0]
            if math.isfinite(value):
                self.parameters[name] = (value, message.param_type)
            self._send_parameter(name)

    def _send_parameter(self, name: str) -> None:
        value, kind = self.parameters[name]
        if kind == INT32:
            value = struct.unpack("<f", struct.pack("<i", int(value)))[0]
        self._send(dialect().MAVLink_param_value_message(name.encode("ascii"), value, kind, len(self.parameters), 0))

    def on_setpoint(self, message: Any, now_s: float) -> None:
        """Take a velocity vector; nothing else is a set-point for a differential rover here."""
        mask, frame = message.type_mask, message.coordinate_frame
        forward, right = message.vx, message.vy
        self.setpoints.append(Px4Setpoint(now_s, self.armed, self.mode, mask, frame, forward, -right))
        if frame not in (p.FRAME_LOCAL_NED, p.FRAME_BODY_NED):
            self.text(f"SET_POSITION_TARGET_LOCAL_NED coordinate frame {frame} unsupported", severity=2)
            return
        if mask & 0b111000 or not (math.isfinite(forward) and math.isfinite(right)):
            self.text("SET_POSITION_TARGET_LOCAL_NED invalid", severity=2)
            return
        if now_s - self._target_s > SIGNAL_S:
            self._streaming_s = now_s
        self._target_s = now_s
        yaw = math.atan2(right, forward)
        if frame == p.FRAME_BODY_NED:
            zero = forward == right == 0.0  # turned into the world's frame it is still zero: north
            yaw = 0.0 if zero else yaw + p.heading_from_yaw(self.body.state().heading_rad)
        if self.mode == px4.OFFBOARD:
            self._target = math.hypot(forward, right), p.heading_from_yaw(yaw)

    def on_odometry(self, message: Any, now_s: float) -> None:
        """Take an external pose, in the one pair of frames that both autopilots accept."""
        self.fixes.append(message)
        if (message.frame_id, message.child_frame_id) == (p.FRAME_LOCAL_FRD, p.FRAME_BODY_FRD):
            self._fix_s = now_s

    def on_origin(self, message: Any, now_s: float) -> None:
        """Take an origin, once."""
        if self.origin is None:
            self.origin = message.latitude, message.longitude, message.altitude
        self.send(p.MESSAGE_ORIGIN, now_s)

    # ------------------------------------------------------------ what goes out
    def _send(self, message: Any) -> None:
        self._out.append(self._encoder.pack(message))

    def send(self, number: int, now_s: float) -> bool:
        """Send a message as it is now; return whether there was one."""
        message = MAKERS[number](self, now_s) if number in MAKERS else None
        if message is not None:
            self._send(message)
        return message is not None

    def state(self) -> BodyState:
        """Return the state that its filter estimates."""
        return self._stuck or self.noise.seen(self.body.state())

    def fix(self, now_s: float) -> tuple[int, int]:
        """Return the type of the satellite fix, and when the last one was: milliseconds since power-on."""
        del now_s
        known = math.isfinite(self._satellites_s)
        return (3 if self.gps else 0), self.boot_ms(self._satellites_s) if known else 0

    def boot_ms(self, now_s: float) -> int:
        """Return milliseconds since power-on."""
        return int((now_s - self._booted_s) * 1000)

    def positioned(self, now_s: float) -> bool:
        """Whether the position filter has a position."""
        vision = self._by_vision and now_s - self._fix_s < FIX_S
        satellites = now_s - self._satellites_s < NOAID_S
        return self.located and self.booted(now_s) and (satellites or vision)


_HANDLERS: dict[str, Callable[[Px4Firmware, Any, float], None]] = {
    "COMMAND_LONG": Px4Firmware.on_command,
    "PARAM_REQUEST_READ": Px4Firmware.on_parameter_read,
    "PARAM_SET": Px4Firmware.on_parameter_set,
    "SET_POSITION_TARGET_LOCAL_NED": Px4Firmware.on_setpoint,
    "ODOMETRY": Px4Firmware.on_odometry,
    "SET_GPS_GLOBAL_ORIGIN": Px4Firmware.on_origin,
}
_COMMANDS: dict[int, Callable[[Px4Firmware, list[float], float], p.Result]] = {
    p.COMMAND_SET_MODE: Px4Firmware.command_mode,
    p.COMMAND_ARM: Px4Firmware.command_arm,
    p.COMMAND_MESSAGE_INTERVAL: Px4Firmware.command_interval,
    p.COMMAND_REQUEST_MESSAGE: Px4Firmware.command_request,
}


# ---------------------------------------------------------------- its messages, NED on the wire
def _heartbeat(rover: Px4Firmware, now_s: float) -> Any:
    base = p.BASE_MODE_CUSTOM | (p.BASE_MODE_ARMED if rover.armed else 0)
    status = p.STATUS_CRITICAL if rover.failsafe else p.STATUS_ACTIVE if rover.armed else 3
    if not rover.booted(now_s):
        status = 1
    return dialect().MAVLink_heartbeat_message(10, p.AUTOPILOT_PX4, base, rover.mode, status, 3)


def _attitude(rover: Px4Firmware, now_s: float) -> Any:
    state = rover.state()
    yaw = p.heading_from_yaw(state.heading_rad)
    return dialect().MAVLink_attitude_message(rover.boot_ms(now_s), 0, 0, yaw, 0, 0, -state.turn_rad_s)


def _position(rover: Px4Firmware, now_s: float) -> Any:
    if not rover.positioned(now_s):
        return None
    state = rover.state()
    north_m_s = state.speed_m_s * math.sin(state.heading_rad)
    east_m_s = state.speed_m_s * math.cos(state.heading_rad)
    return dialect().MAVLink_local_position_ned_message(
        rover.boot_ms(now_s), *rover.chart.local(state.x_m, state.y_m), 0.0, north_m_s, east_m_s, 0.0
    )


def _estimator(rover: Px4Firmware, now_s: float) -> Any:
    flags = 831 if rover.positioned(now_s) else 1 | 4 | 32 | 128
    return dialect().MAVLink_estimator_status_message(
        rover.boot_ms(now_s) * 1000, flags, 0.1, 0.1, 0.1, 0.1, 0.0, 0.0, 0.5, 0.5
    )


def _satellites(rover: Px4Firmware, now_s: float) -> Any:
    fix, stamp_ms = rover.fix(now_s)
    return dialect().MAVLink_gps_raw_int_message(1000 * stamp_ms, fix, 0, 0, 0, 121, 200, 0, 0, 10 if fix > 1 else 0)


def _battery(rover: Px4Firmware, _: float) -> Any:
    cells = [12600] + [65535] * 9
    return dialect().MAVLink_battery_status_message(0, 0, 0, 32767, cells, 250, 0, 0, round(rover.charge * 100))


def _status(rover: Px4Firmware, _: float) -> Any:
    percent = round(rover.charge * 100)
    return dialect().MAVLink_sys_status_message(0, 0, 0, 100, 12600, 250, percent, 0, 0, 0, 0, 0, 0)


def _version(_: Px4Firmware, __: float) -> Any:
    zeros = [0] * 8
    return dialect().MAVLink_autopilot_version_message(0xE4EF, 0x011000FF, 0, 0, 0, zeros, zeros, zeros, 0, 0, 0)


def _origin(rover: Px4Firmware, _: float) -> Any:
    return None if rover.origin is None else dialect().MAVLink_gps_global_origin_message(*rover.origin)


MAKERS: dict[int, Callable[[Px4Firmware, float], Any]] = {
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
