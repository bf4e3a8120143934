"""Robots of different sizes, limits and makes in one world, and bodies that are not what their drivers state."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from fullswarm.config import BodyConfig, SwarmConfig, WorldConfig, load_swarm
from fullswarm.config.fleet_file import write_swarm
from fullswarm.drivers.sim.settings import parse_url, url_for
from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment.model import parse_experiment
from fullswarm.evaluate.experiment.plan import Trial, plan, scenario_of
from fullswarm.evaluate.lockstep_swarm import run_trial
from fullswarm.evaluate.trial import configure
from fullswarm.evaluate.trial_folder import launch_text, parse_trial
from fullswarm.simulation.fleet import SimFleet
from fullswarm.simulation.world import World

LARGE = BodyConfig(radius_m=0.34, speed_limit_m_s=1.0, accel_limit_m_s2=1.0, mass_kg=20.0)
SMALL = BodyConfig(radius_m=0.055, speed_limit_m_s=0.2, turn_limit_rad_s=3.6, mass_kg=0.2)
IDS = ("large", "usual", "small")
STARTS = [(2.0, 2.0, 0.0), (2.0, 4.0, 0.0), (2.0, 6.0, 0.0)]


def mixed(engine: str) -> WorldConfig:
    return WorldConfig.model_validate({"engine": engine, "bodies": {"large": LARGE, "small": SMALL}})


def run(world: World, steps: int, twists: list[tuple[float, float]]) -> None:
    for _ in range(steps):
        world.set_twists(np.array(twists))
        world.step()


@pytest.mark.parametrize("engine", ["kinematic", "pybullet", "pybullet-wheels", "drivetrain"])
def test_each_body_has_its_own_limits_and_size(engine: str) -> None:
    world = World(mixed(engine), IDS, STARTS)
    try:
        assert world.radius_m.tolist() == [0.34, 0.17, 0.055]
        run(world, 120, [(9.0, 0.0)] * 3)
        assert world.twist[:, 0] == pytest.approx([1.0, 0.5, 0.2], rel=0.05)
        run(world, 110, [(0.0, 0.0)] * 3)
        before = world.pose[:, 2].copy()
        run(world, 50, [(0.0, 1.0)] * 3)
        assert world.pose[:, 2] - before == pytest.approx([1.0] * 3, abs=0.2)
    finally:
        world.close()


def test_a_driver_in_the_process_and_a_url_state_the_same_of_each_body() -> None:
    config = mixed("kinematic").model_copy(update={"declared_radius_m": 0.1})
    world = World(config, IDS, STARTS)
    fleet = SimFleet(world, lambda: 0.0)
    for robot, description in zip(IDS, fleet.descriptions, strict=True):
        assert parse_url(url_for(config, robot)).description == description
    assert [each.limits.speed_m_s for each in fleet.descriptions] == [1.0, 0.5, 0.2]
    assert SimFleet(world, lambda: 0.0, row=2).descriptions == fleet.descriptions[2:]
    # What drivers state of the size is wrong here; the bodies are as before.
    assert {each.radius_m for each in fleet.descriptions} == {0.1}
    assert world.radius_m.tolist() == [0.34, 0.17, 0.055]


def test_start_poses_fit_the_size_of_each() -> None:
    config = mixed("kinematic")
    World(config, IDS, [(2.0, 2.0, 0.0), (2.52, 2.0, 0.0), (2.75, 2.0, 0.0)]).close()
    with pytest.raises(ConfigError, match="large and usual overlap"):
        World(config, IDS, [(2.0, 2.0, 0.0), (2.5, 2.0, 0.0), (4.0, 2.0, 0.0)])
    with pytest.raises(ConfigError, match=r"large at .* overlaps a wall"):
        World(config, IDS, [(0.3, 2.0, 0.0), (2.5, 2.0, 0.0), (4.0, 2.0, 0.0)])
    placed = World(config, IDS).pose[:, :2]
    apart = [math.dist(placed[i], placed[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert min(apart) >= 0.68


def test_a_fleet_file_gives_a_robot_a_body(tmp_path: Path) -> None:
    file = tmp_path / "fleet.toml"
    file.write_text(
        "[fleet]\ncount = 2\n[world]\nengine = 'drivetrain'\n[world.drivetrain]\nlag_s = 0.2\n"
        "[world.bodies.r2]\nradius_m = 0.3\ndrivetrain = { dead_time_s = 0.15 }\n"
    )
    config = load_swarm(file)
    world = config.world_or_default
    assert (world.of_body("r1").radius_m, world.of_body("r2").radius_m) == (0.17, 0.3)
    assert (world.of_body("r1").drivetrain.lag_s, world.of_body("r2").drivetrain.dead_time_s) == (0.2, 0.15)
    write_swarm(config, tmp_path / "again.toml")
    assert load_swarm(tmp_path / "again.toml") == config


# ---------------------------------------------------------------------------------------------------- experiments
EXPERIMENT = """
name = "mixed"
seeds = "0"
[limits.fast]
speed_limit_m_s = 1.0
turn_limit_rad_s = 3.0
radius_m = 0.3
[limits.slow]
speed_limit_m_s = 0.2
turn_limit_rad_s = 3.0
radius_m = 0.1
declared_radius_m = 0.08
brakes = 0.5
[mixes]
both = ["fast", "slow", "slow"]
[[groups]]
name = "mixed"
behaviours = [{ name = "move_to_goal_bc" }]
scenarios = ["empty_dense"]
robots = [4]
engines = ["kinematic"]
limits = ["both"]
time_limit_s = 1.0
"""


def one_trial() -> tuple[Trial, SwarmConfig]:
    (trial,) = plan(parse_experiment(EXPERIMENT, "mixed.toml"))
    return trial, configure(trial, scenario_of(trial))[0]


def test_robots_of_a_trial_have_the_bodies_of_a_mix_in_turn() -> None:
    _, config = one_trial()
    bodies = [config.world_or_default.of_body(robot) for robot in config.robots]
    assert [each.speed_limit_m_s for each in bodies] == [1.0, 0.2, 0.2, 1.0]
    assert [each.declared_radius_m for each in bodies] == [0.3, 0.08, 0.08, 0.3]
    assert [each.drivetrain.brakes for each in bodies] == [1.0, 0.5, 0.5, 1.0]
    poses = np.array([each.pose for each in config.robot])
    for i, j in ((0, 1), (0, 3), (1, 2)):
        assert math.dist(poses[i, :2], poses[j, :2]) > bodies[i].radius_m + bodies[j].radius_m


def test_the_file_of_a_trial_keeps_its_bodies() -> None:
    trial, _ = one_trial()
    again = parse_trial(launch_text(trial, "mixed"), "trial.toml").trial
    assert (again.bodies, again.body) == (trial.bodies, trial.body)


def test_a_trial_of_a_mix_runs() -> None:
    trial, _ = one_trial()
    result = run_trial(trial)
    assert result.outcome is not None, result.failure
    assert (result.outcome.robots, result.outcome.above_limits) == (4, 0)


def test_limits_that_no_world_accepts_are_named() -> None:
    with pytest.raises(ConfigError, match="brakes"):
        parse_experiment(EXPERIMENT.replace("brakes = 0.5", "brakes = 1.5"), "mixed.toml")
    with pytest.raises(ConfigError, match=r"no \[limits.fsat\]"):
        parse_experiment(EXPERIMENT.replace('["fast", "slow"', '["fsat", "slow"'), "mixed.toml")
