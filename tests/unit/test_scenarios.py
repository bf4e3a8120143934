"""Scenarios: the files of the package, their errors, and what a seed makes of them."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.config import NoiseConfig, WorldConfig
from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios import (
    Box,
    Scenario,
    boxes_for,
    distance_to_box,
    goals_for,
    load_scenario,
    parse_scenario,
    scenario_names,
    spawn,
    world_config,
)
from fullswarm.kernels import Array

SHAPELY = pytest.importorskip("shapely")
RADIUS_M = 0.17
SEEDS = st.integers(0, 2**32)

MINIMAL = """
name = "mine"
bounds_m = [0, 0, 5, 5]
[spawn]
region_m = [1, 1, 4, 4]
[goal]
centre_m = [4, 4]
radius_m = 0.5
"""


def closest(poses: Array) -> float:
    apart = np.hypot(*(poses[:, None, :2] - poses[None, :, :2]).transpose(2, 0, 1))
    return float(apart[~np.eye(len(poses), dtype=bool)].min())


def outline(box: Box) -> object:
    x, y, size_x, size_y, yaw = box
    flat = SHAPELY.box(-size_x / 2, -size_y / 2, size_x / 2, size_y / 2)
    return SHAPELY.affinity.translate(SHAPELY.affinity.rotate(flat, yaw, (0, 0), use_radians=True), x, y)


# ---------------------------------------------------------------- files
def test_the_papers_scenarios_are_there() -> None:
    assert {"empty", "empty_dense", "uniform", "concave", "corridor", "antipodal"} <= set(scenario_names())


@pytest.mark.parametrize("name", scenario_names())
def test_each_file_loads_and_is_named_after_itself(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.name == name
    assert scenario.description
    assert load_scenario(name) == scenario
    assert len(spawn(scenario, 4, 0, RADIUS_M)) == 4


@pytest.mark.parametrize(
    ("name", "region", "goal"),
    [
        ("empty", (1, 1, 6, 19), (17, 17)),
        ("empty_dense", (1, 1, 6, 6), (17, 17)),
        ("uniform", (1, 1, 6, 19), (17, 17)),
        ("concave", (1, 1, 6, 19), (18, 18)),
    ],
)
def test_regions_goals_and_time_are_the_papers(
    name: str, region: tuple[float, float, float, float], goal: tuple[float, float]
) -> None:
    scenario = load_scenario(name)
    assert scenario.bounds_m == (0.0, 0.0, 20.0, 20.0)
    assert scenario.spawn.region_m == region
    assert (scenario.goal.centre_m, scenario.goal.radius_m) == (goal, 4)
    assert scenario.time_limit_s == 60


def test_the_concave_map_is_a_closed_u_open_to_the_west() -> None:
    union = SHAPELY.union_all([outline(box) for box in load_scenario("concave").boxes])
    assert union.geom_type == "Polygon"
    assert union.area == pytest.approx(18.0)
    assert union.bounds == (8.5, 5.5, 13.5, 15.5)
    assert not union.intersects(SHAPELY.LineString([(1, 10.5), (12.4, 10.5)]))  # in
    assert union.intersects(SHAPELY.LineString([(1, 10.5), (18, 18)]))  # but not through


@pytest.mark.parametrize("field", ["walls", "name", "boxes"])
def test_a_scenario_cannot_be_changed(field: str) -> None:
    scenario = load_scenario("empty")
    with pytest.raises(ValueError, match="frozen"):
        setattr(scenario, field, None)


def test_a_file_is_read_by_its_path(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(MINIMAL)
    assert load_scenario(path) == load_scenario(str(path)) == parse_scenario(MINIMAL, "x")
    assert load_scenario(path).spawn.spacing_m == 0.6


def test_an_unknown_name_says_which_was_meant() -> None:
    with pytest.raises(ConfigError, match="did you mean 'uniform'"):
        load_scenario("unifrom")


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file") as caught:
        load_scenario(tmp_path / "none.toml")
    assert caught.value.where.endswith("none.toml")


def test_all_errors_come_at_once_with_their_lines() -> None:
    text = MINIMAL.replace("[1, 1, 4, 4]", "[4, 1, 1, 4]\nspacing_m = 0.1").replace("0.5", "-1") + "colour = 3\n"
    with pytest.raises(ConfigError) as caught:
        parse_scenario(text, "mine.toml")
    message = str(caught.value)
    for part in ("mine.toml:5: spawn.region_m", "mine.toml:6: spawn.spacing_m", "mine.toml:9: goal.radius_m"):
        assert part in message
    assert "mine.toml:10: goal.colour" in message


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[1, 1, 4, 4]", "[1, 1, 9, 4]", "spawn.region_m reaches out"),
        ("[4, 4]", "[6, 4]", "goal.centre_m lies out"),
        ("[spawn]", "boxes = [[1, 1, 0, 1, 0]]\n[spawn]", "positive sizes"),
        ("[spawn]", "boxes = [[1, 1, 1, 1]]\n[spawn]", "boxes"),
        ("[spawn]", "walls = 1\n[spawn]", "walls"),
        ("[spawn]", "[spawn", "not valid TOML"),
    ],
)
def test_what_cannot_be_is_refused(old: str, new: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse_scenario(MINIMAL.replace(old, new, 1), "mine.toml")


def test_it_is_plain_data() -> None:
    scenario = load_scenario("uniform")
    assert Scenario.model_validate_json(scenario.model_dump_json()) == scenario
    assert tomllib.loads(MINIMAL)["name"] == parse_scenario(MINIMAL, "x").name


# ---------------------------------------------------------------- spawning
@given(seed=SEEDS, name=st.sampled_from(["empty", "empty_dense", "uniform", "concave", "corridor"]))
@settings(max_examples=60, deadline=None)
def test_robots_never_overlap_anything(seed: int, name: str) -> None:
    scenario = load_scenario(name)
    poses = spawn(scenario, 32, seed, RADIUS_M)
    assert poses.shape == (32, 3)
    assert closest(poses) >= 0.6
    left, low, right, high = scenario.spawn.region_m
    assert np.all((poses[:, 0] >= left) & (poses[:, 0] <= right) & (poses[:, 1] >= low) & (poses[:, 1] <= high))
    assert np.all(np.abs(poses[:, 2]) <= math.pi)
    points = SHAPELY.points(poses[:, :2])
    for box in boxes_for(scenario, seed):
        assert SHAPELY.distance(points, outline(box)).min() >= RADIUS_M + 0.1 - 1e-9


def test_32_robots_fit_into_the_dense_corner_for_the_papers_20_trials() -> None:
    for seed in range(20):
        assert closest(spawn(load_scenario("empty_dense"), 32, seed, RADIUS_M)) >= 0.6


def test_the_seed_decides() -> None:
    scenario = load_scenario("uniform")
    assert spawn(scenario, 8, 7, RADIUS_M).tolist() == spawn(scenario, 8, 7, RADIUS_M).tolist()
    assert spawn(scenario, 8, 7, RADIUS_M).tolist() != spawn(scenario, 8, 8, RADIUS_M).tolist()
    assert boxes_for(scenario, 7) == boxes_for(scenario, 7) != boxes_for(scenario, 8)


def test_a_larger_swarm_starts_with_the_smaller_one() -> None:
    scenario = load_scenario("uniform")
    assert spawn(scenario, 16, 3, RADIUS_M)[:4].tolist() == spawn(scenario, 4, 3, RADIUS_M).tolist()


def test_large_robots_stand_further_apart() -> None:
    assert closest(spawn(load_scenario("empty"), 16, 0, 0.5)) >= 1.06


@pytest.mark.parametrize(("name", "n"), [("empty_dense", 200), ("antipodal_table", 40)], ids=["rectangle", "ellipse"])
def test_too_many_robots_are_refused_with_a_hint(name: str, n: int) -> None:
    with pytest.raises(ConfigError, match="do not fit") as caught:
        spawn(load_scenario(name), n, 0, RADIUS_M)
    assert "fewer robots" in caught.value.hint


def test_a_negative_seed_is_refused() -> None:
    for name in ("empty", "uniform"):
        with pytest.raises(ConfigError, match="seed"):
            spawn(load_scenario(name), 1, -1, RADIUS_M)


def test_none_and_one_robot() -> None:
    for name in ("empty", "antipodal"):
        assert spawn(load_scenario(name), 0, 0, RADIUS_M).shape == (0, 3)
        assert spawn(load_scenario(name), 1, 0, RADIUS_M).shape == (1, 3)


def test_a_given_heading_is_kept() -> None:
    text = MINIMAL.replace("[1, 1, 4, 4]", "[1, 1, 4, 4]\nheading_rad = 0.5")
    assert spawn(parse_scenario(text, "x"), 3, 0, RADIUS_M)[:, 2].tolist() == [0.5] * 3


# ---------------------------------------------------------------- boxes
@given(seed=SEEDS)
@settings(max_examples=40, deadline=None)
def test_random_boxes_overlap_neither_each_other_nor_the_goal(seed: int) -> None:
    scenario = load_scenario("uniform")
    boxes = boxes_for(scenario, seed)
    assert len(boxes) == 20
    shapes = [outline(box) for box in boxes]
    assert SHAPELY.union_all(shapes).area == pytest.approx(20.0)
    goal = SHAPELY.Point(scenario.goal.centre_m)
    assert min(SHAPELY.distance(goal, shapes)) >= scenario.goal.radius_m
    assert all(6 <= x <= 16 and 1 <= y <= 18 for x, y, *_ in boxes)


def test_random_boxes_keep_off_fixed_ones() -> None:
    text = MINIMAL.replace("[spawn]", "boxes = [[2.5, 2.5, 3, 0.2, 0.7]]\n[spawn]")
    text += "[random_boxes]\ncount = 6\nsize_m = [0.4, 0.4]\nregion_m = [0, 0, 5, 5]\n"
    scenario = parse_scenario(text, "x")
    for seed in range(10):
        fixed, *others = [outline(box) for box in boxes_for(scenario, seed)]
        assert len(others) == 6
        assert SHAPELY.distance(fixed, others).min() > 0.0


def test_boxes_that_cannot_fit_are_refused() -> None:
    text = MINIMAL + "[random_boxes]\ncount = 40\nregion_m = [0, 0, 5, 5]\n"
    with pytest.raises(ConfigError, match="do not fit") as caught:
        boxes_for(parse_scenario(text, "x"), 0)
    assert "mine" in caught.value.where


finite = st.floats(-5.0, 5.0)


@given(x=finite, y=finite, box=st.tuples(finite, finite, st.floats(0.1, 4), st.floats(0.1, 4), finite))
@settings(deadline=None)
def test_distance_to_a_box(x: float, y: float, box: Box) -> None:
    expected = float(SHAPELY.distance(SHAPELY.Point(x, y), outline(box)))
    assert distance_to_box(x, y, box) == pytest.approx(expected, abs=1e-9)


# ---------------------------------------------------------------- goals and the world
def test_all_robots_share_a_disc() -> None:
    scenario = load_scenario("empty")
    assert goals_for(scenario, spawn(scenario, 3, 0, RADIUS_M)).tolist() == [[17.0, 17.0]] * 3


@pytest.mark.parametrize("n", [2, 8, 32])
def test_antipodal_robots_change_sides(n: int) -> None:
    scenario = load_scenario("antipodal")
    poses = spawn(scenario, n, 0, RADIUS_M)
    goals = goals_for(scenario, poses)
    assert np.hypot(*(poses[:, :2] - 10.0).T) == pytest.approx([5.0] * n)
    assert np.hypot(*(goals - poses[:, :2]).T) == pytest.approx([10.0] * n)
    ahead = np.column_stack((np.cos(poses[:, 2]), np.sin(poses[:, 2])))
    assert np.einsum("ij,ij->i", ahead, goals - poses[:, :2]) == pytest.approx([10.0] * n)


def test_ten_robots_fit_on_the_table() -> None:
    assert closest(spawn(load_scenario("antipodal_table"), 10, 0, RADIUS_M)) >= 0.4


def test_a_world_takes_arena_and_boxes_and_keeps_the_rest() -> None:
    base = WorldConfig(engine="kinematic", seed=5, boxes=((1, 1, 1, 1, 0),), noise=NoiseConfig(position_m=0.03))
    scenario = load_scenario("uniform")
    world = world_config(scenario, 3, base)
    assert world.boxes == boxes_for(scenario, 3)
    assert world.bounds_m == scenario.bounds_m
    kept = {"engine", "seed", "noise", "radius_m", "address"}
    assert world.model_dump(include=kept) == base.model_dump(include=kept)
    assert base.boxes == ((1, 1, 1, 1, 0),)


def test_walls_follow_the_scenario() -> None:
    scenario = parse_scenario(MINIMAL.replace("[spawn]", "walls = false\n[spawn]"), "x")
    assert world_config(scenario, 0, WorldConfig()).walls is False
