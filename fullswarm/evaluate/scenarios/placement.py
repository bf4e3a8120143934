"""Where boxes and robots stand for a seed. Same scenario, same seed, same places, on every machine."""

from __future__ import annotations

import math

import numpy as np

from fullswarm.config import WorldConfig
from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios.model import MINIMUM_SPACING_M, Box, Door, Scenario
from fullswarm.kernels import Array

CLEARANCE_M = 0.1
"""Free space between a robot and a box or wall at the start."""

GAP_M = 0.06
"""Least free space between two robots at the start: a Create's 0.34 m diameter and this make 0.4 m."""

_TRIES = 2000  # per robot, or for all boxes, before everything is placed anew
_ROUNDS = 10
_BOXES, _ROBOTS, _DOOR = 1, 2, 3  # streams of random numbers: places of boxes and robots must not be related


def boxes_for(scenario: Scenario, seed: int) -> tuple[Box, ...]:
    """Return the fixed boxes and those that `seed` places.

    Random boxes overlap neither one another, nor a fixed one, nor the goal disc.

    Raises
    ------
    ConfigError
        They do not fit into their region, or `seed` is negative.
    """
    wanted = scenario.random_boxes
    if scenario.door is not None:
        scenario = scenario.model_copy(update={"boxes": (*scenario.boxes, *_wall(scenario, scenario.door, seed))})
    if wanted is None:
        return scenario.boxes
    rng = _generator(seed, _BOXES)
    left, low, right, high = wanted.region_m
    size_x, size_y = wanted.size_m
    for _ in range(_ROUNDS):
        placed: list[Box] = []
        for _ in range(_TRIES):
            box = (float(rng.uniform(left, right)), float(rng.uniform(low, high)), size_x, size_y, 0.0)
            if _box_is_free(scenario, placed, box):
                placed.append(box)
                if len(placed) == wanted.count:
                    return (*scenario.boxes, *placed)
    raise ConfigError(
        f"{wanted.count} boxes of {size_x} x {size_y} m do not fit into their region",
        where=f"scenario {scenario.name}: random_boxes",
        hint="fewer or smaller boxes, or a larger region_m",
    )


def _wall(scenario: Scenario, door: Door, seed: int) -> tuple[Box, Box]:
    """Return the two parts of a wall on either side of its door; they reach beyond the arena."""
    rng = _generator(seed, _DOOR)
    x, y = np.array(door.around_m) + rng.uniform(-door.wander_m, door.wander_m, 2)
    yaw = door.yaw_rad + float(rng.uniform(-door.turned_rad, door.turned_rad))
    x_min, y_min, x_max, y_max = scenario.bounds_m
    length_m = math.hypot(x_max - x_min, y_max - y_min)
    off_m = 0.5 * (door.width_m + length_m)
    left, right = (
        (
            float(x - sign * off_m * math.sin(yaw)),
            float(y + sign * off_m * math.cos(yaw)),
            door.thickness_m,
            length_m,
            yaw,
        )
        for sign in (-1.0, 1.0)
    )
    return left, right


def spawn(scenario: Scenario, n: int, seed: int, radius_m: float | Array) -> Array:
    """Return start poses: x, y in metres, heading in [-π, π], shape (n, 3).

    Centres are `spawn.spacing_m` apart at least, more if `radius_m`, of all or (n,), needs it, and robots are clear of
    boxes and walls. The first k poses are the same for every n ≥ k that fits at the first attempt.

    Raises
    ------
    ConfigError
        So many robots do not fit, or `seed` is negative.
    """
    radii_m = np.broadcast_to(np.asarray(radius_m, float), (n,))
    spacing_m = scenario.spawn.spacing_m
    boxes = np.array(boxes_for(scenario, seed), float).reshape(-1, 5)
    if scenario.spawn.shape == "ellipse":
        poses = _on_ellipse(scenario, n)
        clear = all(
            _is_clear(scenario, boxes, pose, radius) for pose, radius in zip(poses, radii_m.tolist(), strict=True)
        )
        if clear and _spaced(poses, radii_m, spacing_m):
            return poses
    else:
        rng = _generator(seed, _ROBOTS)
        for _ in range(_ROUNDS):
            poses = _scatter(scenario, boxes, radii_m, spacing_m, rng)
            if len(poses) == n:
                return poses
    raise ConfigError(
        f"{n} robots of radius {radii_m.max(initial=0.0):g} m, {spacing_m:.2f} m apart, do not fit",
        where=f"scenario {scenario.name}: spawn",
        hint=f"fewer robots, a larger region_m, or a smaller spacing_m ({MINIMUM_SPACING_M} m at least)",
    )


def goals_for(scenario: Scenario, poses: Array) -> Array:
    """Return the point that each robot shall reach within `goal.radius_m`, shape (n, 2), for its start (n, 3)."""
    centre = np.array(scenario.goal.centre_m)
    if scenario.goal.antipodal:
        return np.asarray(2.0 * centre - poses[:, :2])
    return np.tile(centre, (len(poses), 1))


