"""Listens for a MAVLink vehicle's heartbeat, then asks for its version and battery. Sends no heartbeat of its own.

A vehicle that has seen a ground station's heartbeat may start its failsafe when they end; a question does not.
"""

from __future__ import annotations

import errno
import select
import socket
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from fullswarm.clock import Clock
from fullswarm.drivers.make import Scope
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.codec import StationEncoder, StreamParser
from fullswarm.drivers.mavlink.settings import Address, parse_url
from fullswarm.drivers.ports import Port
from fullswarm.drivers.probe.found import Asked, Found, unasked
from fullswarm.drivers.probe.line import SerialPort
from fullswarm.errors import ConfigError, DriverError, LinkLost, MissingExtra
from fullswarm.reasons import Code

LISTEN_S = 0.0  # asking listens
DEFAULT_UDP = "127.0.0.1:14550"
VENDORS = frozenset({0x1209, 0x26AC, 0x2DAE, 0x3162})
"""USB vendors of flight controllers (pid.codes/ArduPilot, 3D Robotics, CubePilot, Holybro): no Create behind these."""

HEARTBEAT_S = 1.5
ANSWER_S, TRIES = 0.4, 3
SYSTEM, COMPONENT = 254, 190  # not 255: to most vehicles that is *the* ground station
PX4 = 12
MAKES = {3: "ArduPilot", PX4: "PX4"}
KINDS = {1: "Plane", 2: "Copter", 10: "Rover", 11: "Boat", 12: "Submarine"}
GROUND_STATION = 6
AUTOPILOT = 1
"""Its component id."""
SILENCE = "no heartbeat within 1.5 s: is the vehicle on, and does it send to this port?"


class Link(Protocol):
    """Both ways of a link."""

    def receive(self, timeout_s: float) -> bytes:
        """Return what is there, waiting up to `timeout_s` for it."""
        ...

    def send(self, data: bytes) -> None:
        """Send one frame."""
        ...


@dataclass(slots=True)
class _Seen:
    """What one vehicle has reported."""

    kind: int
    autopilot: int
    armed: bool
    firmware: str = ""
    battery: float | None = None


def _complete(vehicle: _Seen) -> bool:
    return bool(vehicle.firmware) and vehicle.battery is not None


def is_mavlink(received: bytes) -> bool:
    """Tell whether bytes hold a whole MAVLink frame; False without pymavlink."""
    try:
        return bool(StreamParser().feed(received))
    except MissingExtra:
        return False


def questions(scope: Scope, clock: Clock) -> list[tuple[str, Callable[[], Asked]]]:
    """Return the UDP ports to listen on, by default that of most ground stations.

    Raises
    ------
    ConfigError
        A UDP port is not written as it must be.
    """
    addresses = [_address(each) for each in ([DEFAULT_UDP] if scope.everything else scope.udp)]
    return [(f"udp {host}:{port}", partial(ask_udp, host, port, clock)) for host, port in addresses]


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"'{text}' is not a UDP port", where="--udp", hint="e.g. 14550, or 0.0.0.0:14550")
    return host.strip("[]") or "127.0.0.1", int(port)


def knows(port: SerialPort, received: bytes) -> bool:
    """Tell whether a flight controller is on the port, by its USB vendor or by what it sends."""
    return port.vendor in VENDORS or is_mavlink(received)


def ask_line(link: Link, port: SerialPort, baud: int, _received: bytes, clock: Clock) -> tuple[Found, ...]:
    """Return the vehicle on a claimed serial line at one rate."""
    return ask(link, port.path, f"mavlink+serial://{port.path}?baud={baud}", clock)


def ask(link: Link, port: str, url: str, clock: Clock, *, several: bool = False) -> tuple[Found, ...]:
    """Return the vehicles that are received on a link within 1.5 s.

    Parameters
    ----------
    url
        What the driver would be opened with, without a system id.
    several
        Wait for more vehicles after the first.

    Raises
    ------
    MissingExtra
        pymavlink is not installed.
    """
    parser, seen = StreamParser(), dict[int, _Seen]()

    def listen(duration_s: float, enough: Callable[[], bool]) -> None:
        end_s = clock.now_s() + duration_s
        while not enough() and (left_s := end_s - clock.now_s()) > 0:
            for message in parser.feed(link.receive(left_s)):
                _note(seen, message)

    listen(HEARTBEAT_S, lambda: bool(seen) and not several)
    for system, vehicle in list(seen.items()):
        encoder = StationEncoder(SYSTEM, COMPONENT, system)
        for _ in range(TRIES):
            for message in (p.MESSAGE_VERSION, p.MESSAGE_BATTERY):
                link.send(encoder.request_message(message))
            listen(ANSWER_S, partial(_complete, vehicle))
            if _complete(vehicle):
                break
    return tuple(_found(port, url, system, vehicle, len(seen)) for system, vehicle in sorted(seen.items()))


