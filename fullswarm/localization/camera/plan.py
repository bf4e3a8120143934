"""Which tag is on which robot and where tags lie on the floor: from the fleet file. Pure.

A tag's frame is that of what it is glued on: x to the printed upper edge ("ahead" on the sheet), y to its left.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from fullswarm.config import SwarmConfig
from fullswarm.config.models import LARGEST_TAG
from fullswarm.errors import ConfigError

FIRST_FLOOR_TAG = 501
"""Floor tags that `fullswarm track init` and `sheets` number themselves begin here."""


@dataclass(frozen=True, slots=True)
class RobotTag:
    """A tag on a robot.

    Parameters
    ----------
    size_m : side of its black square
    height_m : above the floor
    offset : x, y in m and turn in rad of the tag on the robot
    """

    tag: int
    robot: str
    size_m: float
    height_m: float
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class FloorTag:
    """A tag on the floor: where its centre is and where its upper edge points. World frame."""

    tag: int
    x_m: float
    y_m: float
    heading_rad: float
    size_m: float


@dataclass(frozen=True, slots=True)
class TagPlan:
    """All tags of a fleet, by number."""

    robots: dict[int, RobotTag]
    floor: dict[int, FloorTag]

    def __iter__(self) -> Iterator[int]:
        """Iterate over the numbers."""
        yield from self.robots
        yield from self.floor

    def size_m(self, tag: int) -> float:
        """Return the side of a tag's black square."""
        return (self.robots.get(tag) or self.floor[tag]).size_m


def plan_of(config: SwarmConfig) -> TagPlan:
    """Return the tags of a fleet file: robot number n of it has tag n unless it states another.

    Raises
    ------
    ConfigError
        Two things have the same tag.
    """
    tags, robots = config.tags, {}
    owner: dict[int, str] = {}

    def take(tag: int, who: str, where: str) -> None:
        if tag in owner:
            raise ConfigError(
                f"tag {tag} is on {owner[tag]} as well", where=where,
                hint="each tag must be unique: give another number (tag = ...), and print the sheets again",
            )  # fmt: skip
        if tag > LARGEST_TAG:
            hint = "state `tag` for the robots beyond"
            raise ConfigError(f"there is no tag {tag}; the last one is {LARGEST_TAG}", where=where, hint=hint)
        owner[tag] = who

    for number, each in enumerate(config.robot, 1):
        tag = number if each.tag is None else each.tag
        take(tag, f"robot {each.id}", f"robot.{each.id}.tag")
        robots[tag] = RobotTag(
            tag,
            each.id,
            each.tag_size_m or tags.size_m,
            tags.height_m if each.tag_height_m is None else each.tag_height_m,
            each.tag_offset_m,
        )
    floor = {}
    for index, (tag, x_m, y_m, heading_rad) in enumerate(tags.floor):
        take(tag, "the floor", f"tags.floor[{index}]")
        floor[tag] = FloorTag(tag, x_m, y_m, heading_rad, tags.floor_size_m)
    return TagPlan(robots, floor)
