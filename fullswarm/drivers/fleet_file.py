"""Loads a fleet file and checks what only the drivers know: schemes of URLs, shared ports, and frames of positions.

A driver that senses its own position counts from where the robot was switched on (``own_frame`` in its description);
the option ``origin=latitude,longitude`` of its URL puts its poses into the swarm's frame. The fleet file's origin is
added to the URL here.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

from fullswarm import registry
from fullswarm.config import RobotConfig, SwarmConfig, load_swarm
from fullswarm.drivers.base import Description
from fullswarm.drivers.make import Claim, Make, Model, emulated, make_of, makes
from fullswarm.drivers.ranges import parse_url
from fullswarm.drivers.tof.settings import SCHEME
from fullswarm.errors import ConfigError, FullswarmError, nearest, without_login
from fullswarm.output import warning


def load_fleet(path: Path | str, overrides: Iterable[str] = (), *, here: bool = False) -> SwarmConfig:
    """Read and check a fleet file as `load_swarm` does, and its robots' drivers as well.

    Parameters
    ----------
    here : the agents will run on this computer, but for those with a `host` of their own: there is at least one robot,
        and each of them needs a driver that is installed here, takes its URL, and has a port of its own. What is odd
        is printed on stderr. Otherwise only a misspelt scheme is refused.

    Raises
    ------
    ConfigError
        All that is wrong, one line each: ``file:line: key: what``.
    """
    return load_swarm(
        path, overrides, partial(problems, here=here, folder=Path(path).parent), warning if here else None
    )


def problems(config: SwarmConfig, *, here: bool, folder: Path = Path()) -> Iterator[tuple[str, str, str]]:
    """Yield (robot, key, what is wrong); without a robot it is about the file, which is in `folder`."""
    if here and not config.robot:
        yield "", "", "names no robot: write [[robot]] with an id, or [fleet] count = 4"
    words = emulated() if any(robot.emulate for robot in config.robot) else {}
    for robot in config.robot:
        if robot.emulate:
            yield from _emulation_problems(robot, words)
        if what := _driver_problem(robot, here=here):
            yield robot.id, "driver", what
    yield from _range_problems(config)
    if here:
        yield from _missing_files(config, folder)
    taken: dict[tuple[str, ...], str] = {}
    if config.world is not None and any(robot.simulated for robot in config.robot):
        taken["", "the UDP port", config.world.address.rpartition(":")[2]] = "the simulated world (world.address)"
    for robot in config.robot:
        if not robot.driver or not (here or robot.elsewhere):
            continue
        for claim in _claims(robot):
            other = taken.setdefault((robot.host if robot.elsewhere else "", *claim.words), robot.id)
            if other != robot.id:
                yield robot.id, "driver", f"{' '.join(claim.words)} is taken by {other}: {claim.advice}"
                break


def _emulation_problems(robot: RobotConfig, words: Mapping[str, tuple[Make, Model]]) -> Iterator[tuple[str, str, str]]:
    word = robot.emulate or ""
    if word not in words:
        without = next((make for make in makes() if word in (make.name, *make.schemes) and not make.emulation), None)
        why = f"{without.robots} have no emulator" if without is not None else f"no emulated robot '{word}'"
        near = nearest(word, words)
        guess = f"did you mean '{near}'? " if near else ""
        yield robot.id, "emulate", f"{why}, {guess}known: {', '.join(sorted(words))}"
    elif robot.driver and (scheme := urlsplit(robot.driver).scheme) not in words[word][0].schemes:
        schemes = " or ".join(f"{each}:" for each in words[word][0].schemes)
        what = f"'{word}' is emulated behind {schemes}, not {scheme or robot.driver}: leave the driver out"
        yield robot.id, "driver", what


def _driver_problem(robot: RobotConfig, *, here: bool) -> str:
    """Return why a robot's URL is none that a driver takes; empty: nothing is known against it."""
    scheme, here = urlsplit(robot.url).scheme, here and not robot.elsewhere
    if scheme not in registry.DRIVERS:
        schemes = registry.driver_schemes()
        if scheme not in schemes:
            if not (here or nearest(scheme, schemes)):
                return ""  # of a package that another computer has
            return f"no driver for '{without_login(scheme or robot.url)}', {_meant_url(robot.url, scheme, schemes)}"
    if not here or robot.emulate or scheme == "sim":
        return ""
    try:
        registry.driver_class(robot.url)(robot.url)  # reads the URL, opens nothing
    except FullswarmError as error:
        what = f"{without_login(robot.driver)}: {error.what}" if error.where else error.what
        return f"{what}; {error.hint}" if error.hint else what
    return ""


def _meant_url(url: str, scheme: str, schemes: Sequence[str]) -> str:
    """Return which URL may be meant by one whose scheme has no driver."""
    known = f"known: {', '.join(sorted(schemes))}"
    if not scheme and url.startswith("/"):
        return f"write the make in front of the port: create://{url}; {known}"
    word = (scheme or url).lower()
    make = next((each for each in makes() if word == each.name or word in each.schemes), None)
    if make is not None and make.example:
        return f"did you mean '{make.example}'? {known}"
    near = nearest(word, schemes)
    return f"did you mean '{near}'? {known}" if near else known


def _missing_files(config: SwarmConfig, folder: Path) -> Iterator[tuple[str, str, str]]:
    """Report files and folders that the processes of this computer would miss."""
    store = config.core.store
    if store is not None and not store.absolute().parent.is_dir():
        yield "", "core.store", f"there is no folder {store.absolute().parent}: make it, or name another file"
    for index, camera in enumerate(config.camera):
        if camera.calibration is not None and not (folder / camera.calibration).is_file():
            what = f"there is no file {folder / camera.calibration}: `fullswarm track calibrate` writes it"
            yield "", f"camera.{index}.calibration", what


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
