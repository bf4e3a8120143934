"""ArduPilot Rover 4.6 as its wire shows it, measured on the real firmware. No I/O, no clock of its own.

Faithful where drivers get hurt: early ACKs that prove nothing, an armed bit that comes with the next heartbeat,
set-points stored while disarmed, frames and masks silently ignored, a rate cap, silence for unknown parameters,
a 3 s set-point timeout, a ground-station failsafe that is off by default and latches HOLD.

Left out: missions, fences, positions as set-points, radio input, signing.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.body import STAND, Body, BodyState, interpret
from fullswarm.drivers.mavlink.codec import Encoder, dialect
from fullswarm.drivers.mavlink.telemetry import LOOP_HZ, Streams
from fullswarm.geometry import clamp

LOOP_S = 1.0 / LOOP_HZ
REAL_BOOT_S = 42.4
SETPOINT_TIMEOUT_S = 3.0
RECORDS = 20_000
FRESH_PARAMETERS = {
    "FS_ACTION": 2.0, "FS_GCS_ENABLE": 0.0, "FS_GCS_TIMEOUT": 5.0, "FS_TIMEOUT": 1.5, "SYSID_MYGCS": 255.0,
    "SYSID_THISMAV": 1.0, "WP_SPEED": 3.0, "ATC_ACCEL_MAX": 1.0, "ATC_STR_RAT_MAX": 120.0,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class SetpointRecord:
    """A set-point that arrived, as the vehicle understood it; for tests."""

    at_s: float
    armed: bool
    mode: int
    mask: int
    frame: int
    speed_m_s: float
    turn_rad_s: float  # counter-clockwise


@dataclass(slots=True)
class Firmware:
    """One rover's autopilot on one link.

    Parameters
    ----------
    body
        What it drives.
    system
        Its system id.
    boot_s
        Power-on to armable; the real one needs 42.4 s (position filter), everything before scales with it.
    refuse_arm
        Text with which arming is refused; empty: it is not.
    """

    body: Body
    system: int = 1
    boot_s: float = REAL_BOOT_S
    refuse_arm: str = ""
    loop_hz: float = LOOP_HZ
    parameters: dict[str, float] = field(default_factory=lambda: dict(FRESH_PARAMETERS))
    setpoints: deque[SetpointRecord] = field(default_factory=lambda: deque(maxlen=RECORDS))
    located: bool = True  # False: position estimate lost
    mode: int = p.Mode.INITIALISING
    armed: bool = False
    failsafe: bool = False
    reboot_due_s: float = math.inf
    _out: list[bytes] = field(default_factory=list)
    _booted_s: float = 0.0
    _stepped_s: float = 0.0
    _target: tuple[float, float] = STAND
    _target_s: float = -math.inf
    _timed_out: bool = True
    _station_s: float | None = None
    _streams: Streams = field(init=False)
    _encoder: Encoder = field(init=False)
    _announced: int = 0

    def __post_init__(self) -> None:
        self._encoder = Encoder(self.system, 1)
        self._streams = Streams(self, math.inf, self.loop_hz)

    # ------------------------------------------------------------ power and time
    def power_on(self, now_s: float) -> None:
        """Start from nothing: intervals, mode, arming and set-points are forgotten, parameters are kept."""
        self._booted_s = self._stepped_s = now_s
        self.mode, self.armed, self.failsafe = p.Mode.INITIALISING, False, False
        self._target, self._target_s, self._timed_out = STAND, -math.inf, True
        self._station_s, self.reboot_due_s, self._announced = None, math.inf, 0
        self._streams = Streams(self, now_s + self._scaled(1.03), self.loop_hz)
        self._out = [b"Init Gyro**\n\nAP_Logger_File: buffer size=204800\n"]

    def _scaled(self, real_s: float) -> float:
        return real_s * self.boot_s / REAL_BOOT_S

    def _up_s(self, now_s: float) -> float:
        """Return the time since power-on in seconds of the real, slow boot."""
        return (now_s - self._booted_s) * REAL_BOOT_S / max(self.boot_s, 1e-3)

    def tick(self, now_s: float) -> list[bytes]:
        """Run the main loop up to `now_s`; return what goes out."""
        self._announce(now_s)
        while self._stepped_s + LOOP_S <= now_s:
            self._stepped_s += LOOP_S
            self._step(self._stepped_s)
        if self._up_s(now_s) >= 1.03:
            for message in self._streams.due(now_s):
                self._send(message)
        out, self._out = self._out, []
        return out

    def _announce(self, now_s: float) -> None:
        for index, (at_s, text) in enumerate(
            ((2.4, "ArduPilot Ready"), (19.9, "EKF3 IMU0 origin set"), (41.9, "EKF3 IMU0 is using GPS"))
        ):
            if index >= self._announced and self._up_s(now_s) >= at_s:
                self._announced = index + 1
                self.text(text, severity=6)
                if index == 0:
                    self._set_mode(p.Mode.MANUAL, now_s)

    def _step(self, now_s: float) -> None:
        self._watch_station(now_s)
        if self.armed and self.mode == p.Mode.GUIDED:
            if not self._timed_out and now_s - self._target_s > SETPOINT_TIMEOUT_S:
                self._timed_out, self._target = True, STAND
                self.text("target not received last 3secs, stopping")
            top_speed, top_turn = self.parameters["WP_SPEED"], math.radians(self.parameters["ATC_STR_RAT_MAX"])
            speed, turn = self._target
            self.body.drive(clamp(speed, -top_speed, top_speed), clamp(turn, -top_turn, top_turn), LOOP_S)
        else:
            self.body.coast(LOOP_S)

    def _watch_station(self, now_s: float) -> None:
        if not self.parameters.get("FS_GCS_ENABLE") or self._station_s is None or self.failsafe:
            return
        if now_s - self._station_s > self.parameters["FS_GCS_TIMEOUT"] + self.parameters["FS_TIMEOUT"]:
            self.failsafe = True
            self.text("Radio Failsafe")  # sic: the real firmware names the wrong one
            if self.armed and self.parameters["FS_ACTION"] == 2.0:
                self._set_mode(p.Mode.HOLD, now_s)

    # ------------------------------------------------------------ what people do to it
    def _set_mode(self, mode: int, now_s: float) -> None:
        if mode != self.mode:
            self._target, self._target_s, self._timed_out = STAND, now_s, True
        self.mode = mode
        self._streams.heartbeat_now()

    def pilot_mode(self, mode: int, now_s: float) -> None:
        """Turn the pilot's mode switch."""
        self._set_mode(mode, now_s)

    def text(self, text: str, severity: int = 4) -> None:
        """Send a line of text, in chunks if it is long."""
        data = text.encode("ascii", "replace")
        chunks = [data[at : at + p.TEXT_CHUNK] for at in range(0, len(data), p.TEXT_CHUNK)]
        text_id = 0 if len(chunks) == 1 else 1 + len(data)
        for index, chunk in enumerate(chunks):
            self._send(dialect().MAVLink_statustext_message(severity, chunk, text_id, index))

    # ------------------------------------------------------------ what arrives
    def receive(self, message: Any, now_s: float) -> None:
        """Take one of the dialect's messages; those for other systems or from our own id are dropped."""
        source = message.get_srcSystem(), message.get_srcComponent()
        if source == (self.system, 1) or self._up_s(now_s) < 1.03:
            return
        if getattr(message, "target_system", 0) not in (0, self.system):
            return
        handler = _HANDLERS.get(message.get_type())
        if handler is not None:
            handler(self, message, now_s)

    def on_heartbeat(self, message: Any, now_s: float) -> None:
        """Only heartbeats of the controlling station feed the failsafe."""
        if message.get_srcSystem() != int(self.parameters["SYSID_MYGCS"]):
            return
        self._station_s = now_s
        if self.failsafe:
            self.failsafe = False
            self.text("GCS Failsafe Cleared")  # the mode stays what the failsafe made it

    def on_command(self, message: Any, now_s: float) -> None:
        """Answer COMMAND_LONG to its sender."""
        values = [getattr(message, f"param{index}") for index in range(1, 8)]
        run = _COMMANDS.get(message.command)
        result = p.Result.UNSUPPORTED if run is None else run(self, values, now_s)
        self._send(
            dialect().MAVLink_command_ack_message(
                message.command, result, 0, 0, message.get_srcSystem(), message.get_srcComponent()
            )
        )

    def command_mode(self, values: list[float], now_s: float) -> p.Result:
        """Run DO_SET_MODE."""
        if not int(values[0]) & p.BASE_MODE_CUSTOM:
            return p.Result.DENIED
        return self._request_mode(int(values[1]), now_s)

    def _request_mode(self, mode: int, now_s: float) -> p.Result:
        if self.mode == p.Mode.INITIALISING:
            self.text("Flight mode change failed")
            return p.Result.ACCEPTED  # an early ACCEPTED proves nothing
        if p.mode_name(mode).startswith("mode "):
            self.text(f"No such mode {mode}")
            return p.Result.FAILED
        blind = mode == p.Mode.GUIDED and self.armed and not self.positioned(now_s)
        if blind or mode in (p.Mode.AUTO, p.Mode.INITIALISING):
            self.text("Flight mode change failed")
            return p.Result.FAILED
        self._set_mode(mode, now_s)
        return p.Result.ACCEPTED

    def on_set_mode(self, message: Any, now_s: float) -> None:
        """Obey the legacy message, which has no answer."""
        self._request_mode(message.custom_mode, now_s)

    def command_arm(self, values: list[float], now_s: float) -> p.Result:
        """Run COMPONENT_ARM_DISARM: disarming has no check, arming has many."""
        if values[0] not in (0.0, 1.0):
            return p.Result.UNSUPPORTED
        if values[0] == 0.0:
            self.armed = False
            return p.Result.ACCEPTED
        reason = "" if self.armed or values[1] == 2989.0 else self._arm_check(now_s)
        if reason:
            self.text(f"Arm: {reason}", severity=2)
            return p.Result.FAILED
        self.armed = True
        return p.Result.ACCEPTED

    def _arm_check(self, now_s: float) -> str:
        up_s = self._up_s(now_s)
        if self.mode in (p.Mode.RTL, p.Mode.SMART_RTL):
            return "Mode not armable"
        for until_s, reason in (
            (2.4, "System not initialised"), (19.9, "AHRS: waiting for home"),
            (REAL_BOOT_S, "AHRS: not using configured AHRS type"),
        ):  # fmt: skip
            if up_s < until_s:
                return reason
        return self.refuse_arm

    def command_interval(self, values: list[float], now_s: float) -> p.Result:
        """Run SET_MESSAGE_INTERVAL with its cap of 80 % of the main loop's rate."""
        if not all(map(math.isfinite, values[:3])) or values[2] != 0.0:
            return p.Result.DENIED
        reason = self._streams.set_interval(int(values[0]), values[1], now_s)
        if reason:
            self.text(reason)
        return p.Result.DENIED if reason else p.Result.ACCEPTED

    def command_request(self, values: list[float], now_s: float) -> p.Result:
        """Run REQUEST_MESSAGE."""
        messages = self._streams.make(int(values[0]), now_s)
        for message in messages:
            self._send(message)
        return p.Result.ACCEPTED if messages else p.Result.FAILED

    def command_reboot(self, values: list[float], now_s: float) -> p.Result:
        """Run PREFLIGHT_REBOOT_SHUTDOWN: never while armed; the links go down 0.66 s later."""
        if self.armed:
            return p.Result.FAILED
        if values[0] == 1.0:
            self.reboot_due_s = now_s + self._scaled(0.66)
        return p.Result.ACCEPTED

    def on_parameter_read(self, message: Any, now_s: float) -> None:
        """Answer for a known name; an unknown one is met with silence."""
        del now_s
        if message.param_id in self.parameters:
            self._send_parameter(message.param_id)

    def on_parameter_set(self, message: Any, now_s: float) -> None:
        """Take any finite value without a range check and echo it."""
        del now_s
        if message.param_id in self.parameters and math.isfinite(message.param_value):
            self.parameters[message.param_id] = message.param_value
            self._send_parameter(message.param_id)

    def _send_parameter(self, name: str) -> None:
        value = self.parameters[name]
        kind = p.PARAM_INT8 if name in ("FS_ACTION", "FS_GCS_ENABLE") else p.PARAM_REAL32
        self._send(
            dialect().MAVLink_param_value_message(name.encode("ascii"), value, kind, len(self.parameters), 65535)
        )

    def on_timesync(self, message: Any, now_s: float) -> None:
        """Answer a request (tc1 = 0) with the time since boot."""
        if message.tc1 == 0:
            self._send(dialect().MAVLink_timesync_message(int((now_s - self._booted_s) * 1e9), message.ts1))

    def on_setpoint(self, message: Any, now_s: float) -> None:
        """Take a set-point; in GUIDED it is stored even while disarmed: arming then drives off."""
        target = interpret(message, self.body.state())
        mask, frame = message.type_mask, message.coordinate_frame
        record = SetpointRecord(now_s, self.armed, self.mode, mask, frame, message.vx, -message.yaw_rate)
        self.setpoints.append(record)
        if target is not None and self.mode == p.Mode.GUIDED:
            self._target, self._target_s, self._timed_out = target, now_s, False

    # ------------------------------------------------------------ what goes out
    def _send(self, message: Any) -> None:
        self._out.append(self._encoder.pack(message))

    def state(self) -> BodyState:
        """Return where the body is."""
        return self.body.state()

    def boot_ms(self, now_s: float) -> int:
        """Return milliseconds since power-on."""
        return int((now_s - self._booted_s) * 1000)

    def positioned(self, now_s: float) -> bool:
        """Whether the position filter has a position: late in the boot, and not while it is lost."""
        return self.located and self._up_s(now_s) >= 41.9


_HANDLERS: dict[str, Callable[[Firmware, Any, float], None]] = {
    "HEARTBEAT": Firmware.on_heartbeat,
    "COMMAND_LONG": Firmware.on_command,
    "SET_MODE": Firmware.on_set_mode,
    "PARAM_REQUEST_READ": Firmware.on_parameter_read,
    "PARAM_SET": Firmware.on_parameter_set,
    "TIMESYNC": Firmware.on_timesync,
    "SET_POSITION_TARGET_LOCAL_NED": Firmware.on_setpoint,
}
_COMMANDS: dict[int, Callable[[Firmware, list[float], float], p.Result]] = {
    p.COMMAND_SET_MODE: Firmware.command_mode,
    p.COMMAND_ARM: Firmware.command_arm,
    p.COMMAND_MESSAGE_INTERVAL: Firmware.command_interval,
    p.COMMAND_REQUEST_MESSAGE: Firmware.command_request,
    p.COMMAND_REBOOT: Firmware.command_reboot,
}