def world_config(scenario: Scenario, seed: int, base: WorldConfig) -> WorldConfig:
    """Return `base` with the scenario's bounds, walls and boxes; all else, the noise's seed too, is kept.

    Raises
    ------
    ConfigError
        The boxes do not fit.
    """
    changes = {
        "bounds_m": scenario.bounds_m,
        "walls": scenario.walls,
        "boxes": boxes_for(scenario, seed),
        "movers": [each.model_dump() for each in scenario.movers],
    }
    return WorldConfig.model_validate({**base.model_dump(), **changes})


def distance_to_box(x_m: float, y_m: float, box: Box | Array) -> float:
    """Return how far a point is from a box in metres; 0 inside."""
    centre_x, centre_y, size_x, size_y, yaw = (float(each) for each in box)
    cos, sin = math.cos(yaw), math.sin(yaw)
    along = cos * (x_m - centre_x) + sin * (y_m - centre_y)
    across = -sin * (x_m - centre_x) + cos * (y_m - centre_y)
    return math.hypot(max(abs(along) - size_x / 2, 0.0), max(abs(across) - size_y / 2, 0.0))


def _generator(seed: int, stream: int) -> np.random.Generator:
    if seed < 0:
        raise ConfigError(f"a seed cannot be negative: {seed}", where="seed")
    return np.random.default_rng([seed, stream])


def _box_is_free(scenario: Scenario, placed: list[Box], box: Box) -> bool:
    x, y, size_x, size_y, _ = box
    if distance_to_box(*scenario.goal.centre_m, box) <= scenario.goal.radius_m:
        return False
    if any(abs(x - other[0]) <= size_x and abs(y - other[1]) <= size_y for other in placed):
        return False
    # A fixed box may be turned: keep the circle around the new one off it.
    half_diagonal = math.hypot(size_x, size_y) / 2
    return all(distance_to_box(x, y, fixed) > half_diagonal for fixed in scenario.boxes)


def _scatter(scenario: Scenario, boxes: Array, radius_m: Array, spacing_m: float, rng: np.random.Generator) -> Array:
    """Place robots one after the other, each at the first free point drawn; fewer than n rows: it got stuck."""
    left, low, right, high = scenario.spawn.region_m
    fixed_heading = scenario.spawn.heading_rad
    n = len(radius_m)
    poses = np.empty((n, 3))
    middle_x, middle_y = scenario.goal.centre_m
    for i in range(n):
        for _ in range(_TRIES):
            x, y, heading = rng.uniform((left, low, -math.pi), (right, high, math.pi))
            if scenario.spawn.mirrored and i % 2:
                x, y = 2.0 * middle_x - x, 2.0 * middle_y - y
            apart = np.hypot(poses[:i, 0] - x, poses[:i, 1] - y)
            far = (apart >= np.maximum(spacing_m, radius_m[:i] + radius_m[i] + GAP_M)).all()
            if far and _is_clear(scenario, boxes, (x, y), float(radius_m[i])):
                poses[i] = x, y, heading if fixed_heading is None else fixed_heading
                break
        else:
            return poses[:i]
    return poses


def _on_ellipse(scenario: Scenario, n: int) -> Array:
    left, low, right, high = scenario.spawn.region_m
    centre_x, centre_y = (left + right) / 2, (low + high) / 2
    angle = 2.0 * math.pi * np.arange(n) / max(n, 1)
    x = centre_x + (right - left) / 2 * np.cos(angle)
    y = centre_y + (high - low) / 2 * np.sin(angle)
    inwards = np.arctan2(centre_y - y, centre_x - x)
    heading = scenario.spawn.heading_rad
    return np.column_stack((x, y, inwards if heading is None else np.full(n, heading)))


def _spaced(poses: Array, radius_m: Array, spacing_m: float) -> bool:
    """Return whether any two robots are `spacing_m` apart, and free of each other."""
    difference = poses[:, None, :2] - poses[None, :, :2]
    apart = np.hypot(difference[..., 0], difference[..., 1])
    np.fill_diagonal(apart, math.inf)
    return bool((apart >= np.maximum(spacing_m, radius_m[:, None] + radius_m + GAP_M)).all())


def _is_clear(scenario: Scenario, boxes: Array, pose: Array | tuple[float, float], radius_m: float) -> bool:
    x, y = float(pose[0]), float(pose[1])
    free_m = radius_m + CLEARANCE_M
    if scenario.walls:
        x_min, y_min, x_max, y_max = scenario.bounds_m
        if min(x - x_min, x_max - x, y - y_min, y_max - y) < free_m:
            return False
    return all(distance_to_box(x, y, box) >= free_m for box in boxes)
