"""An emulated CAN base: two controllers in the shell of all emulators, on the bus that a driver's URL names.

``EmulatedBase(url, body)`` joins the bus, or makes the serial adapter, of that URL.
"""

from __future__ import annotations

from fullswarm.clock import Clock
from fullswarm.drivers.can.port import CanPort
from fullswarm.drivers.can.settings import Settings, parse
from fullswarm.drivers.can.slcan import END
from fullswarm.emulators.base import Emulator, body_and_clock
from fullswarm.emulators.can.firmware import OnAdapter, OnBus, pack, unpack
from fullswarm.emulators.can.odrive import ODriveEmulator
from fullswarm.emulators.can.vesc import VescEmulator
from fullswarm.emulators.ports import PtyPort
from fullswarm.simulation.bodies import Body

BATTERY_V = (21.0, 29.4)
"""Empty and full, where the URL does not say: seven lithium cells."""
LONGEST_REST = 4096


class BusPort:
    """A node on a bus of python-can; a chunk is a packed frame. Unplugged it is cut off from the bus."""

    rates = (0, 0)

    def __init__(self, settings: Settings) -> None:
        self.address = settings.channel
        self._port = CanPort(settings)
        self._plugged = False

    def plug(self) -> None:
        """Join the bus."""
        self._plugged = True

    def fileno(self) -> int:
        """Return the descriptor; -1 for a bus within this process."""
        descriptor = self._port.fileno()
        return -1 if descriptor is None else descriptor

    def receive(self) -> list[bytes]:
        """Return the frames that have arrived; ``LinkLost`` when the bus is gone."""
        return [pack(frame) for frame in self._port.read() if self._plugged]

    def send(self, data: bytes) -> None:
        """Send a frame, if the flipped bits have left one."""
        frame = unpack(data) if self._plugged else None
        if frame is not None:
            self._port.write(frame)

    def drop(self) -> None:
        """A bus has no connections."""

    def pull(self) -> None:
        """Cut it off from the bus."""
        self._plugged = False

    def close(self) -> None:
        """Release the bus."""
        self._port.close()


class AdapterPort(PtyPort):
    """The serial port of a CAN adapter: a faulty link loses and mangles whole lines."""

    def __init__(self, path: str) -> None:
        super().__init__(path, notices=True)
        self._rest = b""

    def receive(self) -> list[bytes] | None:
        """Return whole lines."""
        chunks = super().receive()
        if chunks is None:
            self._rest = b""
            return None
        *lines, rest = (self._rest + b"".join(chunks)).split(END)
        self._rest = rest[-LONGEST_REST:]
        return [line + END for line in lines]


class EmulatedBase(Emulator):
    """A base to plug a driver into.

    Parameters
    ----------
    url
        The driver's; options of the controllers (firmware, watchdog, min_erpm) are taken from it. With
        ``interface=slcan`` the port is made at its path and removed by :meth:`close`.
    body
        What the wheels carry; alone on an endless floor by default.

    Raises
    ------
    ConfigError, DriverError, MissingExtra
        The URL is wrong, or its bus or path cannot be had.
    """

    def __init__(self, url: str, body: Body | None = None, clock: Clock | None = None) -> None:
        settings = parse(url)
        self.url = url
        body, clock = body_and_clock(body, clock)
        self._volts = settings.base.volts or BATTERY_V
        firmware: OnBus
        if settings.bus.interface == "slcan":
            line = AdapterPort(settings.channel)
            firmware = OnAdapter(settings, body, line)
            super().__init__(firmware, [line], body, clock, seeds=(2, 1))
        else:
            bus = BusPort(settings)
            firmware = OnBus(settings, body, bus)
            super().__init__(firmware, [bus], body, clock, seeds=(2, 1))
        self.base = firmware.base
        self.set_battery(1.0)

    @property
    def motors_on(self) -> bool:
        """Whether a wheel's controller is in closed loop."""
        return self.left.energised or self.right.energised

    @property
    def left(self) -> ODriveEmulator | VescEmulator:
        """The left wheel's controller."""
        return self.base.left

    @property
    def right(self) -> ODriveEmulator | VescEmulator:
        """The right wheel's controller."""
        return self.base.right

    def reboot(self) -> None:
        """Restart both controllers."""
        self.do(lambda: [wheel.reboot(self._clock.now_s()) for wheel in self.base.wheels])

    def mute(self, on: bool = True) -> None:
        """Let the controllers receive but send nothing; an adapter still answers."""
        for wheel in self.base.wheels:
            wheel.faults.muted = on

    def stick_sensors(self, on: bool = True) -> None:
        """Report the same motion again and again, or stop that."""
        for wheel in self.base.wheels:
            wheel.faults.stuck_sensor = on

    def set_battery(self, fraction: float) -> None:
        """Charge the battery to this part, 0 to 1."""
        empty, full = self._volts
        for wheel in self.base.wheels:
            wheel.volts = empty + fraction * (full - empty)

    def press_estop(self, on: bool = True) -> None:
        """Press the button, or free it and reset. A VESC does not report that it is pressed."""
        self.do(lambda: [wheel.press_estop(on) for wheel in self.base.wheels])
