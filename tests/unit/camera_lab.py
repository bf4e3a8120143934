"""A simulated camera above a small floor, calibrated once per process: what tests of `fullswarm track` look through."""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping

import numpy as np

from fullswarm.config import SwarmConfig
from fullswarm.localization.camera.calibrate import LensCalibration, floor_from_tags, lens_part
from fullswarm.localization.camera.camera_file import CameraFile
from fullswarm.localization.camera.finder import Grey
from fullswarm.localization.camera.plan import TagPlan, plan_of
from fullswarm.localization.camera.rehearsal import RobotsInPictures, SimulatedCamera, board_views
from fullswarm.localization.camera.tracker import Tracker

WIDTH_M, DEPTH_M = 4.0, 2.25
PICTURE = SimulatedCamera(width=1280, high=720, focal_px=740.0, seed=4)
SIZE = (1280, 720)
Poses = Mapping[str, tuple[float, float, float]]


def fleet(robots: int = 8) -> SwarmConfig:
    places = [(x, y) for y in (0.1, DEPTH_M - 0.1) for x in (0.1, WIDTH_M / 2.0, WIDTH_M - 0.1)]
    return SwarmConfig.model_validate(
        {
            "world": {"bounds_m": [0, 0, WIDTH_M, DEPTH_M], "engine": "kinematic"},
            "tags": {"floor": [[501 + n, x, y, 0.0] for n, (x, y) in enumerate(places)]},
            "robot": [{"id": f"r{n}"} for n in range(1, robots + 1)],
        }
    )


@functools.cache
def board_pictures() -> tuple[Grey, ...]:
    return tuple(board_views(PICTURE, 20))


@functools.cache
def lens_file() -> CameraFile:
    lens = LensCalibration()
    for grey in board_pictures():
        lens.add(grey, "test")
    return CameraFile(name="ceiling", lens=lens_part(lens.lens("test")))


@functools.cache
def pictures() -> RobotsInPictures:
    return RobotsInPictures(PICTURE, fleet(), plan_of(fleet()))


@functools.cache
def calibrated() -> CameraFile:
    floor = floor_from_tags(lens_file(), [pictures().picture({}, {})], plan_of(fleet()), "test")
    return lens_file().model_copy(update={"floor": floor})


def tracker(plan: TagPlan | None = None) -> Tracker:
    plan = plan or plan_of(fleet())
    return Tracker(calibrated().optics(SIZE, "test"), plan, calibrated().with_floor_tags(plan))


def in_circles(time_s: float, robots: int = 8) -> dict[str, tuple[float, float, float]]:
    found = {}
    for n in range(robots):
        x, y = 0.6 + (n % 4) * 0.93, 0.65 + (n // 4) * 0.95
        angle = 1.1 * time_s + n
        found[f"r{n + 1}"] = (x + 0.15 * math.cos(angle), y + 0.15 * math.sin(angle), angle + math.pi / 2.0)
    return found


def away_m(pose: tuple[float, float, float], x_m: float, y_m: float) -> float:
    return math.hypot(pose[0] - x_m, pose[1] - y_m)


def turned_rad(pose: tuple[float, float, float], heading_rad: float) -> float:
    return abs(math.remainder(pose[2] - heading_rad, 2.0 * math.pi))


def noise_only(seed: int) -> Grey:
    return np.random.default_rng(seed).integers(0, 256, (SIZE[1], SIZE[0]), np.uint8)