def _note(seen: dict[int, _Seen], message: Any) -> None:
    if message.get_srcComponent() != AUTOPILOT:  # some gimbals and receivers identify as ArduPilot, too
        return
    system = message.get_srcSystem()
    match message.get_type():
        case "HEARTBEAT" if message.autopilot != p.AUTOPILOT_NONE and message.type != GROUND_STATION:
            vehicle = seen.setdefault(system, _Seen(message.type, message.autopilot, armed=False))
            vehicle.armed = bool(message.base_mode & 128)
        case "AUTOPILOT_VERSION" if system in seen:
            number = message.flight_sw_version
            seen[system].firmware = ".".join(str(number >> shift & 0xFF) for shift in (24, 16, 8))
        case "BATTERY_STATUS" | "SYS_STATUS" if system in seen and 0 <= message.battery_remaining <= 100:
            seen[system].battery = message.battery_remaining / 100.0
        case _:
            return


def _found(port: str, url: str, system: int, vehicle: _Seen, count: int) -> Found:
    make = MAKES.get(vehicle.autopilot, f"MAVLink autopilot {vehicle.autopilot}")
    drivable = vehicle.kind in p.ROVER_TYPES and vehicle.autopilot in MAKES
    options = ([f"sysid={system}"] if system != 1 else []) + (["autopilot=px4"] if vehicle.autopilot == PX4 else [])
    notes = []
    if not drivable:
        notes.append("only ground rovers under ArduPilot or PX4 are driven")
    if vehicle.armed:
        notes.append("ARMED: it is being driven")
    if count > 1:
        notes.append("several vehicles on one port: give each its own")
    return Found(
        port=port,
        make=make,
        model=KINDS.get(vehicle.kind, f"vehicle type {vehicle.kind}"),
        firmware=vehicle.firmware,
        battery=vehicle.battery,
        url=_with(url, options) if drivable else "",
        note=", ".join(notes),
    )


def _with(url: str, options: list[str]) -> str:
    if not options:
        return url
    return f"{url}{'&' if '?' in url else '?'}{'&'.join(options)}"


class UdpLink:
    """A UDP port that answers all senders; a frame names the vehicle that it is for.

    Raises
    ------
    DriverError
        The port cannot be had.
    """

    def __init__(self, host: str, port: int) -> None:
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        self._peers: set[Any] = set()
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            holder = udp_holder(port) if error.errno == errno.EADDRINUSE else ""
            what = f"the port is held by {holder}" if holder else f"cannot listen there: {error.strerror or error}"
            hint = "end that program; one port serves one driver" if holder else "choose another address or port"
            code = Code.PORT_HELD if holder else Code.NONE
            raise DriverError(what, where=f"udp {host}:{port}", hint=hint, code=code) from error

    def __enter__(self) -> UdpLink:
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()

    def receive(self, timeout_s: float) -> bytes:
        """Return one datagram."""
        self._socket.settimeout(max(timeout_s, 1e-3))
        try:
            data, peer = self._socket.recvfrom(65536)
        except OSError:
            return b""  # nothing came in time, or a peer is gone: then it sends nothing either
        self._peers.add(peer)
        return data

    def send(self, data: bytes) -> None:
        """Send a datagram to all peers."""
        for peer in self._peers:
            self._socket.sendto(data, peer)


def udp_holder(port: int) -> str:
    """Name the processes that listen on a UDP port, as far as this user may look; empty if none is seen."""
    rows = [row.split() for table in ("udp", "udp6") for row in _lines(Path("/proc/net") / table)[1:]]
    sockets = {f"socket:[{row[9]}]" for row in rows if int(row[1].rpartition(":")[2], 16) == port}
    holders = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            if any(each.is_symlink() and str(each.readlink()) in sockets for each in (process / "fd").iterdir()):
                holders.append(f"{(process / 'comm').read_text().strip()} (pid {process.name})")
        except OSError:
            continue  # ended meanwhile, or of another user
    return ", ".join(holders)


def _lines(path: Path) -> list[str]:
    try:
        return path.read_text().splitlines()
    except OSError:
        return [""]


def ask_udp(host: str, port: int, clock: Clock) -> Asked:
    """Ask the vehicles that send to a UDP port of this machine."""
    name = f"udp {host}:{port}"
    try:
        with UdpLink(host, port) as link:
            robots = ask(link, name, f"mavlink+udp://{host}:{port}", clock, several=True)
    except DriverError as error:
        return unasked(name, error)
    return Asked(name, robots=robots, problem="" if robots else SILENCE)


def ask_url(url: str, clock: Clock) -> Asked:
    """Ask the vehicle at a driver's URL over UDP or TCP."""
    address, _ = parse_url(url)
    if address.scheme == "mavlink+udp":
        return replace(ask_udp(address.host, address.port, clock), port=str(address))
    try:
        opened = address.open(lambda _: True)
    except DriverError as error:
        return unasked(str(address), error)
    try:
        robots = ask(_Connected(opened), str(address), _base_url(address), clock)
    except LinkLost as error:
        return Asked(str(address), problem=error.what)
    finally:
        opened.close()
    return Asked(str(address), robots=robots, problem="" if robots else SILENCE)


def _base_url(address: Address) -> str:
    return f"{address.scheme}://{address.host}:{address.port}"


@dataclass(frozen=True, slots=True)
class _Connected:
    """A driver's port, waited on."""

    port: Port[bytes]

    def receive(self, timeout_s: float) -> bytes:
        descriptor = self.port.fileno()
        ready = descriptor is not None and select.select([descriptor], [], [], timeout_s)[0]
        return b"".join(self.port.read()) if ready else b""

    def send(self, data: bytes) -> None:
        self.port.write(data)
