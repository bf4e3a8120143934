"""Which trials fit a fleet, what it is told to do before them, and whether it has done it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.config import SwarmConfig
from fullswarm.evaluate.experiment import Trial, load_experiment, plan, scenario_of
from fullswarm.evaluate.fleet_swarm import NEAR_M, NEAR_RAD, choose, drawing, fit, instructions, names, off, starts_of
from fullswarm.evaluate.scenarios import parse_scenario
from fullswarm.evaluate.scenarios.maps import BOX, GOAL
from fullswarm.evaluate.trial import terms

ROOM = """
name = "room"
bounds_m = [0.0, 0.0, 6.0, 3.0]
boxes = [[5.0, 0.5, 1.0, 0.5, 0.0]]
time_limit_s = 20.0
[spawn]
region_m = [0.3, 0.3, 1.5, 2.7]
heading_rad = 0.5
[goal]
centre_m = [4.0, 1.5]
radius_m = 0.8
"""


def trials(*filters: str) -> list[Trial]:
    room = parse_scenario(ROOM, "room").model_dump_json(exclude_none=True)
    found = plan(load_experiment("safety"), (0,), ("behaviour=move_to_goal_bc", *filters))
    return [replace(each, arena=room) for each in found]


def one(**changes: Any) -> Trial:
    first = trials("scenario=empty", "robots=4", "engine=kinematic", "limits=create", "group=paper")[0]
    cell = {name: changes.pop(name) for name in list(changes) if hasattr(first.cell, name)}
    return replace(first, cell=replace(first.cell, **cell), **changes)


def fleet(count: int, driver: str = "create:///dev/nothing{}", **changes: Any) -> SwarmConfig:
    robots = [{"id": f"c{row}", "driver": driver.format(row)} for row in range(count)]
    return SwarmConfig.model_validate({"robot": robots, **changes})


# ---------------------------------------------------------------------------------------------------- which fit
def test_cells_with_more_robots_than_the_fleet_has_are_left_out_with_the_reason() -> None:
    wanted = [one(robots=count) for count in (2, 4, 8)]
    fits, left_out = choose(wanted, fleet(4))
    assert [each.cell.robots for each in fits] == [2, 4]
    assert left_out == {wanted[2].cell: "it needs 8 robots, the fleet file has 4"}


def test_all_seeds_of_a_cell_share_its_fate() -> None:
    fits, left_out = choose([one(seed=seed, robots=count) for count in (2, 3) for seed in range(3)], fleet(2))
    assert [each.seed for each in fits] == [0, 1, 2]
    assert len(left_out) == 1


def test_real_robots_run_a_cell_once_whatever_its_engines_and_simulated_ones_each() -> None:
    wanted = [one(engine=engine, seed=seed) for engine in ("kinematic", "pybullet") for seed in (0, 1)]
    fits, left_out = choose(wanted, fleet(4))
    assert fits == wanted[:2]
    assert left_out == {wanted[2].cell: "real robots have no engine: it is the same as 'kinematic'"}
    assert choose(wanted, fleet(4, "sim://c{}")) == (wanted, {})


def test_noise_of_simulated_sensors_is_not_for_real_robots() -> None:
    wanted = one(noise_m=0.03)
    assert "simulated sensors" in choose([wanted], fleet(4))[1][wanted.cell]
    assert choose([wanted], fleet(4, "sim://c{}"))[0] == [wanted]


@pytest.mark.parametrize(
    ("fence", "fits"), [((0.0, 0.0, 6.0, 3.0), True), ((0.0, 0.0, 5.9, 3.0), False), ((0.0, 0.1, 6.0, 3.0), False)]
)
def test_an_arena_must_lie_inside_the_fence_of_the_fleet_file(fence: tuple[float, ...], fits: bool) -> None:
    assert bool(choose([one()], fleet(4, agent={"bounds_m": fence}))[0]) is fits


# ---------------------------------------------------------------------------------------------------- settings
def test_the_first_robots_of_the_fleet_get_start_poses_the_boxes_and_the_arena() -> None:
    trial = one(robots=3)
    config, goals = fit(trial, scenario_of(trial), fleet(5, agent={"bounds_m": (-1.0, -1.0, 9.0, 9.0)}))
    assert config.robots == ("c0", "c1", "c2")
    assert [each.driver for each in config.robot] == [f"create:///dev/nothing{row}" for row in range(3)]
    starts = starts_of(config)
    assert np.isfinite(starts).all()
    assert (starts[:, 2] == 0.5).all()
    assert config.world_or_default.boxes == ((5.0, 0.5, 1.0, 0.5, 0.0),)
    assert config.bounds_m == (0.0, 0.0, 6.0, 3.0)
    assert goals.tolist() == [[4.0, 1.5]] * 3


@pytest.mark.parametrize(("ours", "theirs", "holds"), [(0.2, None, 0.2), (0.9, None, 0.5), (None, 0.3, 0.3)])
def test_the_lower_speed_limit_holds(ours: float | None, theirs: float | None, holds: float) -> None:
    agent = () if theirs is None else (("speed_limit_m_s", theirs),)
    trial = one(agent=agent)
    config, _ = fit(trial, scenario_of(trial), fleet(4, agent={"speed_limit_m_s": ours}))
    assert config.agent.speed_limit_m_s == holds


@pytest.mark.parametrize(("ours", "theirs"), [(0.1, 0.05), (0.05, 0.1)])
def test_the_wider_margin_holds(ours: float, theirs: float) -> None:
    trial = one(agent=(("safety_margin_m", theirs),))
    config, _ = fit(trial, scenario_of(trial), fleet(4, agent={"safety_margin_m": ours}))
    assert config.agent.safety_margin_m == 0.1


@pytest.mark.parametrize(
    ("stop", "limit_s", "trial_s", "wanted"),
    [
        ((), None, 20.0, "time limit"),
        ((), 7.0, 7.0, "time limit"),
        ((("max_execution_s", 5.0),), None, 5.0, "max_execution_s"),
        ((("max_execution_s", 50.0),), None, 20.0, "time limit"),
    ],
)
def test_the_trial_keeps_the_time_itself(stop: Any, limit_s: float | None, trial_s: float, wanted: str) -> None:
    trial = one(stop=stop, time_limit_s=limit_s)
    scenario = scenario_of(trial)
    config, (found_s, reason) = terms(trial, scenario, fit(trial, scenario, fleet(4))[0])
    assert (found_s, reason) == (trial_s, wanted)
    assert config.performance.max_execution_s is None
    assert config.performance.arrive_radius_m == 0.8


# ---------------------------------------------------------------------------------------------------- instructions
def test_the_instructions_name_every_robot_box_and_whoever_is_spare() -> None:
    trial = one(robots=2)
    scenario = scenario_of(trial)
    config, goals = fit(trial, scenario, fleet(4))
    lines = instructions(config, scenario, goals, ("c2", "c3")).splitlines()
    for name, robot, line in zip("12", config.robot, lines[1:3], strict=True):
        assert robot.pose is not None
        x_m, y_m, heading_rad = robot.pose
        assert line.split() == [name, robot.id, f"{x_m:.2f}", f"{y_m:.2f}", f"{math.degrees(heading_rad):.0f}°"]
    assert "  5.00   0.50   1.00 x  0.50     0°" in "\n".join(lines)
    assert "out of the arena: c2, c3" in lines


def test_the_map_shows_north_up_what_stands_where() -> None:
    trial = one(robots=1)
    scenario = scenario_of(trial)
    config, goals = fit(trial, scenario, fleet(1))
    place = config.robot[0].model_copy(update={"pose": (0.1, 2.9, 0.0)})
    framed = drawing(config.model_copy(update={"robot": (place,)}), scenario, goals)[0].splitlines()
    picture = [line[1:-1] for line in framed[1:-1]]
    assert {len(line) for line in picture} == {64}
    assert len(picture) == 16  # twice as wide as high, and so is a character
    assert picture[0][1] == "1"  # north west
    assert picture[7][43] == GOAL
    assert picture[-3][53] == BOX  # south east
    assert picture[0].count(BOX) == 0


@given(st.floats(0.0, 0.5), st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi))
def test_a_robot_is_in_place_within_the_tolerances(away_m: float, where: float, heading: float, turned: float) -> None:
    start = np.array([[1.0, 2.0, heading]])
    pose = start + np.array([away_m * math.cos(where), away_m * math.sin(where), turned + 2 * math.pi])
    if abs(away_m - NEAR_M) < 1e-6 or abs(abs(turned) - NEAR_RAD) < 1e-6:
        return
    assert bool(off(["r"], pose, start)) is (away_m > NEAR_M or abs(turned) > NEAR_RAD)


def test_whoever_stands_wrong_is_named_and_an_unknown_pose_is_not() -> None:
    poses, starts = np.array([[0.0, 0.0, 0.0], [1.0, 1.5, 0.0], [np.nan] * 3]), np.zeros((3, 3))
    starts[1] = 1.0, 1.0, 1.0
    assert off(("a", "b", "c"), poses, starts) == ["b stands 0.50 m and 57° from its place"]


def test_robots_have_one_letter_each_on_the_map() -> None:
    assert names(3) == ["1", "2", "3"]
    assert len(set(names(61))) == 61
    assert names(62)[-1] == "*"
