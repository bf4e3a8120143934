"""Finds the controllers on a CAN bus: ODrive axes by their heartbeats, VESCs by their status messages and pongs.

Nothing that is sent sets a motor: a remote request for the version (ODrive 0.6 answers) and pings (VESC).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from urllib.parse import urlencode

from fullswarm.clock import Clock
from fullswarm.drivers.can import odrive
from fullswarm.drivers.can.odrive import error_names, state_name
from fullswarm.drivers.can.port import CanPort
from fullswarm.drivers.can.protocol import Frame
from fullswarm.drivers.can.settings import Settings, parse
from fullswarm.drivers.make import Scope
from fullswarm.drivers.probe.found import Asked, Found, unasked
from fullswarm.errors import ConfigError, DriverError, did_you_mean

LISTEN_S = 0.6  # ODrive: heartbeats at 10 Hz; VESC: status messages at 50 Hz, pongs at once
HOST = 253  # our address for pongs
VESC_STATUS, VESC_PING, VESC_PONG, LAST_VESC = frozenset({9, 14, 15, 16, 27, 58}), 17, 18, 254
INTERFACES = ("socketcan", "slcan", "virtual", "udp_multicast")
ANY_BODY = {"left": "0", "right": "1", "wheel_radius": "0.1", "base": "0.3"}
"""A bus is opened through the settings of a base; which nodes are on it is not known yet."""

CAN_DEVICE = "280"
"""ARPHRD_CAN in /sys/class/net/*/type."""
FILL_IN = "put in wheel radius and distance between the wheels in metres; swap left and right if it turns the wrong way"
SILENCE = "no node is received: are the controllers powered, is the bitrate right, is the bus terminated at both ends?"


@dataclass(slots=True)
class _Axis:
    """What one ODrive axis has reported."""

    error: int = 0
    state: int = 0
    version: str = ""
    volts: float | None = None

    def __str__(self) -> str:
        errors = error_names(self.error, "0.6" if self.version else "0.5")
        supply = "" if self.volts is None else f"{self.volts:.1f} V"
        return ", ".join(filter(None, (state_name(self.state), supply, errors)))


@dataclass(slots=True)
class _Bus:
    """The nodes that were received."""

    axes: dict[int, _Axis] = field(default_factory=dict)
    vescs: set[int] = field(default_factory=set)

    def receive(self, frame: Frame) -> None:
        """Take a frame."""
        if frame.remote:
            return
        if frame.extended:
            command, address = frame.id >> 8, frame.id & 0xFF
            if command in VESC_STATUS and address <= LAST_VESC:
                self.vescs.add(address)
            elif command == VESC_PONG and address == HOST and frame.data:
                self.vescs.add(frame.data[0])
            return
        node = frame.id >> 5
        match odrive.decode(frame):
            case odrive.Heartbeat(error, state):
                axis = self.axes.setdefault(node, _Axis())
                axis.error, axis.state = error, state
            case odrive.Version() as version if node in self.axes:
                self.axes[node].version = f"{version.major}.{version.minor}.{version.revision}"
            case odrive.BusPower() as power if node in self.axes:
                self.axes[node].volts = power.volts
            case _:
                return


def questions(scope: Scope, clock: Clock) -> list[tuple[str, Callable[[], Asked]]]:
    """Return the buses to ask, by default the interfaces of the kernel that are up.

    Raises
    ------
    ConfigError
        A bus is not written as it must be; see `channel_url`.
    """
    buses = interfaces_up() if scope.everything else scope.can
    for each in buses:
        channel_url(each)
    return [(bus, partial(ask_channel, bus, clock)) for bus in buses]


def interfaces_up() -> list[str]:
    """Return the CAN interfaces of the kernel that are up."""
    found = []
    for device in sorted(Path("/sys/class/net").glob("*")):
        kind, state = device / "type", device / "operstate"
        if kind.is_file() and kind.read_text().strip() == CAN_DEVICE and state.read_text().strip() != "down":
            found.append(device.name)
    return found


def channel_url(text: str) -> str:
    """Return a driver's URL for a bus written ``can0``, ``slcan:/dev/ttyACM0@500000``, ``udp_multicast:239.74.163.2``.

    Raises
    ------
    ConfigError
        An unknown interface, or nothing after it.
    """
    interface, colon, channel = text.partition(":")
    if not colon:
        interface, channel = "socketcan", text
    if interface not in INTERFACES:
        raise ConfigError(f"no CAN interface '{interface}'", where=text, hint=did_you_mean(interface, INTERFACES))
    options = {"interface": interface}
    if interface == "slcan":
        channel, _, options["bitrate"] = channel.partition("@")
    elif interface == "udp_multicast":
        channel, _, options["port"] = channel.partition(":")
    if not channel:
        raise ConfigError("the channel is missing", where=text, hint="e.g. can0, or slcan:/dev/ttyACM0")
    chosen = {name: value for name, value in (options | ANY_BODY).items() if value}
    return f"can+odrive://{channel}?{urlencode(chosen)}"


def ask_channel(text: str, clock: Clock) -> Asked:
    """Ask a bus; see :func:`channel_url`. Takes 0.6 s."""
    return _ask(parse(channel_url(text)), frozenset(), clock)


def ask_url(url: str, clock: Clock) -> Asked:
    """Ask the bus that a driver's URL names; both of its wheels must be there.

    Raises
    ------
    ConfigError
        Not the URL of a CAN base.
    MissingExtra
        python-can, or what it needs for this interface, is not installed.
    """
    settings = parse(url)
    return _ask(settings, frozenset({settings.base.left, settings.base.right}), clock)


def _ask(settings: Settings, wanted: frozenset[int], clock: Clock) -> Asked:
    name = f"{settings.bus.interface} {settings.channel}"
    try:
        port = CanPort(settings)
    except DriverError as error:
        return unasked(name, error)
    try:
        bus = _listen(port, clock)
    except DriverError as error:
        return Asked(name, problem=error.what)
    finally:
        port.close()
    silent = sorted(wanted - (bus.vescs if settings.make == "vesc" else bus.axes.keys()))
    if silent and (bus.axes or bus.vescs):
        numbers = ", ".join(map(str, silent))
        received = ", ".join(map(str, sorted(bus.axes.keys() | bus.vescs)))
        return Asked(name, problem=f"node {numbers} is silent; received: {received}")
    robots = (*_odrives(name, settings, bus), *_vescs(name, settings, bus))
    return Asked(name, robots=robots, problem="" if robots else SILENCE)


def _listen(port: CanPort, clock: Clock) -> _Bus:
    bus, asked = _Bus(), set[int]()
    # One by one: new firmware answers a ping to everybody with "255" instead of its own number.
    ids = (VESC_PING << 8 | node for node in range(LAST_VESC) if node != HOST)
    pings = (Frame(number, extended=True, data=bytes([HOST])) for number in ids)
    end_s = clock.now_s() + LISTEN_S
    while clock.now_s() < end_s:
        for ping, _ in zip(pings, range(8), strict=False):
            port.send(ping)
        frame = port.receive(0.01)
        if frame is not None:
            bus.receive(frame)
        for node in bus.axes.keys() - asked:
            asked.add(node)
            port.send(odrive.request(node, odrive.Version))
            port.send(odrive.request(node, odrive.BusPower))
    return bus


def _odrives(name: str, settings: Settings, bus: _Bus) -> list[Found]:
    found = []
    for nodes in _pairs(sorted(bus.axes)):
        versions = [bus.axes[node].version for node in nodes]
        old = not any(versions)
        found.append(
            Found(
                port=name,
                make="ODrive",
                model=_model(nodes),
                firmware=next(filter(None, versions), "0.5"),
                url=_url("odrive", settings, nodes, {"firmware": "0.5"} if old else {}),
                note="; ".join(f"node {node} {bus.axes[node]}" for node in nodes),
                advice=_advice(nodes),
            )
        )
    return found


def _vescs(name: str, settings: Settings, bus: _Bus) -> list[Found]:
    return [
        Found(
            port=name,
            make="VESC",
            model=_model(nodes),
            url=_url("vesc", settings, nodes, {"pole_pairs": "NUMBER"}),
            advice=_advice(nodes),
        )
        for nodes in _pairs(sorted(bus.vescs))
    ]


def _pairs(nodes: list[int]) -> list[list[int]]:
    return [nodes[start : start + 2] for start in range(0, len(nodes), 2)]


def _model(nodes: list[int]) -> str:
    return f"nodes {nodes[0]} and {nodes[1]}" if len(nodes) > 1 else f"node {nodes[0]}"


def _advice(nodes: list[int]) -> str:
    return FILL_IN if len(nodes) > 1 else "a base needs two wheels: the other one is silent"


def _url(make: str, settings: Settings, nodes: list[int], more: dict[str, str]) -> str:
    if len(nodes) < 2:
        return ""
    bus = settings.bus
    options: dict[str, str] = {"interface": bus.interface} if bus.interface != "socketcan" else {}
    if bus.interface == "slcan":
        options["bitrate"] = str(bus.bitrate)
    elif bus.interface == "udp_multicast":
        options["port"] = str(bus.port)
    wheels = {"left": str(nodes[0]), "right": str(nodes[1]), "wheel_radius": "METRES", "base": "METRES"}
    return f"can+{make}://{settings.channel}?{urlencode(options | wheels | more)}"
