"""Which estimator a robot gets, and what that one needs."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from fullswarm.agent.pose.estimator import EkfEstimator, chosen, estimator_for, unfiltered
from fullswarm.config import SwarmConfig, WorldConfig
from fullswarm.drivers.base import Description, Limits
from fullswarm.drivers.fleet import OneRobot
from fullswarm.drivers.null.driver import NullDriver
from fullswarm.drivers.sim.settings import describe
from fullswarm.simulation.fleet import SimFleet
from fullswarm.simulation.world import World


def test_no_estimator_imports_a_heavy_library() -> None:
    script = "import sys, fullswarm.agent.node; print('filterpy' in sys.modules, 'scipy' in sys.modules)"
    out = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    assert out.split() == ["False", "False"]


CREATE = Limits(0.5, 4.25, 2.0, 20.0)
SENSES, SIM = Description("any", "any", 0.17, CREATE, senses_pose=True), describe(WorldConfig())
NOISY = {"world": {"noise": {"position_m": 0.03}}}


@pytest.mark.parametrize(
    ("file", "description", "expected"),
    [
        ({}, SIM, "direct"),
        (NOISY, SIM, "ekf"),
        ({"world": {"noise": {"heading_rad": 0.01}}}, SIM, "ekf"),
        (NOISY, replace(SENSES, senses_pose=False), "ekf"),
        (NOISY, SENSES, "direct"),
        ({**NOISY, "agent": {"estimator": "direct"}}, SIM, "direct"),
        ({"agent": {"estimator": "ekf"}}, SIM, "ekf"),
    ],
    ids=["exact", "noisy", "noisy heading", "fixes", "autopilot", "direct on request", "ekf on request"],
)
def test_noise_that_nothing_has_filtered_is_filtered(
    file: dict[str, object], description: Description, expected: str
) -> None:
    assert chosen(SwarmConfig.model_validate(file), description) == expected


def test_direct_on_noisy_poses_is_warned_of() -> None:
    noisy = SwarmConfig.model_validate({**NOISY, "agent": {"estimator": "direct"}})
    assert "leave it out" in unfiltered(noisy, [SIM])
    assert not unfiltered(SwarmConfig.model_validate({"agent": {"estimator": "direct"}}), [SIM])
    assert not unfiltered(SwarmConfig.model_validate(NOISY), [SIM])
    assert not unfiltered(noisy, [SENSES])


def test_a_robot_without_pose_needs_no_noise_of_the_world_for_the_filter() -> None:
    fleet = OneRobot("r1", NullDriver("null://r1"))
    config = SwarmConfig.model_validate({"agent": {"estimator": "ekf"}, "world": {}, "robot": [{"id": "r1"}]})
    assert isinstance(estimator_for(config, fleet, np.zeros((1, 3))), EkfEstimator)


@pytest.mark.parametrize("estimator", ["direct", "ekf"])
def test_the_error_that_the_safety_filter_counts_is_declared_or_measured(estimator: str) -> None:
    config = SwarmConfig.model_validate({**NOISY, "agent": {"estimator": estimator}, "robot": [{"id": "r1"}]})
    world = World(config.world_or_default, config.robots)
    fleet = SimFleet(world, lambda: world.time_s)
    fleet.open()
    found = estimator_for(config, fleet, np.zeros((1, 3)))
    for _ in range(100):
        world.step()
        found.update(fleet.read(), 0.02)
    sigma_m = found.sigma[0, 0]
    assert sigma_m == 0.03 if estimator == "direct" else 0.001 < sigma_m < 0.01
    world.close()
