"""``sim://[host:port/]robot[?option=value&...]``: where a simulated robot lives and what it can do."""

from __future__ import annotations

import math
from dataclasses import dataclass
from urllib.parse import parse_qsl, urlencode, urlsplit

from fullswarm.config import DEFAULT_WORLD, WorldConfig
from fullswarm.drivers.base import Description, Limits
from fullswarm.drivers.sim.protocol import parse_address
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.keys import ROBOT_ID

SENSING_M = 3.0

OPTIONS = (
    "speed_limit_m_s",
    "turn_limit_rad_s",
    "accel_limit_m_s2",
    "turn_accel_limit_rad_s2",
    "radius_m",
    "watchdog_s",
)
"""Options of the URL that are fields of `WorldConfig`; besides, ``sensing_m``."""


@dataclass(frozen=True, slots=True)
class SimUrl:
    """A parsed URL."""

    robot: str
    host: str
    port: int
    description: Description
    sensing_m: float


def parse_url(url: str) -> SimUrl:
    """Parse a simulated robot's URL.

    Raises
    ------
    ConfigError
        No such form, robot id, option or value.
    """
    parts = urlsplit(url)
    address, robot = (parts.netloc, parts.path.strip("/")) if parts.path.strip("/") else (DEFAULT_WORLD, parts.netloc)
    if parts.scheme != "sim" or not ROBOT_ID.match(robot):
        raise ConfigError("not a simulated robot", where=url, hint="write sim://r1 or sim://127.0.0.1:7450/r1")
    host, port = parse_address(address, where=url)
    numbers = dict.fromkeys((*OPTIONS, "sensing_m"), math.nan)
    for key, text in parse_qsl(parts.query, keep_blank_values=True):
        if key not in numbers:
            raise ConfigError(f"unknown option '{key}'", where=url, hint=did_you_mean(key, numbers))
        numbers[key] = _positive(text, key, url)
    sensing_m = numbers.pop("sensing_m")
    config = WorldConfig().model_copy(update={key: value for key, value in numbers.items() if value > 0})
    sensing_m = sensing_m if sensing_m > 0 else SENSING_M
    return SimUrl(robot, host, port, describe(config, sensing_m), sensing_m)


def _positive(text: str, key: str, url: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (value > 0 and math.isfinite(value)):
        raise ConfigError(f"{key} = '{text}' is not a positive number", where=url)
    return value


def describe(config: WorldConfig, sensing_m: float = SENSING_M) -> Description:
    """Return what the driver of a robot in this world offers that senses so far."""
    return Description(
        make="sim",
        model=config.engine,
        radius_m=config.radius_m,
        limits=Limits(
            speed_m_s=config.speed_limit_m_s,
            turn_rad_s=config.turn_limit_rad_s,
            accel_m_s2=config.accel_limit_m_s2,
            turn_accel_rad_s2=config.turn_accel_limit_rad_s2,
        ),
        senses_pose=True,
        senses_obstacles=True,
        senses_bumps=True,
        bodies_range_m=sensing_m if config.sight.bodies else 0.0,
        watchdog_s=config.watchdog_s,
    )


def url_for(config: WorldConfig, robot: str, sensing_m: float = SENSING_M) -> str:
    """Return the URL of a robot of this world; it names only what differs from the defaults."""
    usual = WorldConfig()
    options = {key: getattr(config, key) for key in OPTIONS if getattr(config, key) != getattr(usual, key)}
    if sensing_m != SENSING_M:
        options["sensing_m"] = sensing_m
    place = "" if config.address == DEFAULT_WORLD else f"{config.address}/"
    return f"sim://{place}{robot}" + (f"?{urlencode(options)}" if options else "")
