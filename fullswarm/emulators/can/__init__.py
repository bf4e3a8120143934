"""Emulated CAN bases, and the functions that the make's record names.

- ``emulator.py``: a base on the bus of a driver's URL, or behind a serial adapter
- ``firmware.py``: two controllers and the body that both move, as chunks of that link; the adapter's commands
- ``odrive.py``, ``vesc.py``: one wheel's motor controller at protocol level; ``wheel.py``: what both have in common
"""

from __future__ import annotations

from typing import TYPE_CHECKING
from urllib.parse import parse_qsl, urlsplit

from fullswarm.errors import ConfigError

if TYPE_CHECKING:
    from fullswarm.drivers.make import Bench
    from fullswarm.emulators.can.emulator import EmulatedBase
    from fullswarm.simulation.bodies import Body

BENCH_BODY = "left=1&right=2&wheel_radius=0.05&base=0.3"


def start(url: str, body: Body) -> EmulatedBase:
    """Switch on the base that a driver's URL names."""
    from fullswarm.emulators.can.emulator import EmulatedBase
    from fullswarm.emulators.ports import make_folder

    make_folder(urlsplit(url).path)
    return EmulatedBase(url, body).start()


def odrive_on_bench(bench: Bench, body: Body) -> EmulatedBase:
    """Switch on a base with ODrives for `fullswarm emulate`."""
    return _on_bench("odrive", bench, body, BENCH_BODY)


def vesc_on_bench(bench: Bench, body: Body) -> EmulatedBase:
    """Switch on a base with VESCs for `fullswarm emulate`."""
    return _on_bench("vesc", bench, body, f"{BENCH_BODY}&pole_pairs=7&gear=10")


def _on_bench(controller: str, bench: Bench, body: Body, options: str) -> EmulatedBase:
    from fullswarm.emulators.can.emulator import EmulatedBase

    url = bench.url or f"can+{controller}://{bench.path}?interface=slcan&{options}"
    if urlsplit(url).scheme != f"can+{controller}":
        raise ConfigError(f"this is not a base with {controller}", where=url, hint=f"write can+{controller}://...")
    return EmulatedBase(url, body).start()


def clients(url: str) -> dict[str, str]:
    """Return how other clients open the bus of a driver's URL."""
    parts = urlsplit(url)
    options = dict(parse_qsl(parts.query))
    more = f", port={options['port']}" if "port" in options else ""
    interface = options.get("interface", "socketcan")
    return {"python-can": f"can.Bus(interface='{interface}', channel='{parts.netloc + parts.path}'{more})"}
