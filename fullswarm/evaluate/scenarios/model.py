"""Defines what a scenario is, and reads and writes its TOML file: one of the package, by name, or a user's, by path."""

from __future__ import annotations

from collections.abc import Iterable
from importlib import resources
from importlib.resources.abc import Traversable
from pathlib import Path
from typing import Annotated, Literal, Self

import tomlkit
from pydantic import AfterValidator, Field, PositiveFloat, model_validator
from tomlkit.items import Array, Table

from fullswarm.config import MoverConfig, Point, Section
from fullswarm.config.toml_errors import parse_section, read_toml
from fullswarm.errors import ConfigError, did_you_mean


def package_names(folder: Traversable) -> tuple[str, ...]:
    """Return the names of the TOML files in a folder of the package, without their ending."""
    return tuple(sorted(each.name.removesuffix(".toml") for each in folder.iterdir() if each.name.endswith(".toml")))


def read_named(name_or_path: str | Path, folder: Traversable, kind: str) -> tuple[str, str]:
    """Return the text of a file of the package, by its name, or of one by its path; and how to call it in errors.

    Raises
    ------
    ConfigError
        No such file; `kind` names what was looked for.
    """
    text, names = str(name_or_path), package_names(folder)
    if isinstance(name_or_path, str) and text in names:
        return folder.joinpath(f"{text}.toml").read_text("utf-8"), f"{text}.toml"
    if isinstance(name_or_path, str) and not text.endswith(".toml") and "/" not in text:
        raise ConfigError(f"there is no {kind} '{text}'", hint=did_you_mean(text, names))
    try:
        return read_toml(Path(name_or_path), f"{kind} file"), text
    except ConfigError as error:
        hint = f"{error.hint}; or use one by name: {', '.join(names)}"
        raise ConfigError(f"cannot read the {kind}: {error.what}", where=error.where, hint=hint) from None


Box = tuple[float, float, float, float, float]
"""Centre x, y, size x, y in metres, yaw in radians; as in `WorldConfig.boxes`."""

MINIMUM_SPACING_M = 0.4
"""Centres of robots at the start; below it a Create has no room to turn away."""


