"""Loads a fleet file and checks what only the drivers know: schemes of URLs, shared ports, and frames of positions.

A driver that senses its own position counts from where the robot was switched on (``own_frame`` in its description);
the option ``origin=latitude,longitude`` of its URL puts its poses into the swarm's frame. The fleet file's origin is
added to the URL here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from fullswarm import registry
from fullswarm.config import RobotConfig, SwarmConfig, load_swarm
from fullswarm.config.fleet_file import Check
from fullswarm.drivers.base import Description
from fullswarm.drivers.make import Claim, emulated, make_of
from fullswarm.drivers.ranges import parse_url
from fullswarm.drivers.tof.settings import SCHEME
from fullswarm.errors import ConfigError, FullswarmError, did_you_mean, nearest


def load_fleet(
    path: Path | str, overrides: Iterable[str] = (), *, here: bool = False, check: Check | None = None
) -> SwarmConfig:
    """Read and check a fleet file as `load_swarm` does, and its robots' drivers as well.

    Parameters
    ----------
    here : the agents will run on this computer, but for those with a `host` of their own: each of them needs a driver
        that is installed here and a port of its own. Otherwise only a misspelt scheme is refused.
    check : yields more that is wrong, as `problems` does; for start poses ``simulation.starts.start_problems``

    Raises
    ------
    ConfigError
        All that is wrong, one line each: ``file:line: key: what``.
    """

    def all_problems(config: SwarmConfig) -> Iterator[tuple[str, str, str]]:
        yield from problems(config, here=here)
        if check is not None:
            yield from check(config)

    return load_swarm(path, overrides, all_problems)


def problems(config: SwarmConfig, *, here: bool) -> Iterator[tuple[str, str, str]]:
    """Yield (robot, key, what is wrong)."""
    schemes: tuple[str, ...] = ()
    words = emulated() if any(robot.emulate for robot in config.robot) else {}
    for robot in config.robot:
        if robot.emulate and robot.emulate not in words:
            yield robot.id, "emulate", f"no emulated robot '{robot.emulate}', {did_you_mean(robot.emulate, words)}"
        scheme = urlsplit(robot.url).scheme
        if scheme in registry.DRIVERS:
            continue
        schemes = schemes or registry.driver_schemes()
        if scheme not in schemes and (nearest(scheme, schemes) or (here and not robot.elsewhere)):
            yield robot.id, "driver", f"no driver for '{scheme or robot.url}', {did_you_mean(scheme, schemes)}"
    yield from _range_problems(config)
    taken: dict[tuple[str, ...], RobotConfig] = {}
    for robot in config.robot:
        if not robot.driver or not (here or robot.elsewhere):
            continue
        for claim in _claims(robot):
            other = taken.setdefault((robot.host if robot.elsewhere else "", *claim.words), robot)
            if other is not robot:
                yield robot.id, "driver", f"{' '.join(claim.words)} is taken by {other.id}: {claim.advice}"
                break


def _range_problems(config: SwarmConfig) -> Iterator[tuple[str, str, str]]:
    taken: dict[tuple[str, str], str] = {}
    for robot in config.robot:
        if not robot.ranges:
            continue
        if robot.simulated:
            yield (
                robot.id,
                "ranges",
                f"a simulated robot has no range sensor on a port: write [world.bodies.{robot.id}] ranges",
            )
            continue
        try:
            settings = parse_url(robot.ranges)
        except ConfigError as error:
            yield robot.id, "ranges", f"{error.what}{f'; {error.hint}' if error.hint else ''}"
            continue
        if config.agent.locate_on_map and urlsplit(robot.ranges).scheme == SCHEME:
            yield robot.id, "ranges", "no place on a map follows from wide beams: agent.locate_on_map needs a lidar"
        other = taken.setdefault((robot.host if robot.elsewhere else "", settings.where), robot.id)
        if other != robot.id:
            yield (
                robot.id,
                "ranges",
                f"{settings.where} is taken by {other}: each robot needs its own range sensor",
            )


def _claims(robot: RobotConfig) -> tuple[Claim, ...]:
    try:
        return make_of(robot.url).claims_of(robot.url, elsewhere=robot.elsewhere)
    except ConfigError:  # no such driver here: reported above, or another computer has it
        return (Claim(("the URL", robot.url)),)


# ---------------------------------------------------------------- frames of positions
OPTION = "origin"


def origin_of(url: str) -> tuple[float, float] | None:
    """Return the latitude and longitude that a URL names; None: none that can be read."""
    words = parse_qs(urlsplit(url).query).get(OPTION, [""])[0].split(",")
    try:
        return float(words[0]), float(words[1])
    except (IndexError, ValueError):
        return None


def in_frame(url: str, origin: tuple[float, float] | None) -> str:
    """Return the URL of a driver that puts its poses into the swarm's frame, where the make needs it."""
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
        return False  # opening it reports what is wrong
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
