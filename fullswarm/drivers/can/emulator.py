"""The other end of the wire: one emulated controller per wheel, and the body that both carry.

``ODriveEmulator`` and ``VescEmulator`` speak the protocols; a first-order wheel stands for the motor. What the
wheels do to the world is the business of a :class:`Body`: the one here rolls freely, a body of the simulated
world may take its place. ``EmulatedBase(url)`` puts two of them on the bus that a driver's URL names.
"""

from __future__ import annotations

import math
import struct
import threading
from typing import Protocol

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.can import odrive, vesc
from fullswarm.drivers.can.odrive import AxisState, Firmware
from fullswarm.drivers.can.port import CanPort
from fullswarm.drivers.can.protocol import Frame, Wheel, WheelCodec
from fullswarm.drivers.can.settings import OdriveOptions, VescOptions, parse
from fullswarm.errors import LinkLost

STEP_S = 0.01
HEARTBEAT_S = 0.1
STATUS_S = 0.02
DRIVEN_S, BRAKED_S, COASTING_S = 0.03, 0.1, 0.4
"""Time constants of a wheel that is regulated, braked, let go."""


class Sender(Protocol):
    """Where frames go: a :class:`~fullswarm.drivers.can.port.CanPort` or a list in a test."""

    def send(self, frame: Frame) -> None:
        """Put `frame` on the bus."""
        ...


class Body(Protocol):
    """What two wheels carry."""

    def set_wheels(self, left_m_s: float, right_m_s: float) -> None:
        """Turn the wheels at these speeds from now on."""
        ...

    def travelled(self) -> tuple[float, float]:
        """Return how far the left and the right wheel have really gone, in m since the start."""
        ...


class Base:
    """A :class:`Body` alone in the world: the wheels go as far as they turn."""

    def __init__(self, clock: Clock | None = None) -> None:
        self._clock = clock or MonotonicClock()
        # One tuple, replaced as a whole: other threads may look at any time. Since when, distances, speeds.
        self._motion = (self._clock.now_s(), (0.0, 0.0), (0.0, 0.0))

    def set_wheels(self, left_m_s: float, right_m_s: float) -> None:
        """Turn the wheels at these speeds from now on."""
        now_s = self._clock.now_s()
        self._motion = (now_s, self._travelled_at(now_s), (left_m_s, right_m_s))

    def travelled(self) -> tuple[float, float]:
        """Return how far the wheels have gone."""
        return self._travelled_at(self._clock.now_s())

    def _travelled_at(self, now_s: float) -> tuple[float, float]:
        since_s, (left, right), (v_left, v_right) = self._motion
        return left + v_left * (now_s - since_s), right + v_right * (now_s - since_s)


class Spin:
    """A wheel that follows a wished speed with a first-order lag, and the speed that came of it."""

    def __init__(self) -> None:
        self.speed_m_s = 0.0  # what the motor makes of the wish
        self.measured_m_s = 0.0  # what the body made of that
        self.travelled_m = 0.0
        self._now_s: float | None = None

    def step(self, wished_m_s: float, lag_s: float, travelled_m: float, now_s: float) -> None:
        """Move on to `now_s`; the body has carried the wheel to `travelled_m`."""
        if self._now_s is not None and now_s > self._now_s:
            elapsed_s = now_s - self._now_s
            self.speed_m_s += (wished_m_s - self.speed_m_s) * -math.expm1(-elapsed_s / lag_s)
            self.measured_m_s = (travelled_m - self.travelled_m) / elapsed_s
        self._now_s, self.travelled_m = now_s, travelled_m


