"""Robots that the simulated world emulates: ``emulate = "create2"`` in a fleet file.

The world gives such a robot a body, firmware and a real port; its agent opens that port with the make's own driver and
cannot tell the difference. Here is which emulator a word means, the driver's URL, and how one is set on a body.
"""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.config.models import Emulated
from fullswarm.drivers.body import Body
from fullswarm.drivers.frames import in_frame, origin_of
from fullswarm.earth import SITL_ORIGIN_DEG
from fullswarm.errors import ConfigError

FIRST_ROVER_PORT, ROVER_PORT_STEP = 14550, 10  # as ArduPilot's own simulator numbers its instances
ROVER_BOOT_S = 1.0
"""Power-on to armable; the real firmware's position filter needs 42 s."""

CREATES = ("create1", "roomba500", "create2")
CAN_OPTIONS = "interface=slcan&left=1&right=2&wheel_radius=0.05&base=0.3&radius=0.17"
ODRIVE_OPTIONS = "watchdog=0.5&volts_empty=21&volts_full=29.4"
VESC_OPTIONS = "pole_pairs=7&gear=10"


class Emulator(Protocol):
    """What the world starts and ends."""

    def close(self) -> None:
        """Switch the robot off and give up its port."""
        ...


def port_folder(config: SwarmConfig) -> Path:
    """Return where the ports of a swarm's emulated robots are; the same for the world and the agents of one user."""
    world = config.world_or_default.address.rpartition(":")[2]
    return Path(tempfile.gettempdir()) / f"fullswarm-{os.getuid()}" / f"{config.swarm}-{world}"


def driver_url(config: SwarmConfig, robot: RobotConfig) -> str:
    """Return the URL with which an emulated robot's agent opens its driver; the fleet file's own `driver` wins."""
    if robot.driver:
        return in_frame(robot.driver, config.origin_deg or SITL_ORIGIN_DEG)
    port = port_folder(config) / robot.id
    make = robot.emulate
    if make in CREATES:
        return f"create://{port}?model={make}"
    if make == "rover":
        rovers = [each.id for each in config.robot if each.emulate == "rover"]
        number = FIRST_ROVER_PORT + ROVER_PORT_STEP * rovers.index(robot.id)
        url = f"mavlink+udp://127.0.0.1:{number}?speed=0.5&turn=2.0&radius=0.17"
        return in_frame(url, config.origin_deg or SITL_ORIGIN_DEG)  # a simulated world always lies somewhere
    options = f"{CAN_OPTIONS}&{ODRIVE_OPTIONS if make == 'odrive' else VESC_OPTIONS}"
    return f"can+{make}://{port}?{options}"


def start(make: Emulated, url: str, body: Body) -> Emulator:
    """Start the emulator `make` on a body, at the other end of a driver's URL.

    Raises
    ------
    ConfigError
        The URL is not one of this make.
    DriverError
        Its port cannot be had.
    MissingExtra
        The make's library is not installed.
    """
    scheme = urlsplit(url).scheme
    builders: dict[str, Callable[[str, Body], Emulator]] = {
        "create": _create, "mavlink+udp": _rover, "can+odrive": _base, "can+vesc": _base,
    }  # fmt: skip
    fits = {"rover": "mavlink+udp", "odrive": "can+odrive", "vesc": "can+vesc"}.get(make, "create")
    if scheme != fits:
        raise ConfigError(f"an emulated {make} has no port of the kind '{scheme}'", where=url, hint=f"write {fits}://…")
    return builders[scheme](url, body)


def _create(url: str, body: Body) -> Emulator:
    from fullswarm.drivers.create_oi.emulator import CreateEmulator
    from fullswarm.drivers.create_oi.settings import parse_url

    settings = parse_url(url)
    _make_room(settings.path)
    return CreateEmulator(settings.generation, body, port=settings.path).start()


def _rover(url: str, body: Body) -> Emulator:
    from fullswarm.drivers.mavlink.emulator import RoverEmulator

    address = urlsplit(url)
    port = address.port or 0
    # The port differs from rover to rover, so their position filters err differently, and alike in every run.
    return RoverEmulator(
        f"udp://{address.hostname}:{port}",
        body,
        boot_s=ROVER_BOOT_S,
        seed=port,
        origin=origin_of(url) or SITL_ORIGIN_DEG,
    ).start()


def _base(url: str, body: Body) -> Emulator:
    from fullswarm.drivers.can.emulator import EmulatedBase

    _make_room(urlsplit(url).path)
    return EmulatedBase(url, body).start()


def _make_room(path: str) -> None:
    """Make the folder of a port, for this user alone."""
    folder = Path(path).parent
    if not folder.exists():
        folder.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        folder.mkdir(mode=0o700, exist_ok=True)
