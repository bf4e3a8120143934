"""The other end of the wire: a base of two emulated controllers on the port that a driver's URL names.

``EmulatedBase(url, body)`` joins the bus, or makes the serial adapter, of that URL; what the wheels do to the world is
the business of a :class:`~fullswarm.simulation.bodies.Body`.
"""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.can.protocol import Frame, WheelCodec
from fullswarm.drivers.can.settings import OdriveOptions, Settings, VescOptions, parse
from fullswarm.emulators.can.adapter import PtyWire
from fullswarm.emulators.can.odrive import ODriveEmulator
from fullswarm.emulators.can.spin import STEP_S, Sender
from fullswarm.emulators.can.vesc import VescEmulator
from fullswarm.emulators.can.wire import BusWire, Wire
from fullswarm.emulators.faults import LinkFaults
from fullswarm.errors import FullswarmError, LinkLost
from fullswarm.simulation.bodies import Body, FreeBody, drive_wheels, wheels_rolled

BATTERY_V = (21.0, 29.4)
"""Empty and full, where the URL does not tell: seven lithium cells."""


class Base:
    """Two controllers and the body that both carry, without a thread or a port.

    Parameters
    ----------
    settings
        What the driver's URL says; the controllers are configured accordingly.
    body
        What the wheels carry.
    bus
        Where the frames of the controllers go.
    """

    def __init__(self, settings: Settings, body: Body, bus: Sender) -> None:
        self.body, self._base_m = body, settings.base.base
        left, right = (_controller(bus, codec, settings.drive) for codec in settings.codecs())
        self.left, self.right = left, right
        self.wheels = (left, right)

    def receive(self, frame: Frame, now_s: float) -> None:
        """Let both hear a frame."""
        for wheel in self.wheels:
            wheel.receive(frame, now_s)

    def step(self, now_s: float) -> None:
        """Go on to `now_s`: wheels, body, cyclic messages. Call at 100 Hz."""
        state = self.body.state()
        turning_m_s = state.turn_rad_s * self._base_m / 2.0
        speeds = (state.speed_m_s - turning_m_s, state.speed_m_s + turning_m_s)
        for wheel, rolled_m, speed_m_s in zip(self.wheels, wheels_rolled(state, self._base_m), speeds, strict=True):
            wheel.spin.felt(rolled_m, speed_m_s)
            wheel.step(now_s)
        drive_wheels(self.body, self.left.spin.speed_m_s, self.right.spin.speed_m_s, self._base_m)

    def switch_off(self) -> None:
        """Cut the power: the wheels stand."""
        self.body.drive(0.0, 0.0)


class EmulatedBase:
    """A robot to plug a driver into; a context manager. The methods below work at any time, from any thread.

    Parameters
    ----------
    url
        The driver's; options of the controllers (firmware, watchdog, min_erpm) are taken from it. With
        ``interface=slcan`` the port is made at its path and removed by :meth:`close`.
    body
        What it stands on; a :class:`~fullswarm.simulation.bodies.FreeBody` by default.

    Raises
    ------
    ConfigError, DriverError, MissingExtra
        The URL is wrong, or its bus or path cannot be had.
    """

    def __init__(self, url: str, body: Body | None = None, clock: Clock | None = None) -> None:
        settings = parse(url)
        self.url = url
        self._clock = clock or MonotonicClock()
        self._volts = settings.base.volts or BATTERY_V
        self.faults = LinkFaults()
        slcan = settings.bus.interface == "slcan"
        self._wire: Wire = (
            PtyWire(settings.channel, settings.bitrate, self.faults) if slcan else BusWire(settings, self.faults)
        )
        self.base = Base(settings, body or FreeBody(clock=self._clock), self)
        self.set_battery(1.0)
        self._orders: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()
        self._stopping = threading.Event()
        self._closed = False
        self._thread = threading.Thread(target=self._run, name=f"emulated {url}", daemon=True)

    def start(self) -> EmulatedBase:
        """Switch the robot on."""
        self._thread.start()
        return self

    def close(self) -> None:
        """Switch it off and let go of the port. Closing twice is fine."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join()
        if not self._closed:
            self._closed = True
            self.base.switch_off()
            self._wire.close()

    def __enter__(self) -> EmulatedBase:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def body(self) -> Body:
        """What it stands on."""
        return self.base.body

    @property
    def left(self) -> ODriveEmulator | VescEmulator:
        """The left wheel's controller."""
        return self.base.left

    @property
    def right(self) -> ODriveEmulator | VescEmulator:
        """The right wheel's controller."""
        return self.base.right

    def send(self, frame: Frame) -> None:
        """Put a controller's frame on the wire."""
        self._wire.send(frame, self._clock.now_s())

    # ------------------------------------------------------------ mishaps
    def unplug(self) -> None:
        """Pull the cable: a serial port vanishes, on a bus nothing passes any more. The wheels have power."""
        self._do(self._wire.unplug)

    def replug(self) -> None:
        """Put it back, at the same path."""
        self._do(self._wire.replug)

    def reboot(self) -> None:
        """Restart both controllers."""
        self._do(lambda: [wheel.reboot(self._clock.now_s()) for wheel in self.base.wheels])

    def mute(self, on: bool) -> None:
        """Hear, but say nothing."""
        for wheel in self.base.wheels:
            wheel.mishaps.muted = on

    def stick_sensors(self, on: bool) -> None:
        """Tell the same motion again and again."""
        for wheel in self.base.wheels:
            wheel.mishaps.stuck_sensor = on

    def set_battery(self, fraction: float) -> None:
        """Charge the battery so far, 0 to 1."""
        empty, full = self._volts
        for wheel in self.base.wheels:
            wheel.volts = empty + fraction * (full - empty)

    def press_estop(self, on: bool) -> None:
        """Press the button, or free it and reset. A VESC does not tell that it is pressed."""
        self._do(lambda: [wheel.press_estop(on) for wheel in self.base.wheels])

    def _do(self, order: Callable[[], object]) -> None:
        """Have the emulator's own thread do it; return when it is done, or raise what it raises."""
        done, failed = threading.Event(), list[FullswarmError]()

        def run() -> None:
            try:
                order()
            except FullswarmError as error:
                failed.append(error)
            done.set()

        self._orders.put(run)
        while not done.wait(0.02):
            if not self._thread.is_alive():
                self._obey()
        if failed:
            raise failed[0]

    def _obey(self) -> None:
        while not self._orders.empty():
            self._orders.get_nowait()()

    # ------------------------------------------------------------ the thread
    def _run(self) -> None:
        next_s = self._clock.now_s()
        try:
            while not self._stopping.is_set():
                self._obey()
                now_s = self._clock.now_s()
                for frame in self._wire.exchange(next_s - now_s, now_s):
                    self.base.receive(frame, self._clock.now_s())
                now_s = self._clock.now_s()
                if now_s >= next_s:
                    next_s = max(next_s + STEP_S, now_s)
                    self.base.step(now_s)
        except LinkLost:
            self.base.switch_off()  # the bus is gone: so is the robot


def _controller(bus: Sender, codec: WheelCodec, drive: OdriveOptions | VescOptions) -> ODriveEmulator | VescEmulator:
    if isinstance(drive, VescOptions):
        return VescEmulator(bus, codec.node, codec.wheel, min_erpm=drive.min_erpm, timeout_s=drive.watchdog)
    return ODriveEmulator(
        bus, codec.node, codec.wheel,
        firmware=drive.firmware, limit_turn_s=drive.vel_limit, watchdog_s=drive.watchdog,
    )  # fmt: skip
