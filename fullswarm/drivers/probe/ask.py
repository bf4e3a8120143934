"""Asks ports what robot is there, without moving anything: serial lines, a UDP port, a CAN bus, a driver's URL.

A port is claimed exclusively while it is asked and let go afterwards; one that another process holds is not touched.
Each make's own part is in ``create``, ``mavlink`` and ``can_bus``.
"""

from __future__ import annotations

import select
from dataclasses import dataclass, replace
from pathlib import Path
from urllib.parse import unquote, urlsplit

import serial
from serial.tools import list_ports

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.link import claim
from fullswarm.drivers.probe.found import Asked
from fullswarm.errors import FullswarmError

BAUDS = (115200, 57600)
"""Create 2 and autopilots over USB first, then Create 1 and telemetry radios. See `create` on this order."""

LISTEN_S = 0.2
GAP_S = 0.002
BY_ID = Path("/dev/serial/by-id")
AUTOPILOT_VENDORS = frozenset({0x1209, 0x26AC, 0x2DAE, 0x3162})
"""USB vendors of flight controllers (pid.codes/ArduPilot, 3D Robotics, CubePilot, Holybro): no Create behind these."""


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port of this machine."""

    path: str  # by id where there is one: it survives another USB socket
    device: str
    product: str = ""
    vendor: int | None = None


class Line:
    """A claimed serial port, read and written with deadlines; a context manager.

    Raises
    ------
    DriverError
        The port is missing, forbidden, no serial port, or held: names the holder.
    """

    def __init__(self, path: str, clock: Clock) -> None:
        self._port: serial.Serial = claim(path, BAUDS[0])
        self._clock = clock

    def __enter__(self) -> Line:
        return self

    def __exit__(self, *_: object) -> None:
        self._port.close()

    def set_baud(self, baud: int) -> None:
        """Go on at another rate; what waited is forgotten."""
        self._port.baudrate = baud
        self._port.reset_input_buffer()

    def send(self, data: bytes) -> None:
        """Write at once. ``OSError`` when the port is gone."""
        self._port.write(data)

    def spell(self, data: bytes) -> None:
        """Write byte by byte with pauses between."""
        for each in data:
            self._port.write(bytes([each]))
            select.select([], [], [], GAP_S)

    def receive(self, timeout_s: float) -> bytes:
        """Return what is there, waiting up to `timeout_s` for it."""
        ready, _, _ = select.select([self._port.fileno()], [], [], max(0.0, timeout_s))
        return bytes(self._port.read(4096)) if ready else b""

    def gather(self, duration_s: float, size: int | None = None) -> bytes:
        """Return all that comes in `duration_s`, or until `size` bytes are there."""
        heard, end_s = b"", self._clock.now_s() + duration_s
        while (left_s := end_s - self._clock.now_s()) > 0 and (size is None or len(heard) < size):
            heard += self.receive(left_s)
        return heard


def serial_ports() -> list[SerialPort]:
    """Return the serial ports of this machine that something is plugged into, those with a name by id first."""
    links = {str(each.resolve()): str(each) for each in sorted(BY_ID.glob("*"))}
    ports = [
        SerialPort(
            links.get(each.device, each.device),
            each.device,
            " ".join(filter(None, (each.manufacturer, each.product or each.description, each.serial_number))),
            each.vid,
        )
        for each in list_ports.comports()
        # Boards have many ttyS that lead nowhere; without USB only a Raspberry Pi's UARTs are worth a question.
        if each.vid is not None or Path(each.device).name.startswith(("ttyAMA", "ttyACM", "ttyUSB", "ttyTHS"))
    ]
    return sorted(ports, key=lambda port: (not port.path.startswith(str(BY_ID)), port.path))


def ask_serial(port: SerialPort | str, clock: Clock | None = None) -> Asked:
    """Ask whoever is on a serial port; some 4 s when nobody is."""
    from fullswarm.drivers.probe import create, mavlink

    known = port if isinstance(port, SerialPort) else SerialPort(port, port)
    clock = clock or MonotonicClock()
    asked = Asked(known.path, known.product)
    try:
        with Line(known.path, clock) as line:
            for baud in BAUDS:
                line.set_baud(baud)
                heard = line.gather(LISTEN_S)
                if known.vendor not in AUTOPILOT_VENDORS and not mavlink.is_mavlink(heard):
                    robot = create.ask(line, known.path, baud, heard)
                    if robot is not None:
                        return replace(asked, robots=(robot,))
            for baud in BAUDS:
                line.set_baud(baud)
                url = f"mavlink+serial://{known.path}?baud={baud}"
                robots = mavlink.ask(line, known.path, url, clock)
                if robots:
                    return replace(asked, robots=robots)
    except FullswarmError as error:
        return replace(asked, problem=f"{error.what} ({error.hint})" if error.hint else error.what)
    except OSError as error:
        return replace(asked, problem=f"the port vanished while it was asked: {error.strerror or error}")
    return replace(asked, problem="nobody answers: is the robot switched on?")


def ask_url(url: str, clock: Clock | None = None) -> Asked:
    """Ask the port that a driver's URL names; a scheme without a probe is a `problem`.

    Raises
    ------
    ConfigError
        The URL is not one of its make.
    MissingExtra
        The make's library is not installed.
    """
    clock = clock or MonotonicClock()
    parts = urlsplit(url)
    if parts.scheme in ("create", "mavlink+serial"):
        return ask_serial(unquote(parts.path), clock)
    if parts.scheme.startswith("mavlink+"):
        from fullswarm.drivers.probe import mavlink

        return mavlink.ask_url(url, clock)
    if parts.scheme.startswith("can+"):
        from fullswarm.drivers.probe import can_bus

        return can_bus.ask_url(url, clock)
    return Asked(url, problem=f"'{parts.scheme}' cannot be asked without driving it")