class ODriveEmulator:
    """An ODrive axis: states, errors, watchdog (off unless `watchdog_s`), heartbeats, encoder estimates."""

    def __init__(
        self,
        bus: Sender,
        node: int,
        wheel: Wheel,
        *,
        firmware: Firmware = "0.6",
        limit_turn_s: float = 2.0,
        watchdog_s: float | None = None,
    ) -> None:
        self._bus, self.node, self._wheel = bus, node, wheel
        self._firmware, self._limit_turn_s, self._watchdog_s = firmware, limit_turn_s, watchdog_s
        self.spin = Spin()
        self.state = AxisState.IDLE
        self.error = 0
        self.unplugged = False
        self.mute_motion = False  # sends no encoder estimates
        self.cyclic_motion = True  # sends them by itself, not only when asked
        self.refuses = False  # never enters closed loop, as an axis that is not calibrated
        self._turn_s = 0.0
        self._velocity_control = False
        self._zero_turn = 0.0
        self._fed_s: float | None = None
        self._beat_s = self._encoder_s = -math.inf

    def inject(self, error: str) -> None:
        """Raise an error by its name: the axis disarms."""
        self.error |= odrive.error_bit(error, self._firmware)
        self.drop_out()

    def drop_out(self) -> None:
        """Leave closed loop without saying why."""
        self.state, self._turn_s = AxisState.IDLE, 0.0

    def receive(self, frame: Frame, now_s: float) -> None:
        """Obey one frame; short payloads are accepted as far as they go."""
        if self.unplugged or frame.extended or frame.id >> 5 != self.node:
            return
        command = frame.id & 0x1F
        if self._firmware == "0.5" or command == odrive.Command.SET_VELOCITY:
            self._fed_s = now_s
        if frame.remote:
            self._answer(command)
            return
        match command:
            case odrive.Command.SET_STATE if len(frame.data) >= 4:
                self._request(struct.unpack_from("<I", frame.data)[0], now_s)
            case odrive.Command.SET_MODE if len(frame.data) >= 4:
                self._velocity_control = frame.data[0] == odrive.VELOCITY_CONTROL
            case odrive.Command.SET_VELOCITY if len(frame.data) >= 4:
                self._set_velocity(struct.unpack_from("<f", frame.data)[0])
            case odrive.Command.CLEAR_ERRORS:
                self.error = 0
            case odrive.Command.ESTOP:
                self.inject("ESTOP_REQUESTED")
            case odrive.Command.REBOOT:
                self.error, self._velocity_control, self._zero_turn = 0, False, self._turns()
                self.drop_out()
            case _:
                return

    def _request(self, state: int, now_s: float) -> None:
        if state == AxisState.CLOSED_LOOP and not self.error and not self.refuses:
            self.state, self._fed_s = AxisState.CLOSED_LOOP, now_s
        elif state == AxisState.IDLE:
            self.drop_out()
        elif state not in (AxisState.CLOSED_LOOP, AxisState.IDLE) and self._firmware == "0.5":
            self.inject("INVALID_STATE")

    def _set_velocity(self, turn_s: float) -> None:
        if self._velocity_control and math.isfinite(turn_s):
            self._turn_s = max(-self._limit_turn_s, min(self._limit_turn_s, turn_s))

    def _answer(self, command: int) -> None:
        if command == odrive.Command.ENCODER:
            self._send_encoder()
        elif command == odrive.Command.GET_VERSION and self._firmware == "0.6":
            self._bus.send(odrive.frame(self.node, odrive.Command.GET_VERSION, bytes([2, 4, 4, 58, 0, 6, 10, 0])))

    def step(self, travelled_m: float, now_s: float) -> None:
        """Turn the wheel and send heartbeat (10 Hz) and encoder estimates (100 Hz)."""
        driving = self.state is AxisState.CLOSED_LOOP
        wished_m_s = self._wheel.metres(self._turn_s) if driving else 0.0
        self.spin.step(wished_m_s, DRIVEN_S if driving else COASTING_S, travelled_m, now_s)
        if driving and self._watchdog_s and self._fed_s is not None and now_s - self._fed_s > self._watchdog_s:
            self.inject("WATCHDOG_TIMER_EXPIRED")
        if self.unplugged:
            return
        if now_s - self._beat_s >= HEARTBEAT_S - STEP_S / 2.0:
            self._beat_s = now_s
            self._bus.send(odrive.heartbeat(self.node, self.error, self.state))
        if self.cyclic_motion and now_s - self._encoder_s >= STEP_S / 2.0:
            self._encoder_s = now_s
            self._send_encoder()

    def _send_encoder(self) -> None:
        if not self.mute_motion:
            turn_s = self._wheel.turns(self.spin.measured_m_s)
            self._bus.send(odrive.encoder(self.node, self._turns() - self._zero_turn, turn_s))

    def _turns(self) -> float:
        return self._wheel.turns(self.spin.travelled_m)