def _ordered(rectangle: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    x_min, y_min, x_max, y_max = rectangle
    if not (x_max > x_min and y_max > y_min):
        raise ValueError("must be x_min, y_min, x_max, y_max, the minima first")
    return rectangle


def _solid(boxes: tuple[Box, ...]) -> tuple[Box, ...]:
    for number, (_, _, size_x, size_y, _) in enumerate(boxes):
        if not (size_x > 0.0 and size_y > 0.0):
            raise ValueError(f"box {number} needs positive sizes; a box is x, y, size x, size y, yaw")
    return boxes


Rectangle = Annotated[tuple[float, float, float, float], AfterValidator(_ordered)]
"""x_min, y_min, x_max, y_max in metres."""


class Spawn(Section):
    """Where robots stand at the start."""

    region_m: Rectangle
    shape: Literal["rectangle", "ellipse"] = "rectangle"  # ellipse: evenly by angle on the one inside the region
    spacing_m: float = Field(0.6, ge=MINIMUM_SPACING_M)
    heading_rad: float | None = None  # None: uniform at random; on an ellipse: towards its centre
    mirrored: bool = False  # every second robot starts in the region mirrored at the goal's centre: flows that meet


class RandomBoxes(Section):
    """Boxes placed by the seed: centres uniform in the region, clear of each other and of the goal."""

    count: int = Field(ge=1, le=1000)
    size_m: tuple[PositiveFloat, PositiveFloat] = (1.0, 1.0)
    region_m: Rectangle


class Door(Section):
    """A wall across the arena with a door in it; the seed draws the door's place and the wall's angle."""

    width_m: PositiveFloat
    thickness_m: PositiveFloat = 0.2
    around_m: Point  # the door's middle lies within `wander_m` of it, along either axis
    wander_m: float = Field(0.5, ge=0.0, le=100.0)
    yaw_rad: float = 0.0  # of the way through, within `turned_rad`
    turned_rad: float = Field(0.4, ge=0.0, le=3.2)


class Goal(Section):
    """A disc that all robots shall reach; `antipodal`: each its own start mirrored at the centre."""

    centre_m: Point
    radius_m: PositiveFloat
    antipodal: bool = False


class Scenario(Section):
    """An arena with obstacles, a start and a goal; immutable."""

    name: str = Field(min_length=1)
    description: str = ""
    bounds_m: Rectangle
    walls: bool = True
    boxes: Annotated[tuple[Box, ...], AfterValidator(_solid)] = ()
    random_boxes: RandomBoxes | None = None
    door: Door | None = None
    movers: tuple[MoverConfig, ...] = ()  # bodies that no agent commands
    spawn: Spawn
    goal: Goal
    time_limit_s: PositiveFloat = 60.0

    @model_validator(mode="after")
    def _inside(self) -> Self:
        regions = [("spawn", self.spawn.region_m)]
        if self.random_boxes:
            regions.append(("random_boxes", self.random_boxes.region_m))
        x_min, y_min, x_max, y_max = self.bounds_m
        for table, (left, low, right, high) in regions:
            if left < x_min or low < y_min or right > x_max or high > y_max:
                raise ValueError(f"{table}.region_m reaches out of bounds_m")
        x, y = self.goal.centre_m
        if self.spawn.mirrored:
            left, low, right, high = self.spawn.region_m
            if 2 * x - right < x_min or 2 * x - left > x_max or 2 * y - high < y_min or 2 * y - low > y_max:
                raise ValueError("spawn.region_m, mirrored at goal.centre_m, reaches out of bounds_m")
        if not (x_min <= x <= x_max and y_min <= y <= y_max):
            raise ValueError("goal.centre_m lies out of bounds_m")
        return self


def scenario_names() -> tuple[str, ...]:
    """Return the names of the scenarios that come with the package."""
    return package_names(resources.files(__package__))


def load_scenario(name_or_path: str | Path) -> Scenario:
    """Return a scenario of the package by its name, or one from a TOML file.

    Raises
    ------
    ConfigError
        No such scenario or file, or errors in it: all of them at once, with file and line.
    """
    return parse_scenario(*read_named(name_or_path, resources.files(__package__), "scenario"))


def parse_scenario(text: str, where: str) -> Scenario:
    """Return the scenario that TOML `text` describes; `where` names it in errors.

    Raises
    ------
    ConfigError
        Not TOML, or not a scenario.
    """
    return parse_section(text, where, Scenario)


def scenario_to_toml(scenario: Scenario, notes: Iterable[str] = ()) -> str:
    """Return a scenario's file; `notes` become comments at its head."""
    document = tomlkit.document()
    for note in notes:
        # A comment ends at the line's end, and may hold no control character.
        document.add(tomlkit.comment("".join(each if each.isprintable() else " " for each in note)))
    for key, value in scenario.model_dump(exclude={"boxes", "random_boxes", "door", "movers", "spawn", "goal"}).items():
        document.add(key, list(value) if isinstance(value, tuple) else value)
    if scenario.boxes:
        document.add("boxes", _boxes(scenario))
    for key, section in (
        ("random_boxes", scenario.random_boxes),
        ("door", scenario.door),
        ("spawn", scenario.spawn),
        ("goal", scenario.goal),
    ):
        if section is not None:
            document.add(key, _table(section))
    if scenario.movers:
        movers = tomlkit.aot()
        for mover in scenario.movers:
            movers.append(_table(mover))
        document.add("movers", movers)
    return tomlkit.dumps(document)


def _boxes(scenario: Scenario) -> Array:
    boxes = tomlkit.array()
    for box in scenario.boxes:
        boxes.append(list(box))
    return boxes.multiline(True)


def _table(section: Section) -> Table:
    table = tomlkit.table()
    for key, value in section.model_dump(exclude_none=True).items():
        table.add(key, _plain(value))
    return table


def _plain(value: object) -> object:
    return [_plain(each) for each in value] if isinstance(value, tuple) else value
