"""A simulated camera with real processes: emulated Creates that know where they are by its pictures alone."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import pytest

from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.localization.camera import run
from fullswarm.messages import CameraPicture, PoseFix, RobotHealth
from tests.system.live import LiveSwarm

pytest.importorskip("cv2")
SOURCE = "world://?width=960&high=540&focal_px=550"
NEAR_M = 0.03


@pytest.fixture
def swarm(tmp_path: Path) -> Iterator[LiveSwarm]:
    fleet = {
        "agent": {"estimator": "ekf", "fix_timeout_s": 1.0},
        "world": {"engine": "kinematic", "bounds_m": (0.0, 0.0, 3.0, 2.0)},
        "tags": {"floor": ((501, 0.1, 0.1, 0.0), (502, 2.9, 0.1, 0.0), (503, 2.9, 1.9, 0.0), (504, 0.1, 1.9, 0.0))},
        "camera": ({"name": "ceiling", "source": SOURCE, "calibration": tmp_path / "c.toml", "rate_hz": 10.0},),
        "robot": [
            {"id": "r1", "emulate": "create2", "pose": (0.8, 1.0, 0.3)},
            {"id": "r2", "emulate": "create2", "pose": (2.0, 1.0, -2.0)},
        ],
    }
    config = SwarmConfig.model_validate(fleet)
    run.calibrate_lens(config.camera[0], SOURCE, 0.034, 1.0)
    run.calibrate_floor(config, config.camera[0], SOURCE, None, 1.0, 0.034)
    swarm = LiveSwarm(fleet, watch=True)
    yield swarm
    swarm.close()


def health(swarm: LiveSwarm, robot: str) -> RobotHealth:
    found = swarm.row(robot).health
    assert found is not None
    return found


@pytest.mark.alone  # rendering pictures takes a core
def test_creates_drive_by_pictures_alone_and_stop_trusting_a_camera_that_is_gone(swarm: LiveSwarm) -> None:
    robots = ("r1", "r2")
    senders: set[str] = set()
    pictures: list[CameraPicture] = []
    keys = Keys(swarm.config.swarm)
    swarm.bus.subscribe(keys.pose_fix(), PoseFix, lambda fix: senders.add(fix.sensor))
    swarm.bus.subscribe(keys.camera(), CameraPicture, pictures.append)
    swarm.until(
        lambda: all(health(swarm, each).pose_source == "fixes" for each in robots), 40.0, "the camera sees both"
    )
    swarm.request("move_to_goal_bc", {"goal": [1.5, 1.6], "arrive_radius_m": 0.4})
    swarm.rest(4.0)
    assert swarm.node is not None
    world = swarm.node.world
    for robot in robots:
        row = swarm.row(robot)
        x_m, y_m, _ = world.pose[world.row(robot)].tolist()
        assert math.hypot(row.x_m - x_m, row.y_m - y_m) < NEAR_M
    assert senders == {"camera ceiling"}  # the world itself sends none
    assert pictures

    swarm.supervisor.kill("camera-ceiling")
    swarm.until(lambda: all(health(swarm, each).pose_source != "fixes" for each in robots), 10.0, "it is noticed")
    assert "camera ceiling" in health(swarm, "r1").pose_note
    assert "tag 1" in health(swarm, "r1").pose_note
