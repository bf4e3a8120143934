"""Gives bodies their start poses: a spaced grid for those without one, and a check of all."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from fullswarm.config import WorldConfig
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array
from fullswarm.simulation.obstacles import obstacle_gap, static_obstacles, with_trigonometry

# From robot to robot, and between a rim and whatever stands; 0.6 and 0.05 m for a Create. Tighter only when the arena
# asks for it: a robot must not start within the safety filter's margin, or count as touching.
SPACINGS_RADII = ((3.5, 0.3), (2.6, 0.3), (2.6, 0.0))
JITTER = 0.1  # of the gap between neighbours: breaks the symmetry that deadlocks a swarm
SLACK_M = 1e-6  # bodies that just touch do not overlap


def default_starts(
    config: WorldConfig, n: int, taken: Sequence[Sequence[float]] = (), taken_radius_m: Array | None = None,
    radius_m: float | None = None,
) -> Array:  # fmt: skip
    """Return `n` poses (n, 3) on a grid, from the lower left corner, heading 0.

    The lower left quarter of the arena if it holds them, else all of it. Repeats for the same seed. Poses
    overlap no obstacle and none of the poses in `taken`.

    Parameters
    ----------
    taken_radius_m : (k,) of the robots at `taken`; None: the world's
    radius_m : of the largest of the n robots; None: the world's

    Raises
    ------
    ConfigError
        The arena is too small for them.
    """
    obstacles = with_trigonometry(static_obstacles(config))
    radius_m = config.radius_m if radius_m is None else radius_m
    others_m = np.full(len(taken), config.radius_m) if taken_radius_m is None else taken_radius_m
    x_min, y_min, x_max, y_max = config.bounds_m
    middle = (x_min + x_max) / 2, (y_min + y_max) / 2
    for high_x, high_y in (middle, (x_max, y_max)):
        for spacing_radii, gap_radii in SPACINGS_RADII:
            room_m = (1.0 + gap_radii) * radius_m
            found: list[tuple[float, float, float]] = []
            occupied = np.array([pose[:2] for pose in taken], dtype=float).reshape(-1, 2)
            for x, y in _grid(config, high_x, high_y, spacing_radii * radius_m, radius_m, room_m):
                if len(found) == n:
                    break
                if _free(x, y, room_m, obstacles, occupied, others_m):
                    found.append((x, y, 0.0))
            if len(found) == n:
                return np.array(found, dtype=float).reshape(-1, 3)
    raise ConfigError(
        f"an arena of {x_max - x_min:g} x {y_max - y_min:g} m has no room for {n} robots",
        where="world.bounds_m",
        hint="enlarge it, remove boxes, or give the robots poses",
    )


def _grid(
    config: WorldConfig, high_x: float, high_y: float, spacing: float, radius_m: float, room_m: float
) -> Iterator[tuple[float, float]]:
    rng = np.random.default_rng(config.seed)
    jitter = JITTER * (spacing - 2 * radius_m)
    margin = room_m + jitter + SLACK_M
    x_min, y_min = config.bounds_m[:2]
    for y in np.arange(y_min + margin, high_y - margin, spacing):
        for x in np.arange(x_min + margin, high_x - margin, spacing):
            dx, dy = rng.uniform(-jitter, jitter, 2)
            yield float(x + dx), float(y + dy)


def _free(x: float, y: float, room_m: float, obstacles: Array, occupied: Array, others_m: Array) -> bool:
    if len(occupied) and np.min(np.hypot(occupied[:, 0] - x, occupied[:, 1] - y) - others_m) < room_m:
        return False
    return not any(_overlap_m(x, y, room_m, obstacles, k) > 0.0 for k in range(len(obstacles)))


def _overlap_m(x: float, y: float, radius_m: float, obstacles: Array, k: int) -> float:
    far = obstacles[k, 7] + radius_m
    if (x - obstacles[k, 0]) ** 2 + (y - obstacles[k, 1]) ** 2 > far * far:
        return -1.0
    return radius_m - SLACK_M - obstacle_gap(x, y, obstacles, k)[0]


def fill_starts(
    config: WorldConfig, ids: Sequence[str], starts: Sequence[Sequence[float] | None] | Array | None
) -> Array:
    """Return a start pose per robot (n, 3): the given one, or one of :func:`default_starts`.

    Raises
    ------
    ConfigError
        Poses overlap each other or an obstacle, or lie outside; all of them are named at once.
    """
    given = [None] * len(ids) if starts is None else [None if one is None else list(one) for one in starts]
    if len(given) != len(ids):
        raise ConfigError(f"{len(given)} start poses for {len(ids)} robots")
    taken = [one for one in given if one is not None]
    radii = np.array([config.of_body(robot).radius_m for robot in ids])
    placed = np.array([one is not None for one in given], bool)
    largest_m = float(radii[~placed].max(initial=0.0)) or config.radius_m
    filled = default_starts(config, len(ids) - len(taken), taken, radii[placed], largest_m)
    rest = iter(filled.tolist())
    poses = np.array([next(rest) if one is None else one for one in given], dtype=float).reshape(-1, 3)
    wrong = [what for _, what in pose_errors(config, ids, poses)]
    if wrong:
        sizes = " or ".join(f"{each:g}" for each in sorted(set(radii.tolist())))
        raise ConfigError("; ".join(wrong), where="start poses", hint=f"robots are discs of {sizes} m radius")
    return poses


def pose_errors(config: WorldConfig, ids: Sequence[str], poses: Array) -> Iterator[tuple[str, str]]:
    """Yield (robot, what is wrong with its start pose): not finite, outside, in an obstacle or in another robot."""
    x_min, y_min, x_max, y_max = config.bounds_m
    obstacles = with_trigonometry(static_obstacles(config))
    radius_m = np.array([config.of_body(robot).radius_m for robot in ids])
    for i, (x, y, heading) in enumerate(poses.tolist()):
        if not np.isfinite([x, y, heading]).all():
            yield ids[i], f"{ids[i]}'s pose ({x}, {y}, {heading}) is not finite"
            continue
        if config.walls and not (x_min < x < x_max and y_min < y < y_max):
            yield ids[i], f"{ids[i]} at ({x:.2f}, {y:.2f}) is outside the walls"
            continue
        for k in range(len(obstacles)):
            if _overlap_m(x, y, radius_m[i], obstacles, k) > 0.0:
                what = f"box {k}" if k < len(config.boxes) else "a wall"
                yield ids[i], f"{ids[i]} at ({x:.2f}, {y:.2f}) overlaps {what}"
        apart = np.hypot(poses[i + 1 :, 0] - x, poses[i + 1 :, 1] - y)
        for j in np.flatnonzero(apart < radius_m[i] + radius_m[i + 1 :] - SLACK_M):
            yield ids[i], f"{ids[i]} and {ids[i + 1 + int(j)]} overlap, {apart[j]:.2f} m apart"
