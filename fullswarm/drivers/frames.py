"""Robots that know their own position: whose (0, 0) is the swarm's, and which URLs say so.

Such a driver's description says ``own_frame``: its poses count from wherever the robot was switched on. The option
``origin=latitude,longitude`` in its URL puts them into the swarm's frame; the fleet file's origin is added here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

from fullswarm import registry
from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.errors import ConfigError, FullswarmError

if TYPE_CHECKING:
    from fullswarm.drivers.base import Description

OPTION = "origin"


def origin_of(url: str) -> tuple[float, float] | None:
    """Return the latitude and longitude that a URL names; None: none that can be read."""
    words = parse_qs(urlsplit(url).query).get(OPTION, [""])[0].split(",")
    try:
        return float(words[0]), float(words[1])
    except (IndexError, ValueError):
        return None


def in_frame(url: str, origin: tuple[float, float] | None) -> str:
    """Return the URL of a driver that puts its poses into the swarm's frame, where the make needs to be told."""
    if origin is None or not own_frame(url):
        return url
    return f"{url}{'&' if urlsplit(url).query else '?'}{OPTION}={origin[0]:.9g},{origin[1]:.10g}"


def own_frame(url: str) -> bool:
    """Tell whether a driver's poses count from a place of its own; False for a URL that cannot be used at all."""
    if urlsplit(url).scheme == "sim":
        return False
    try:
        description: Description = registry.driver_class(url)(url).description
    except FullswarmError:
        return False  # whoever opens it says what is wrong
    return description.own_frame


def check_frames(config: SwarmConfig, robots: tuple[RobotConfig, ...] | None = None) -> None:
    """Refuse a fleet of more than one robot of which some know their position, but not in a common frame.

    Parameters
    ----------
    robots : the ones to check, default: all

    Raises
    ------
    ConfigError
        Says which, and what to write.
    """
    if len(config.robot) < 2 or config.origin_deg is not None:
        return
    looked = config.robot if robots is None else robots
    without = [each.id for each in looked if each.emulate is None and own_frame(each.url)]
    if without:
        names = ", ".join(without[:4]) + (", ..." if len(without) > 4 else "")
        verb = "knows its" if len(without) == 1 else "know their"
        raise ConfigError(
            f"{names} {verb} position from satellites, each from where it was switched on: the swarm shares no frame",
            where="the fleet file",
            hint="write [world] origin = [latitude, longitude] in degrees: where on earth the swarm's (0, 0) is",
        )
