"""`fullswarm robots find`: asks every port what robot is there and prints what to write into a fleet file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict

from rich.markup import escape
from rich.table import Table

from fullswarm import output
from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.probe import ask
from fullswarm.drivers.probe.found import Asked, Found
from fullswarm.errors import ConfigError

DEFAULT_UDP = "127.0.0.1:14550"
CHECK = """no robot found; what to check:
- Create or Roomba: switched on (press Clean), serial cable plugged in at both ends; off the charger to drive
- rover over USB or radio: powered; over UDP: it sends to this machine and port (--udp 0.0.0.0:14550 hears the network)
- CAN: interface up (ip link set can0 up type can bitrate 250000), controllers powered; other buses: --can
- ports that you may not use: `fullswarm doctor` prints the command"""


def find(ports: Sequence[str], can: Sequence[str], udp: Sequence[str], *, as_json: bool) -> int:
    """Ask the ports, buses and UDP ports named, or all there are; return 0 when a robot answered, else 1.

    Raises
    ------
    ConfigError
        A bus or a UDP port is not written as it must be.
    MissingExtra
        A bus was named and python-can is not installed.
    """
    answers = []
    for name, question in _questions(ports, can, udp, MonotonicClock()):
        output.progress(f"asking {name} ...")
        answers.append(question())
    found = [robot for each in answers for robot in each.robots]
    if as_json:
        output.data_json({"robots": [asdict(each) for each in found], "ports": [asdict(each) for each in answers]})
    elif found:
        output.data_table(_table(found))
        output.data(f"\n{fleet_lines(found)}")
    for each in answers:
        if each.problem:
            product = f" ({each.product})" if each.product else ""
            output.progress(f"{each.port}{product}: {each.problem}")
    if not found:
        output.progress(CHECK)
    return 0 if found else 1


def fleet_lines(found: Sequence[Found]) -> str:
    """Return what to copy into a fleet file."""
    drivable = [each for each in found if each.url]
    lines = []
    for number, each in enumerate(drivable, 1):
        if each.advice:
            lines.append(f"# {each.advice}")
        lines += ["[[robot]]", f'id = "r{number}"', f'driver = "{each.url}"', ""]
    return "\n".join(lines) or "no driver fits any of these"


def _questions(
    ports: Sequence[str], can: Sequence[str], udp: Sequence[str], clock: Clock
) -> list[tuple[str, Callable[[], Asked]]]:
    """Return what to ask, with its name."""
    from fullswarm.drivers.probe import can_bus, mavlink

    everything = not (ports or can or udp)
    serial = ask.serial_ports() if everything else [ask.SerialPort(path, path) for path in ports]
    buses = can_bus.interfaces_up() if everything else can
    addresses = [_address(each) for each in ([DEFAULT_UDP] if everything else udp)]
    for each in buses:
        can_bus.channel_url(each)  # what is written wrong is refused before anything is asked
    return [
        *((_name(port), lambda port=port: ask.ask_serial(port, clock)) for port in serial),
        *((bus, lambda bus=bus: can_bus.ask_channel(bus, clock)) for bus in buses),
        *(
            (f"udp {host}:{port}", lambda host=host, port=port: mavlink.ask_udp(host, port, clock))
            for host, port in addresses
        ),
    ]


def _name(port: ask.SerialPort) -> str:
    return f"{port.path} ({port.product})" if port.product else port.path


def _address(text: str) -> tuple[str, int]:
    host, _, port = text.rpartition(":")
    if not port.isdecimal() or not 0 < int(port) < 65536:
        raise ConfigError(f"'{text}' is not a UDP port", where="--udp", hint="e.g. 14550, or 0.0.0.0:14550")
    return host.strip("[]") or "127.0.0.1", int(port)


def _table(found: Sequence[Found]) -> Table:
    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for name in ("port", "make", "model", "firmware", "battery", "note"):
        table.add_column(name, overflow="fold")
    for each in found:
        battery = "-" if each.battery is None else f"{each.battery:.0%}"
        cells = (
            each.port,
            each.make,
            each.model,
            each.firmware or "-",
            battery,
            each.note or (each.advice if not each.url else ""),
        )
        table.add_row(*map(escape, cells))
    return table
