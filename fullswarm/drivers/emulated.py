"""Robots that the simulated world emulates: ``emulate = "create2"`` in a fleet file.

The world gives such a robot a body, firmware and a real port; its agent opens that port with the make's own driver and
cannot tell the difference. Which words there are, and what they start, is in the makes' records.
"""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from urllib.parse import urlsplit

from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.drivers.body import Body
from fullswarm.drivers.frames import in_frame
from fullswarm.drivers.make import Emulator, emulated_as, emulation_part
from fullswarm.earth import SITL_ORIGIN_DEG
from fullswarm.errors import ConfigError


def port_folder(config: SwarmConfig) -> Path:
    """Return where the ports of a swarm's emulated robots are; the same for the world and the agents of one user."""
    world = config.world_or_default.address.rpartition(":")[2]
    return Path(tempfile.gettempdir()) / f"fullswarm-{os.getuid()}" / f"{config.swarm}-{world}"


def driver_url(config: SwarmConfig, robot: RobotConfig) -> str:
    """Return the URL with which an emulated robot's agent opens its driver; the fleet file's own `driver` wins.

    Raises
    ------
    ConfigError
        Its word is unknown, e.g. because its package is not installed here.
    """
    url = robot.driver
    if not url:
        _, model = emulated_as(robot.emulate or "")
        alike = [each.id for each in config.robot if each.emulate == robot.emulate]
        url = model.driver_url(port_folder(config) / robot.id, alike.index(robot.id))
    return in_frame(url, config.origin_deg or SITL_ORIGIN_DEG)  # a simulated world always lies somewhere


def start(word: str, url: str, body: Body) -> Emulator:
    """Start the emulator that a word names on a body, at the other end of a driver's URL.

    Raises
    ------
    ConfigError
        The URL is not one of this make.
    DriverError
        Its port cannot be had.
    MissingExtra
        The make's library is not installed.
    """
    make, model = emulated_as(word)
    fits, scheme = urlsplit(model.url).scheme, urlsplit(url).scheme
    if make.emulation is None or scheme != fits:
        raise ConfigError(f"an emulated {word} has no port of the kind '{scheme}'", where=url, hint=f"write {fits}://…")
    emulator: Emulator = emulation_part(make, make.emulation.start)(url, body)
    return emulator