class VescEmulator:
    """A VESC in speed control: dead band, brake, timeout, pongs, status messages 1 and 5.

    Currents other than zero and duty cycles let the wheel roll: nothing here sends them.
    """

    def __init__(
        self,
        bus: Sender,
        node: int,
        wheel: Wheel,
        *,
        min_erpm: float = 900.0,
        timeout_s: float = vesc.FIRMWARE_TIMEOUT_S,
        statuses: frozenset[int] = frozenset({1, 5}),
    ) -> None:
        self._bus, self.node, self._wheel = bus, node, wheel
        self._min_erpm, self._timeout_s, self._statuses = min_erpm, timeout_s, statuses
        self.spin = Spin()
        self.unplugged = False
        self._erpm = 0
        self._brake_a = 0.0
        self._set_s = self._status_s = -math.inf

    @property
    def driving(self) -> bool:
        """Tell whether the speed is regulated now."""
        return abs(self._erpm) >= self._min_erpm

    def receive(self, frame: Frame, now_s: float) -> None:
        """Obey one frame."""
        if self.unplugged or not frame.extended or frame.remote:
            return
        command, address = frame.id >> 8, frame.id & 0xFF
        if address not in (self.node, vesc.EVERYBODY):
            return
        if command == vesc.Command.PING and frame.data:
            self._bus.send(vesc.pong(frame.data[0], self.node))
        elif len(frame.data) == 4 and command <= vesc.Command.SET_ERPM:
            (value,) = struct.unpack(">i", frame.data)
            self._erpm = value if command == vesc.Command.SET_ERPM else 0
            self._brake_a = value / 1e3 if command == vesc.Command.SET_BRAKE else 0.0
            self._set_s = now_s

    def step(self, travelled_m: float, now_s: float) -> None:
        """Turn the wheel and send the status messages (50 Hz)."""
        if now_s - self._set_s > self._timeout_s:
            self._erpm, self._brake_a = 0, 0.0
        wished_m_s = self._wheel.speed_of_erpm(self._erpm) if self.driving else 0.0
        lag_s = DRIVEN_S if self.driving else BRAKED_S if self._brake_a > 0.0 else COASTING_S
        self.spin.step(wished_m_s, lag_s, travelled_m, now_s)
        if self.unplugged or now_s - self._status_s < STATUS_S - STEP_S / 2.0:
            return
        self._status_s = now_s
        if 1 in self._statuses:
            erpm = round(self._wheel.erpm(self.spin.measured_m_s))
            self._bus.send(vesc.status_1(self.node, erpm, 0.0, 0.0))
        if 5 in self._statuses:
            counts = self._wheel.turns(travelled_m) * self._wheel.pole_pairs * vesc.TACHO_PER_TURN
            self._bus.send(vesc.status_5(self.node, math.floor(counts), 24.0))


class EmulatedBase:
    """Two emulated controllers on the bus of a driver's URL, with a thread that runs them; a context manager.

    Parameters
    ----------
    url
        The driver's; options of the controllers (firmware, watchdog, min_erpm) are taken from it.
    body
        What the wheels carry; a free :class:`Base` by default.
    """

    def __init__(self, url: str, body: Body | None = None, clock: Clock | None = None) -> None:
        settings = parse(url)
        self._clock = clock or MonotonicClock()
        self.body: Body = body or Base(self._clock)
        self._port = CanPort(settings)
        left, right = (_emulator(self._port, codec, settings.drive) for codec in settings.codecs())
        self.left, self.right = left, right
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"emulated {url}", daemon=True)

    def __enter__(self) -> EmulatedBase:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """End the thread and let go of the bus."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
        self._port.close()

    def _run(self) -> None:
        next_s = self._clock.now_s()
        try:
            while not self._stopping.is_set():
                frame = self._port.receive(next_s - self._clock.now_s())
                now_s = self._clock.now_s()
                if frame is not None:
                    self.left.receive(frame, now_s)
                    self.right.receive(frame, now_s)
                if now_s >= next_s:
                    next_s = max(next_s + STEP_S, now_s)
                    self._step(now_s)
        except LinkLost:
            self._stopping.set()  # the bus is gone: so is the robot

    def _step(self, now_s: float) -> None:
        left_m, right_m = self.body.travelled()
        self.left.step(left_m, now_s)
        self.right.step(right_m, now_s)
        self.body.set_wheels(self.left.spin.speed_m_s, self.right.spin.speed_m_s)


def _emulator(bus: Sender, codec: WheelCodec, drive: OdriveOptions | VescOptions) -> ODriveEmulator | VescEmulator:
    if isinstance(drive, VescOptions):
        return VescEmulator(bus, codec.node, codec.wheel, min_erpm=drive.min_erpm)
    return ODriveEmulator(
        bus,
        codec.node,
        codec.wheel,
        firmware=drive.firmware,
        limit_turn_s=drive.vel_limit,
        watchdog_s=drive.watchdog,
    )
