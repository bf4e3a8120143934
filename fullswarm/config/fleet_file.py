"""Reads and writes fleet files: all errors at once, each with its file, line and key."""

from __future__ import annotations

import re
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import tomlkit
from pydantic import Field, ValidationError

from fullswarm.config.arena import arena_problems, oddities
from fullswarm.config.docks import dock_problems
from fullswarm.config.models import RobotConfig, RobotId, Section, SwarmConfig
from fullswarm.config.toml_errors import (
    KeyPath,
    S,
    dotted,
    explain,
    line_numbers,
    own_errors,
    parse_toml,
    read_toml,
    validated,
)
from fullswarm.errors import ConfigError, FullswarmError, did_you_mean

Table = dict[str, Any]
_PLAIN_WORD = re.compile(r"[^\[\]{}\"'=,\n]+")


class FleetShorthand(Section):
    """``[fleet]``: robots by the number, ``<prefix>1`` to ``<prefix><count>``."""

    count: int = Field(ge=1, le=10_000)
    prefix: RobotId = "r"
    driver: str = "sim"  # a scheme, or a URL with {id} or {n} in it

    def robots(self) -> tuple[RobotConfig, ...]:
        """Return the robots of the shorthand."""
        return tuple(
            RobotConfig(id=f"{self.prefix}{number}", driver=self._url(f"{self.prefix}{number}", number))
            for number in range(1, self.count + 1)
        )

    def _url(self, robot: str, number: int) -> str:
        if "://" not in self.driver:
            return f"{self.driver}://{robot}"
        return self.driver.replace("{id}", robot).replace("{n}", str(number))


Check = Callable[[SwarmConfig], Iterable[tuple[str, str, str]]]
"""What else is wrong with robots: (id, key, what). Without an id the key is one of the file: ``core.store``."""


def load_swarm(
    path: Path | str,
    overrides: Iterable[str] = (),
    check: Check | None = None,
    warn: Callable[[str], None] | None = None,
) -> SwarmConfig:
    """Read a fleet file, apply `overrides` (``a.b=1``, values as in TOML), and check it.

    Parameters
    ----------
    check : more checks, once each value is valid by itself; those that need the drivers are in
        :mod:`fullswarm.drivers.fleet_file`
    warn : called with a line for each thing that is odd, but not wrong

    Raises
    ------
    ConfigError
        All that is wrong, one line each: ``file:line: key: what``; overrides as ``--set key: what``.
    """
    text = read_toml(Path(path), "fleet file")
    document = _Document(str(path), parse_toml(text, str(path)), line_numbers(text))
    for override in overrides:
        document.override(override)
    document.read_map(Path(path).parent)
    config = document.check(check)
    if warn is not None:
        document.warn(config, warn)
    return _with_calibrations(config, Path(path).parent)


def _with_calibrations(config: SwarmConfig, folder: Path) -> SwarmConfig:
    """Return the settings with the cameras' calibrations in the fleet file's folder, from wherever it is read."""
    if not config.camera:
        return config
    cameras = tuple(
        each.model_copy(update={"calibration": folder.absolute() / (each.calibration or f"camera-{each.name}.toml")})
        for each in config.camera
    )
    return config.model_copy(update={"camera": cameras})


def write_swarm(config: SwarmConfig, path: Path) -> None:
    """Write all settings in force, defaults included, as a fleet file that `load_swarm` reads back equal."""
    values = config.model_dump(mode="json", exclude_none=True)
    path.write_text(tomlkit.dumps(values), encoding="utf-8")


