"""Checks what a fleet file places in its arena: boxes, start poses, bodies; and finds numbers in another unit.

Plain Python: a fleet file is read on board too, where NumPy would take longer to load than the file to check.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from fullswarm.config.suggestions import radians
from fullswarm.errors import did_you_mean

if TYPE_CHECKING:
    from fullswarm.config.models import SwarmConfig

Path = tuple[str | int, ...]
Bounds = tuple[float, float, float, float]
Box = tuple[float, float, float, float, float]

HOW_A_BOX = "write centre x, y, size x, y in m, yaw in rad"
SLACK_M = 1e-6
"""Bodies that just touch do not overlap."""
SAME_PLACE_M = 0.01
"""Of real robots the file knows no size: so near to each other two cannot stand."""
WIDE_M = 5000.0
"""An arena wider than this was probably meant in another unit."""


def arena_problems(config: SwarmConfig) -> Iterator[tuple[Path, str]]:
    """Yield what is wrong: where in the file, and what."""
    yield from _boxes(config)
    yield from _angles(config)
    yield from _bodies(config)
    for index, what in start_problems(config):
        yield ("robot", index, "pose"), what


def oddities(config: SwarmConfig) -> Iterator[tuple[Path, str]]:
    """Yield what is odd but may be meant: where in the file, and what."""
    x_min, y_min, x_max, y_max = config.bounds_m
    wide_m = max(x_max - x_min, y_max - y_min)
    if wide_m > WIDE_M:
        key: Path = ("agent", "bounds_m") if config.agent.bounds_m is not None else ("world", "bounds_m")
        yield key, f"the arena is {wide_m / 1000.0:g} km wide: is it in m?"
    limit, world = config.agent.speed_limit_m_s, config.world
    if limit is not None and world is not None and all(each.simulated for each in config.robot):
        fastest = max((world.of_body(each).speed_limit_m_s for each in config.robots), default=world.speed_limit_m_s)
        if limit > fastest:
            what = f"{limit:g} m/s has no effect: the simulated bodies drive {fastest:g} m/s at most"
            yield ("agent", "speed_limit_m_s"), what
    for group, members in config.groups.items():
        if not members:
            yield ("groups", group), "names no robot"
        elif len(set(members)) < len(members):
            yield ("groups", group), "names a robot twice"


def gap_m(box: Box, x_m: float, y_m: float) -> float:
    """Return the distance from a point to a box; 0 inside."""
    centre_x, centre_y, size_x, size_y, yaw = box
    dx, dy, c, s = x_m - centre_x, y_m - centre_y, math.cos(yaw), math.sin(yaw)
    along, across = abs(dx * c + dy * s) - size_x / 2.0, abs(dy * c - dx * s) - size_y / 2.0
    return math.hypot(max(along, 0.0), max(across, 0.0))


def _text(bounds: Bounds) -> str:
    return f"bounds_m = [{', '.join(f'{each:g}' for each in bounds)}]"


def _inside(bounds: Bounds, x_m: float, y_m: float, beyond_m: float = 0.0) -> bool:
    x_min, y_min, x_max, y_max = bounds
    return x_min - beyond_m < x_m < x_max + beyond_m and y_min - beyond_m < y_m < y_max + beyond_m


def _in_mm(bounds: Bounds, x_m: float, y_m: float) -> bool:
    """Tell whether a place outside would be inside if it was given in mm."""
    return max(abs(x_m), abs(y_m)) >= 100.0 and _inside(bounds, x_m / 1000.0, y_m / 1000.0)


def _boxes(config: SwarmConfig) -> Iterator[tuple[Path, str]]:
    """Report boxes without a size, or wholly outside the arena: a wrong unit or order."""
    world = config.world_or_default
    x_min, y_min, x_max, y_max = world.bounds_m
    for index, (x, y, size_x, size_y, yaw) in enumerate(world.boxes):
        path: Path = ("world", "boxes", index)
        if not (size_x > 0.0 and size_y > 0.0):
            yield path, f"has no size ({size_x:g} by {size_y:g} m): {HOW_A_BOX}"
        cos, sin = abs(math.cos(yaw)), abs(math.sin(yaw))
        reach_x, reach_y = (cos * size_x + sin * size_y) / 2.0, (sin * size_x + cos * size_y) / 2.0
        if x + reach_x <= x_min or x - reach_x >= x_max or y + reach_y <= y_min or y - reach_y >= y_max:
            advice = "if this is in mm, divide all but the yaw by 1000" if _in_mm(world.bounds_m, x, y) else HOW_A_BOX
            yield path, f"lies outside the arena, {_text(world.bounds_m)}: {advice}"


def _angles(config: SwarmConfig) -> Iterator[tuple[Path, str]]:
    """Report angles beyond a whole turn, which were meant in degrees."""
    found: list[tuple[Path, float]] = []
    for index, robot in enumerate(config.robot):
        if robot.pose is not None:
            found.append((("robot", index, "pose", 2), robot.pose[2]))
        found.append((("robot", index, "tag_offset_m", 2), robot.tag_offset_m[2]))
    found += [(("dock", index, "pose", 2), dock.pose[2]) for index, dock in enumerate(config.dock)]
    found += [(("world", "boxes", index, 4), box[4]) for index, box in enumerate(config.world_or_default.boxes)]
    found += [(("tags", "floor", index, 3), place[3]) for index, place in enumerate(config.tags.floor)]
    for path, angle in found:
        if what := radians(angle):
            yield path, what


def _bodies(config: SwarmConfig) -> Iterator[tuple[Path, str]]:
    """Report bodies of no robot, bodies that no arena holds, and a sensing radius within the body itself."""
    world, too_large = config.world_or_default, False
    x_min, y_min, x_max, y_max = world.bounds_m
    side_m = min(x_max - x_min, y_max - y_min)
    bodies: dict[Path, float] = {("world", "radius_m"): world.radius_m}
    for robot, body in world.bodies.items():
        if config.robot and robot not in config.robots:
            yield ("world", "bodies", robot), f"no robot '{robot}' in this file, {did_you_mean(robot, config.robots)}"
        elif body.radius_m is not None:
            bodies["world", "bodies", robot, "radius_m"] = body.radius_m
    for path, radius_m in bodies.items():
        if 2.0 * radius_m >= side_m:
            arena = f"an arena of {x_max - x_min:g} by {y_max - y_min:g} m"
            yield path, f"a body of {radius_m:g} m radius does not fit into {arena}: are both in m?"
            too_large = True
    if (
        not too_large
        and any(each.simulated for each in config.robot)
        and config.agent.sensing_radius_m <= world.radius_m
    ):
        what = f"{config.agent.sensing_radius_m:g} m ends within the robot itself, whose radius is {world.radius_m:g} m"
        yield ("agent", "sensing_radius_m"), f"{what}: is it in m?"


def start_problems(config: SwarmConfig) -> Iterator[tuple[int, str]]:
    """Yield (index of the robot, what is wrong with its start pose): outside, in a box or wall, in another robot.

    A simulated robot is a disc of its body's radius; of a real one the file knows no size, and its centre counts.
    """
    world = config.world_or_default
    placed: list[tuple[float, float, int, float]] = []
    for index, robot in enumerate(config.robot):
        if robot.pose is None:
            continue
        x_m, y_m, _ = robot.pose
        radius_m = world.of_body(robot.id).radius_m if robot.simulated else 0.0
        placed.append((x_m, y_m, index, radius_m))
        what = _misplaced(config, robot.id, x_m, y_m, radius_m, simulated=robot.simulated)
        if what:
            yield index, what
    yield from _overlaps(config, placed)


def _misplaced(config: SwarmConfig, robot: str, x_m: float, y_m: float, radius_m: float, *, simulated: bool) -> str:
    """Return why a robot cannot start at a place, whatever the others do; empty: nothing is known against it."""
    world, here = config.world_or_default, f"{robot} at ({x_m:.2f}, {y_m:.2f})"
    walled = simulated and world.walls
    bounds = world.bounds_m if walled else config.bounds_m
    if not _inside(bounds, x_m, y_m, 0.0 if walled else max(0.0, config.agent.fence_margin_m) + SLACK_M):
        advice = (
            f": if this is in mm, write [{x_m / 1000.0:g}, {y_m / 1000.0:g}, ...]" if _in_mm(bounds, x_m, y_m) else ""
        )
        return f"{here} lies outside the arena, {_text(bounds)}{advice}"
    if config.world is None:
        return ""
    for index, box in enumerate(world.boxes):
        if abs(x_m - box[0]) + abs(y_m - box[1]) > box[2] + box[3] + 2.0 * radius_m:
            continue  # far away: a map has thousands of boxes
        if gap_m(box, x_m, y_m) < radius_m - SLACK_M or (radius_m == 0.0 and gap_m(box, x_m, y_m) == 0.0):
            return f"{here} overlaps box {index}, {list(box)}"
    x_min, y_min, x_max, y_max = world.bounds_m
    if walled and min(x_m - x_min, y_m - y_min, x_max - x_m, y_max - y_m) < radius_m - SLACK_M:
        return f"{here} overlaps a wall: its radius is {radius_m:g} m, {_text(world.bounds_m)}"
    return ""


def _overlaps(config: SwarmConfig, placed: list[tuple[float, float, int, float]]) -> Iterator[tuple[int, str]]:
    """Report robots that start in one another, each pair at the first of them in the file."""
    placed = sorted(placed)
    reach_m = 2.0 * max((radius_m for *_, radius_m in placed), default=0.0) + SAME_PLACE_M
    for place, (x_m, y_m, index, radius_m) in enumerate(placed):
        for other_x, other_y, other, other_radius_m in placed[place + 1 :]:
            if other_x - x_m > reach_m:
                break
            apart_m = math.hypot(other_x - x_m, other_y - y_m)
            if apart_m < max(radius_m + other_radius_m, SAME_PLACE_M) - SLACK_M:
                first, second = sorted((index, other))
                names = f"{config.robot[first].id} and {config.robot[second].id}"
                need = f": their radii need {radius_m + other_radius_m:.2f} m" if radius_m + other_radius_m else ""
                yield first, f"{names} overlap, {apart_m:.2f} m apart{need}"
