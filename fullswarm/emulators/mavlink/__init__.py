"""Emulated rovers, and the functions that the make's record names.

- ``emulator.py``: ArduPilot and PX4 rovers on real ports
- ``firmware.py``: ArduRover at protocol level, with ``requests.py`` (incoming messages and their answers),
  ``telemetry.py`` (what it sends), ``driving.py`` (set-points, sticks, motors) and ``parameters.py``
- ``px4_firmware.py``: PX4 at protocol level
- ``position.py``: the position estimate of both: map, errors of the filter, sources
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from fullswarm.drivers.fleet_file import origin_of
from fullswarm.earth import SITL_ORIGIN_DEG
from fullswarm.errors import ConfigError, did_you_mean

if TYPE_CHECKING:
    from fullswarm.drivers.make import Bench, Emulator
    from fullswarm.emulators.mavlink.emulator import RoverEmulator
    from fullswarm.simulation.bodies import Body

DEFAULT_LISTEN = "udp://127.0.0.1:14550"
BOOT_S = 1.0
"""Power-on to armable; the real firmware's position filter needs 42 s."""


def start(url: str, body: Body) -> RoverEmulator:
    """Switch on an ArduPilot rover that sends to the UDP port on which a driver listens.

    Raises
    ------
    ConfigError
        The URL is one of another kind of link.
    """
    from fullswarm.emulators.mavlink.emulator import RoverEmulator

    address = urlsplit(url)
    if address.scheme != "mavlink+udp":
        what = f"an emulated rover has no port of the kind '{address.scheme}'"
        raise ConfigError(what, where=url, hint="write mavlink+udp://…")
    port = address.port or 0
    # The port differs from rover to rover, so their position filters err differently, and alike in every run.
    return RoverEmulator(
        f"udp://{address.hostname}:{port}", body, boot_s=BOOT_S, seed=port, origin=origin_of(url) or SITL_ORIGIN_DEG
    ).start()


def on_bench(bench: Bench, body: Body) -> Emulator:
    """Switch on a rover for `fullswarm emulate`, over any kind of link.

    Raises
    ------
    ConfigError
        Unknown model.
    """
    address = f"pty:{bench.path}" if bench.port is not None else bench.listen or DEFAULT_LISTEN
    if bench.url is not None:
        address = _other_end(bench.url)
    if bench.model == "px4":
        from fullswarm.emulators.mavlink.emulator import Px4Emulator

        return Px4Emulator(address, body).start()
    if bench.model not in (None, "rover"):
        raise ConfigError(
            f"no model '{bench.model}'", where="--model", hint=did_you_mean(str(bench.model), ("rover", "px4"))
        )
    from fullswarm.emulators.mavlink.emulator import RoverEmulator

    return RoverEmulator(address, body).start()


def _other_end(url: str) -> str:
    """Return the vehicle's end of the link that a driver's URL names."""
    from fullswarm.drivers.mavlink.settings import parse_url

    address, _ = parse_url(url)
    if address.device:
        return f"pty:{address.device}"
    kind = {"mavlink+udp": "udp", "mavlink+udpout": "udpin", "mavlink+tcp": "tcp"}[address.scheme]
    host = f"[{address.host}]" if ":" in address.host else address.host
    return f"{kind}://{host}:{address.port}"


def clients(url: str) -> dict[str, str]:
    """Return how other clients open the rover at a driver's URL."""
    parts = urlsplit(url)
    path = parts.netloc + parts.path
    if parts.scheme == "mavlink+serial":
        return {"pymavlink": f"mavutil.mavlink_connection('{path}', baud=115200)", "port": path}
    kinds = {"mavlink+udp": ("udpin", "udpin"), "mavlink+udpout": ("udpout", "udpout")}
    ours, mavsdk = kinds.get(parts.scheme, ("tcp", "tcpout"))
    return {
        "pymavlink": f"mavutil.mavlink_connection('{ours}:{path}')",
        "MAVProxy": f"mavproxy.py --master={ours}:{path}",
        "MAVSDK": f"{mavsdk}://{path}",
    }


def mode(emulator: Any) -> str:
    """Return the autopilot's mode, and whether it is armed."""
    from fullswarm.drivers.mavlink.protocol import mode_name
    from fullswarm.drivers.mavlink.px4 import Px4
    from fullswarm.emulators.mavlink.emulator import RoverEmulator

    number = emulator.firmware.mode
    name = mode_name(number) if isinstance(emulator, RoverEmulator) else Px4().mode_name(number)
    return f"{name} {'armed' if emulator.firmware.armed else 'disarmed'}"
