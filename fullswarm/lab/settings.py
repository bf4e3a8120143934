"""Makes the settings of a laboratory from a fleet file or from plain arguments."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from fullswarm.config import RobotConfig, SwarmConfig
from fullswarm.config.arena import start_problems
from fullswarm.drivers.fleet_file import load_fleet
from fullswarm.errors import ConfigError
from fullswarm.simulation.obstacles import obstacle_gap, static_obstacles, with_trigonometry

USUAL_ENGINE = "kinematic"
"""Of a laboratory without a fleet file: exact, and the fastest."""

START_GAP_M = 0.2
"""Between the rims of robots, and to walls and obstacles, at start places that the seed chooses."""
TRIES = 200
"""Per robot; after that they stand on a grid."""


def from_file(fleet: Path | str | SwarmConfig, settings: Mapping[str, object], seed: int) -> SwarmConfig:
    """Return the settings of a fleet file, with `settings` in place of its own, or a given `SwarmConfig`.

    Raises
    ------
    ConfigError
        All that is wrong, each with its line.
    """
    if isinstance(fleet, SwarmConfig):
        if settings:
            raise ConfigError("gives settings twice", where="Lab", hint="change the SwarmConfig itself")
        return _for_lockstep(fleet, seed)
    overrides = [f"{key}={_toml(value)}" for key, value in settings.items()]
    return _for_lockstep(load_fleet(fleet, tuple(overrides), here=True), seed)


def from_arguments(
    robots: int | Sequence[str] | None,
    starts: Sequence[Sequence[float]] | np.ndarray[Any, Any] | None,
    bounds: Sequence[float] | None,
    obstacles: Iterable[Sequence[float]],
    engine: str | None,
    settings: Mapping[str, object],
    seed: int,
) -> SwarmConfig:
    """Return settings for robots r1, r2, ... or of given names; see :class:`~fullswarm.lab.Lab`.

    Raises
    ------
    ConfigError
        An argument is wrong; names it.
    """
    ids = _ids(robots, starts)
    poses: list[tuple[float, float, float] | None] = (
        _poses(starts, len(ids)) if starts is not None else [None] * len(ids)
    )
    world: dict[str, Any] = {"engine": engine or USUAL_ENGINE, "boxes": [_box(each) for each in obstacles]}
    if bounds is not None:
        world["bounds_m"] = tuple(bounds)
    document: dict[str, Any] = {
        "world": world,
        "robot": [{"id": name, "pose": pose} for name, pose in zip(ids, poses, strict=True)],
    }
    for key, value in settings.items():
        _put(document, key, value)
    try:
        config = SwarmConfig.model_validate(document)
    except ValidationError as error:
        lines = [f"{'.'.join(str(part) for part in each['loc'])}: {each['msg']}" for each in error.errors()]
        raise ConfigError("; ".join(lines), where="Lab") from None
    if starts is None:
        config = config.model_copy(update={"robot": _placed(config, seed)})
    wrong = [what for _, what in start_problems(config)]
    if wrong:
        raise ConfigError(
            "; ".join(wrong), where="starts", hint="robots are discs; start them apart and inside the walls"
        )
    return _for_lockstep(config, seed)


def _placed(config: SwarmConfig, seed: int) -> tuple[RobotConfig, ...]:
    """Return the robots at random free places; where there is no room for that, without: the world makes a grid."""
    places = free_places(config, np.random.default_rng(seed), len(config.robot), apart_m=START_GAP_M)
    if len(places) < len(config.robot):
        return config.robot
    return tuple(robot.model_copy(update={"pose": place}) for robot, place in zip(config.robot, places, strict=True))


def free_places(
    config: SwarmConfig, rng: np.random.Generator, count: int, apart_m: float
) -> list[tuple[float, float, float]]:
    """Return random poses for robots, `apart_m` between their rims, and `START_GAP_M` to walls and obstacles.

    Fewer than `count` where there is no room for them.
    """
    world = config.world_or_default
    obstacles = with_trigonometry(static_obstacles(world))
    x_min, y_min, x_max, y_max = world.bounds_m
    largest_m = max(world.of_body(each).radius_m for each in config.robots)
    apart_m += 2.0 * largest_m
    places: list[tuple[float, float, float]] = []
    for _ in range(TRIES * count):
        if len(places) == count:
            break
        x, y, heading = rng.uniform((x_min, y_min, -math.pi), (x_max, y_max, math.pi)).tolist()
        clear = all(math.hypot(x - other[0], y - other[1]) >= apart_m for other in places) and all(
            obstacle_gap(x, y, obstacles, k)[0] >= largest_m + START_GAP_M for k in range(len(obstacles))
        )
        if clear:
            places.append((x, y, heading))
    return places


def _for_lockstep(config: SwarmConfig, seed: int) -> SwarmConfig:
    """Return the settings with a seed, and without files and the spreading of requests, which processes need."""
    world = config.world_or_default.model_copy(update={"seed": seed})
    core = config.core.model_copy(update={"store": None, "results": None, "schedule_interval_s": 0.0})
    network = config.network.model_copy(update={"seed": seed})
    return config.model_copy(update={"world": world, "core": core, "network": network})


def _ids(robots: int | Sequence[str] | None, starts: Any) -> tuple[str, ...]:
    if robots is None and starts is None:
        raise ConfigError("says neither a fleet file nor how many robots", where="Lab", hint="e.g. Lab(robots=6)")
    if robots is None:
        robots = len(starts)
    if isinstance(robots, int):
        if not 1 <= robots <= 10_000:
            raise ConfigError(f"robots = {robots} is not a number of robots", where="Lab", hint="1 to 10000")
        return tuple(f"r{number}" for number in range(1, robots + 1))
    if isinstance(robots, str):
        raise ConfigError(f"robots = '{robots}' is one name", where="Lab", hint=f"a list of them: ['{robots}']")
    return tuple(robots)


def _poses(starts: Any, count: int) -> list[tuple[float, float, float] | None]:
    try:
        rows = [tuple(float(each) for each in row) for row in starts]
    except (TypeError, ValueError):
        raise ConfigError("starts is not a list of poses", where="Lab", hint="one [x, y, heading] per robot") from None
    wrong = [row for row in rows if len(row) not in (2, 3)]
    if wrong:
        raise ConfigError(f"{list(wrong[0])} is not a start pose", where="starts", hint="[x, y, heading] or [x, y]")
    if len(rows) != count:
        raise ConfigError(f"{len(rows)} start poses for {count} robots", where="starts", hint="one per robot")
    return [(row[0], row[1], row[2] if len(row) == 3 else 0.0) for row in rows]


def _box(box: Sequence[float]) -> tuple[float, ...]:
    if len(box) not in (4, 5):
        raise ConfigError(
            f"{list(box)} is not an obstacle", where="obstacles", hint="[centre x, centre y, size x, size y, yaw]"
        )
    return tuple(float(each) for each in box) if len(box) == 5 else (*(float(each) for each in box), 0.0)


def _put(document: dict[str, Any], key: str, value: object) -> None:
    *path, last = key.split(".")
    table = document
    for name in path:
        table = table.setdefault(name, {})
        if not isinstance(table, dict):
            raise ConfigError(f"'{key}' is no setting", where="settings", hint="e.g. agent.control_rate_hz")
    table[last] = value


def _toml(value: object) -> str:
    """Return a value as ``--set`` reads it."""
    if isinstance(value, bool):
        return str(value).lower()
    return str(list(value)) if isinstance(value, tuple) else str(value)