class _Document:
    """A parsed file with its lines, the overrides applied to it and the problems so far."""

    def __init__(self, name: str, data: Table, lines: dict[KeyPath, int]) -> None:
        self._name, self._data, self._lines = name, data, lines
        self._overridden: dict[KeyPath, str] = {}
        self._problems: list[tuple[int, str]] = []  # line, text
        self._shorthand = 0  # robots of [fleet], which come before the others

    def override(self, text: str) -> None:
        """Apply ``key=value``; a robot may be named by its id: ``robot.r1.driver=…``."""
        key, equals, raw = text.partition("=")
        parts = [part.strip() for part in key.split(".")]
        label = f"--set {key.strip()}"
        if not equals or not all(parts):
            self._problems.append((0, f"--set {text}: expected key=value, e.g. --set agent.sensing_radius_m=2.5"))
            return
        try:
            value = _toml_value(raw.strip())
        except ValueError:
            self._problems.append((0, f"{label}: '{raw.strip()}' is not a TOML value; text goes in quotes"))
            return
        path = self._write(parts, value)
        if path is None:
            robots = [str(each.get("id")) for each in self._data.get("robot", ()) if isinstance(each, dict)]
            known = f" ({did_you_mean(parts[1], robots)})" if parts[0] == "robot" and len(parts) > 1 else ""
            self._problems.append((0, f"{label}: there is no such place in {self._name}{known}"))
        else:
            self._overridden[path] = label

    def read_map(self, folder: Path) -> None:
        """Put the boxes of the ROS map that [world] names beside its own, and the map's bounds where it has none."""
        world = self._data.get("world")
        name = world.pop("map", None) if isinstance(world, dict) else None
        if name is None or world is None:
            return
        if not isinstance(name, str):
            self._report(("world", "map"), "should be the path of a map's YAML file")
            return
        from fullswarm.maps.ros_map import read_ros_map  # few fleet files name a map, and NumPy loads slowly

        try:
            found = read_ros_map(folder / name)
            boxes = [list(box) for box in found.boxes()]
        except FullswarmError as error:
            self._report(("world", "map"), str(error))
            return
        own = world.get("boxes", [])
        if isinstance(own, list):
            world["boxes"] = [*own, *boxes]
        world.setdefault("bounds_m", [round(each, 6) for each in found.bounds_m])
        world.setdefault("walls", False)

    def _write(self, parts: list[str], value: object) -> KeyPath | None:
        at: Any = self._data
        path: KeyPath = ()
        for position, part in enumerate(parts):
            last = position == len(parts) - 1
            step: str | int | None = part if isinstance(at, dict) else _element(at, part)
            if step is None:
                return None
            path = (*path, step)
            if last:
                at[step] = value
            elif isinstance(at, dict):
                at = at.setdefault(part, {})
            else:
                at = at[step]
        return path

    def check(self, more: Check | None = None) -> SwarmConfig:
        """Return the settings, or raise all problems, sorted by line."""
        data = dict(self._data)
        fleet_table = data.pop("fleet", None)
        config = self._validate(SwarmConfig, data, ())
        if config is not None and config.world is not None and data["world"].keys() == {"origin"}:
            # An origin alone places real robots on earth; it adds no simulated world with its bounds and limits.
            config = config.model_copy(update={"origin": config.world.origin, "world": None})
        fleet = None if fleet_table is None else self._validate(FleetShorthand, fleet_table, ("fleet",))
        shorthand = () if fleet is None else fleet.robots()
        if fleet and fleet.count > 1 and "://" in fleet.driver and not re.search(r"\{(id|n)\}", fleet.driver):
            self._report(("fleet", "driver"), "is the same for every robot: put {id} or {n} into it")
        self._find_duplicates(data.get("robot"), {each.id: "[fleet]" for each in shorthand})
        if config is not None and (fleet is not None or fleet_table is None):
            self._find_unknown_members(config, [each.id for each in (*shorthand, *config.robot)])
        if config is not None and (fleet is not None or fleet_table is None):
            config = self._check_whole(config, shorthand, more)
        if self._problems or config is None:
            lines = dict.fromkeys(text for _, text in sorted(self._problems, key=lambda problem: problem[0]))
            raise ConfigError("\n".join(lines))
        return config

    def _check_whole(self, config: SwarmConfig, shorthand: tuple[RobotConfig, ...], more: Check | None) -> SwarmConfig:
        """Report what is wrong between the parts of a file; return the settings with all its robots."""
        places: dict[str, KeyPath] = {each.id: ("robot", index) for index, each in enumerate(config.robot)}
        config = config.model_copy(update={"robot": shorthand + config.robot}) if shorthand else config
        self._shorthand = len(shorthand)
        for path, what in (*arena_problems(config), *dock_problems(config)):
            self._report(_in_file(path, len(shorthand)), what)
        for robot, key, what in () if more is None else more(config):
            inner = tuple(int(part) if part.isdecimal() else part for part in key.split(".") if part)
            self._report((*places.get(robot, ("fleet",)), *inner) if robot else inner, what)
        return config

    def warn(self, config: SwarmConfig, tell: Callable[[str], None]) -> None:
        """Call `tell` with a line for each oddity of settings without problems."""
        for path, what in oddities(config):
            self._report(_in_file(path, self._shorthand), what)
        for _, text in sorted(self._problems, key=lambda problem: problem[0]):
            tell(text)
        self._problems.clear()

    def _validate(self, schema: type[S], data: object, base: KeyPath) -> S | None:
        try:
            return validated(schema, data)
        except ValidationError as error:
            found = [
                explain(details, schema, () if base else ("fleet",))
                for details in own_errors(error.errors(include_url=False))
            ]
            for path, what in found:
                # A key that is missing because it stands there by another name is one mistake.
                meant = f"did you mean '{path[-1]}'?" if path else ""
                if not any(other[:-1] == path[:-1] and meant in text for other, text in found if other != path):
                    self._report(base + path, what)
            return None

    def _find_duplicates(self, robots: object, taken: dict[str, str]) -> None:
        for index, robot in enumerate(robots if isinstance(robots, list) else ()):
            name = robot.get("id") if isinstance(robot, dict) else None
            if not isinstance(name, str):
                continue
            if name in taken:
                self._report(("robot", index, "id"), f"'{name}' is already taken by {taken[name]}")
            else:
                line = self._lines.get(("robot", index))
                taken[name] = f"the robot in line {line}" if line else f"robot[{index}]"

    def _find_unknown_members(self, config: SwarmConfig, robots: list[str]) -> None:
        """Report groups that name robots missing in the file; a file without robots leaves them to join."""
        for group, members in config.groups.items() if robots else ():
            for index, robot in enumerate(members):
                if robot not in robots:
                    guess = did_you_mean(robot, robots)
                    self._report(("groups", group, index), f"no robot '{robot}' in this file, {guess}")

    def _report(self, path: KeyPath, what: str) -> None:
        """Note `what`, at the override that set the value or at the nearest line of the file."""
        if path[1:2] == (0,) and isinstance(self._data.get(str(path[0])), dict):
            path = (path[0], *path[2:])  # one table where a list of tables may stand
        key = dotted(path)
        if not path:
            self._problems.append((1, f"{self._name}:1: {what}"))
            return
        for length in range(len(path), 0, -1):
            label = self._overridden.get(path[:length])
            if label is not None:
                self._problems.append((0, f"{label}: {what}" if length == len(path) else f"{label}: {key}: {what}"))
                return
            line = self._lines.get(path[:length])
            if line is not None:
                self._problems.append((line, f"{self._name}:{line}: {key}: {what}"))
                return
        inner = (label for place, label in self._overridden.items() if place[: len(path)] == path)
        self._problems.append((0, f"{next(inner, self._name)}: {key}: {what}"))


def _in_file(path: KeyPath, shorthand: int) -> KeyPath:
    """Return where in the file a robot is, after as many of ``[fleet]``, which have nothing of their own."""
    if path[0] != "robot" or not isinstance(path[1], int):
        return path
    return ("robot", path[1] - shorthand, *path[2:]) if path[1] >= shorthand else ("charging", *path[3:])


def _element(container: object, part: str) -> int | None:
    """Return the index of a list's element, given as a number or as a robot's id."""
    if not isinstance(container, list):
        return None
    if part.isdecimal():
        return int(part) if int(part) < len(container) else None
    ids = [each.get("id") if isinstance(each, dict) else None for each in container]
    return ids.index(part) if part in ids else None


def _toml_value(raw: str) -> object:
    """Read a TOML value; a plain word needs no quotes, which a shell would remove."""
    try:
        table = tomllib.loads(f"v = {raw}")
    except tomllib.TOMLDecodeError:
        if _PLAIN_WORD.fullmatch(raw):
            return raw
        raise
    if list(table) != ["v"]:
        raise ValueError(raw)
    return table["v"]
