"""Lists the slots of a fleet file's docks, and checks docks and thresholds of charging."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from fullswarm.config.arena import gap_m
from fullswarm.errors import did_you_mean

if TYPE_CHECKING:
    from fullswarm.config.models import DockConfig, SwarmConfig

Path = tuple[str | int, ...]

FREE_M = 0.005
"""Beyond radius and margin: what the safety filter needs to let a robot move at all."""


@dataclass(frozen=True, slots=True)
class Slot:
    """A place of one robot at a dock. `x_m`, `y_m`, `heading_rad`: of the robot that is docked there."""

    name: str  # the dock's id, with the number of the slot where it has several
    x_m: float
    y_m: float
    heading_rad: float
    approach_m: float
    means: Literal["pose", "own"] = "pose"
    robots: tuple[str, ...] = ()
    makes: tuple[str, ...] = ()

    @property
    def approach(self) -> tuple[float, float]:
        """Where a robot lines up, m."""
        return (
            self.x_m - self.approach_m * math.cos(self.heading_rad),
            self.y_m - self.approach_m * math.sin(self.heading_rad),
        )

    def takes(self, robot: str, make: str, model: str) -> bool:
        """Tell whether a robot may use it."""
        return not (self.robots or self.makes) or robot in self.robots or make in self.makes or model in self.makes


def slots_of(config: SwarmConfig) -> tuple[Slot, ...]:
    """Return the slots of all docks, in the order of the file."""
    return tuple(slot for dock in config.dock for slot in _slots(dock))


def _slots(dock: DockConfig) -> Iterator[Slot]:
    x_m, y_m, heading_rad = dock.pose
    for number in range(dock.slots):
        left_m = number * dock.spacing_m
        yield Slot(
            name=dock.id if dock.slots == 1 else f"{dock.id}.{number + 1}",
            x_m=x_m - left_m * math.sin(heading_rad),
            y_m=y_m + left_m * math.cos(heading_rad),
            heading_rad=heading_rad,
            approach_m=dock.approach_m,
            means=dock.means,
            robots=dock.robots,
            makes=dock.makes,
        )


def dock_problems(config: SwarmConfig) -> Iterator[tuple[Path, str]]:
    """Yield what is wrong with docks and thresholds: where in the file, and what."""
    ids = [dock.id for dock in config.dock]
    for index, dock in enumerate(config.dock):
        where: Path = ("dock", index)
        if dock.id in ids[:index]:
            yield (*where, "id"), f"'{dock.id}' is already taken by dock[{ids.index(dock.id)}]"
        for number, robot in enumerate(dock.robots):
            if config.robot and robot not in config.robots:
                guess = did_you_mean(robot, config.robots)
                yield (*where, "robots", number), f"no robot '{robot}' in this file, {guess}"
        for slot in _slots(dock):
            if what := _misplaced(config, slot):
                yield (*where, "pose"), what
                break
    yield from _too_near(config)
    if config.dock:
        yield from _thresholds(config)


def _too_near(config: SwarmConfig) -> Iterator[tuple[Path, str]]:
    """Report slots in which two robots would touch."""
    radius_m, margin_m = _radius_m(config), config.agent.safety_margin_m
    found = [(index, slot) for index, dock in enumerate(config.dock) for slot in _slots(dock)]
    for place, (index, slot) in enumerate(found):
        for other, before in found[:place]:
            apart_m = math.hypot(slot.x_m - before.x_m, slot.y_m - before.y_m)
            if apart_m < 2.0 * radius_m + margin_m:
                key = "spacing_m" if index == other else "pose"
                what = f"{slot.name} and {before.name} are {apart_m:.2f} m apart, two robots need"
                yield ("dock", index, key), f"{what} {2.0 * radius_m + margin_m:.2f} m"
                break


def _radius_m(config: SwarmConfig) -> float:
    """Return the radius of the largest simulated body; of real robots the file knows none."""
    world = config.world_or_default
    return max((world.of_body(robot).radius_m for robot in config.robots), default=world.radius_m)


def _misplaced(config: SwarmConfig, slot: Slot) -> str:
    """Return why a robot cannot get to a slot; empty: nothing is known against it."""
    x_low, y_low, x_high, y_high = config.bounds_m
    for what, (x_m, y_m) in (("", (slot.x_m, slot.y_m)), ("the approach to ", slot.approach)):
        if not (x_low <= x_m <= x_high and y_low <= y_m <= y_high):
            return f"{what}{slot.name} at {x_m:.2f}, {y_m:.2f} lies outside the arena"
    if config.world is None or slot.means == "own":
        return ""
    need_m = _radius_m(config) + config.agent.safety_margin_m + FREE_M
    for what, (x_m, y_m) in (("", (slot.x_m, slot.y_m)), ("the approach to ", slot.approach)):
        walls = [x_m - x_low, y_m - y_low, x_high - x_m, y_high - y_m] if config.world.walls else []
        free_m = min([*walls, *(gap_m(box, x_m, y_m) for box in config.world.boxes)], default=math.inf)
        if free_m < need_m:
            return (
                f"{what}{slot.name} is {free_m:.2f} m from a wall or a box, and the safety filter lets a robot's "
                f"centre no nearer than {need_m:.3f} m"
            )
    return ""


@dataclass(frozen=True, slots=True)
class Thresholds:
    """At which charges a robot goes and returns, and what it keeps; shares of a full battery."""

    go_at: float
    leave_at: float
    reserve: float


def thresholds_of(config: SwarmConfig, robot: str) -> Thresholds:
    """Return the thresholds of one robot: its own, else the fleet's."""
    fleet = config.charging
    own = next((each.charging for each in config.robot if each.id == robot), None)
    if own is None:
        return Thresholds(fleet.go_at, fleet.leave_at, fleet.reserve)
    return Thresholds(
        fleet.go_at if own.go_at is None else own.go_at,
        fleet.leave_at if own.leave_at is None else own.leave_at,
        fleet.reserve if own.reserve is None else own.reserve,
    )


def _thresholds(config: SwarmConfig) -> Iterator[tuple[Path, str]]:
    """Report thresholds at which no robot could reach a dock, or would leave it before it is charged."""
    low = config.agent.battery_low
    robots = [(("robot", index, "charging"), each.id) for index, each in enumerate(config.robot)]
    for where, robot in [(("charging",), ""), *robots]:
        found = thresholds_of(config, robot)
        if found.reserve <= low:
            text = f"{found.reserve:g} must be above agent.battery_low ({low:g}), at which a robot stands"
            yield (*where, "reserve"), text
        if not found.reserve < found.go_at < found.leave_at:
            order = f"reserve ({found.reserve:g}), go_at ({found.go_at:g}) and leave_at ({found.leave_at:g})"
            yield (*where, "go_at"), f"{order} must rise in this order"
    if config.charging.early_at < config.charging.go_at:
        yield ("charging", "early_at"), f"{config.charging.early_at:g} is below go_at ({config.charging.go_at:g})"
