"""Experiment files, their trials, and how results are joined."""

from __future__ import annotations

import io
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest
from rich.console import Console

from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment import (
    Outcome,
    Trial,
    TrialResult,
    experiment_names,
    load_experiment,
    parse_experiment,
    parse_seeds,
    plan,
    scenario_of,
    summarise,
    world_of,
)
from fullswarm.evaluate.experiment.outcomes import closing, table
from fullswarm.evaluate.experiment.plan import differ_by_group
from fullswarm.evaluate.scenarios import load_scenario
from fullswarm.evaluate.trial_folder import trial_id

TEXT = """
name = "mine"
seeds = "3-5"
[limits.slow]
speed_limit_m_s = 0.3
turn_limit_rad_s = 1.0
[[groups]]
name = "first"
behaviours = [{ name = "navigate_bc", parameters = { map = "own" } }, { name = "move_to_goal_bc" }]
scenarios = ["empty", "concave"]
robots = [4, 32]
engines = ["kinematic", "pybullet"]
limits = ["slow"]
[[groups]]
name = "second"
behaviours = [{ name = "formation_bc" }]
scenarios = ["antipodal"]
robots = [8]
engines = ["pybullet-wheels"]
limits = ["slow"]
seeds_at_most = 2
network = "loss=20%"
noise = { position_m = 0.03 }
agent = { safety_margin_m = 0.1 }
time_limit_s = 7.0
[small]
seeds = "9"
robots_at_most = 8
"""


def made() -> list[Trial]:
    return plan(parse_experiment(TEXT, "mine.toml"))


# ---------------------------------------------------------------------------------------------------- seeds
@pytest.mark.parametrize(("text", "seeds"), [("7", (7,)), ("0-3", (0, 1, 2, 3)), ("19-19", (19,))])
def test_seeds(text: str, seeds: tuple[int, ...]) -> None:
    assert parse_seeds(text) == seeds


@pytest.mark.parametrize("text", ["", "a", "-1", "3-", "5-2", "1-2-3", "1.5", " 1"])
def test_wrong_seeds(text: str) -> None:
    with pytest.raises(ValueError, match="seed"):
        parse_seeds(text)


# ---------------------------------------------------------------------------------------------------- files
def test_safety_holds_what_was_asked_for() -> None:
    assert "safety" in experiment_names()
    trials = plan(load_experiment("safety"))
    cells = {trial.cell for trial in trials}
    arenas = {"empty", "empty_dense", "uniform", "concave", "corridor"}
    for engine in ("kinematic", "pybullet"):
        for limits in ("paper", "create"):
            for robots in (4, 8, 16, 32):
                here = {
                    (each.label, each.scenario)
                    for each in cells
                    if (each.engine, each.limits, each.robots, each.network) == (engine, limits, robots, "")
                }
                laws = ["move_to_goal_bc", *(f"navigate_bc map={known}" for known in ("given", "shared", "own"))]
                assert {(law, arena) for law in laws for arena in arenas} | {("formation_bc", "antipodal")} <= here
    full = [each for each in trials if each.cell.group in ("paper", "seen fast", "seen slow", "swap")]
    assert {each.seed for each in full} == set(range(20))
    assert {each.cell.robots for each in trials if each.cell.engine == "pybullet-wheels"} == {4, 8, 16, 32}
    assert any(each.network and each.noise_m == 0.03 for each in cells)
    assert any(each.scenario == "antipodal_table" and each.robots == 10 for each in cells)


def test_small_is_small() -> None:
    safety = load_experiment("safety")
    assert len(plan(safety, small=True)) <= 250
    assert {trial.cell.group for trial in plan(safety, small=True)} >= {"paper", "swap", "table", "bad network"}


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ('scenarios = ["empty", "concave"]', 'scenarios = ["emty"]', 7, "no scenario 'emty'"),
        ('limits = ["slow"]\n[[', 'limits = ["slwo"]\n[[', 0, "did you mean 'slow'"),
        ('network = "loss=20%"', 'network = "losss=20%"', 14, "did you mean 'loss'"),
        ('seeds = "3-5"', 'seeds = "5-3"', 3, "smaller one comes first"),
        ("safety_margin_m = 0.1", "safety_margin_m = -1", 14, "safety_margin_m"),
        ("robots_at_most = 8", 'groups = ["third"]', 0, "'third'"),
        ('name = "second"', 'name = "first"', 0, "'first'"),
        ("turn_limit_rad_s = 1.0", "turn_limit = 1.0", 6, "turn_limit"),
    ],
)
def test_errors_say_what_and_where(old: str, new: str, line: int, words: str) -> None:
    assert old in TEXT
    with pytest.raises(ConfigError) as caught:
        parse_experiment(TEXT.replace(old, new), "mine.toml")
    assert words in str(caught.value)
    assert ("mine.toml:" if line else "mine.toml") in str(caught.value)


def test_unknown_experiment() -> None:
    with pytest.raises(ConfigError, match="did you mean 'safety'"):
        load_experiment("saftey")


def test_own_file(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(TEXT, "utf-8")
    assert load_experiment(tmp_path / "mine.toml").name == "mine"


# ---------------------------------------------------------------------------------------------------- plan
def test_plan_is_the_whole_product_in_order() -> None:
    trials = made()
    assert len(trials) == 2 * 2 * 2 * 2 * 3 + 2
    assert [trial.seed for trial in trials[:4]] == [3, 4, 5, 3]
    assert trials[0].cell.label == "navigate_bc map=own"
    last = trials[-1]
    assert (last.seed, last.time_limit_s, last.agent) == (4, 7.0, (("safety_margin_m", 0.1),))
    world = world_of(last)
    assert (world.engine, world.speed_limit_m_s, world.noise.position_m) == ("pybullet-wheels", 0.3, 0.03)
    assert world.seed == last.seed


def test_plan_takes_other_seeds() -> None:
    trials = plan(parse_experiment(TEXT, "mine.toml"), seeds=(100, 101, 102, 103))
    assert {trial.seed for trial in trials if trial.cell.group == "first"} == {100, 101, 102, 103}
    assert {trial.seed for trial in trials if trial.cell.group == "second"} == {100, 101}


@pytest.mark.parametrize(
    ("cells", "count"),
    [
        (("second",), 1),
        (("map=own",), 8),
        (("engine=pybullet", "robots=32"), 4),
        (("engine=pybullet,robots=32", "concave"), 2),
        (("engine=pybullet*",), 9),
        (("group=f*,navigate_bc",), 8),
    ],
)
def test_filters(cells: tuple[str, ...], count: int) -> None:
    assert len(plan(parse_experiment(TEXT, "mine.toml"), (0,), cells)) == count


@pytest.mark.parametrize(
    ("text", "words"), [("robot=4", "did you mean 'robots'"), ("robots=5", "no cell"), ("x", "no")]
)
def test_filters_that_fit_nothing(text: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        plan(parse_experiment(TEXT, "mine.toml"), None, (text,))


def test_small_leaves_out_crowds_and_slow_engines() -> None:
    trials = plan(parse_experiment(TEXT, "mine.toml"), small=True)
    assert len(trials) == 8
    assert {trial.seed for trial in trials} == {9}
    assert {trial.cell.robots for trial in trials} == {4}


def test_paper_holds_what_the_paper_does() -> None:
    trials = plan(load_experiment("paper"))
    assert len(trials) == 640
    cells = {trial.cell for trial in trials}
    assert {each.engine for each in cells} == {"pybullet"}
    arenas = ("empty", "empty_dense", "uniform", "concave")
    wanted = {
        (law, arena, n) for law in ("move_to_goal", "move_to_goal_bc") for arena in arenas for n in (4, 8, 16, 32)
    }
    assert {(each.behaviour, each.scenario, each.robots) for each in cells} == wanted
    assert {each.behaviour for each in cells if each.collisions_expected} == {"move_to_goal"}
    assert {trial.cell for trial in plan(load_experiment("paper"), small=True)} == cells


def test_another_engine_for_all_groups() -> None:
    experiment = parse_experiment(TEXT, "mine.toml")
    trials = plan(experiment, engine="kinematic")
    assert {trial.cell.engine for trial in trials} == {"kinematic"}
    assert len(trials) == 2 * 2 * 2 * 3 + 2
    assert {trial.cell.engine for trial in plan(experiment, small=True, engine="pybullet-wheels")} == {
        "pybullet-wheels"
    }
    with pytest.raises(ConfigError, match="did you mean 'kinematic'"):
        plan(experiment, engine="kinematik")


def test_a_trial_carries_its_scenario_and_when_to_stop() -> None:
    text = TEXT.replace("time_limit_s = 7.0", "time_limit_s = 7.0\n[groups.stop]\ncoverage_at_least = 0.5")
    trials = plan(parse_experiment(text, "mine.toml"))
    assert (trials[0].stop, trials[-1].stop) == ((), (("coverage_at_least", 0.5),))
    for one in (trials[0], trials[-1]):
        assert scenario_of(one) == load_scenario(one.cell.scenario)


# ---------------------------------------------------------------------------------------------------- results
def outcome(**changes: object) -> Outcome:
    usual = Outcome(robots=4, arrived=4, robot_events=0, obstacle_events=0, safe_start=True, simulated_s=10.0)
    return msgspec.structs.replace(usual, **changes)


def test_results_are_joined_by_cell() -> None:
    trials = made()
    results = [
        TrialResult(seed=5, outcome=outcome(robot_events=2, obstacle_events=1)),
        TrialResult(seed=4, outcome=outcome(arrived=2, simulated_s=60.0)),
        TrialResult(seed=3, outcome=None, failure="it broke"),
    ]
    other = TrialResult(seed=3, outcome=outcome())
    report = summarise([*zip(reversed(trials[:3]), results, strict=True), (trials[3], other)], wall_s=2.0)
    document = json.loads(json.dumps(report.to_json(), allow_nan=False))
    assert (document["trials_done"], document["trials_failed"], document["wall_s"]) == (3, 1, 2.0)
    assert document["simulated_s"] == 80.0
    first, second = document["cells"]
    assert (first["collisions"], first["robot_collisions"], first["obstacle_collisions"]) == (3, 2, 1)
    assert (first["colliding_seeds"], first["late_seeds"], first["seeds"]) == ([5], [4], 3)
    assert (first["arrived_fraction"], first["all_arrived_fraction"]) == (0.75, 0.5)
    assert first["failures"] == ["it broke"]
    assert (first["behaviour"], first["parameters"], first["robots"]) == ("navigate_bc", {"map": "own"}, 4)
    assert (second["collisions"], second["arrived_fraction"], second["mean_arrival_s"]) == (0, 1.0, 10.0)
    assert not report.passed


def test_starts_outside_the_safe_set_are_counted_apart() -> None:
    trials = made()[:2]
    results = [
        TrialResult(seed=3, outcome=outcome(safe_start=False, robot_events=9, arrived=0)),
        TrialResult(seed=4, outcome=outcome()),
    ]
    report = summarise(zip(trials, results, strict=True))
    (cell,) = report.to_json()["cells"]
    assert (cell["collisions"], cell["unsafe_starts"], cell["unsafe_start_collisions"]) == (0, 1, 9)
    assert (cell["arrived_fraction"], cell["seeds"]) == (1.0, 2)
    assert report.passed


def test_expected_collisions_do_not_fail_the_experiment() -> None:
    text = TEXT.replace('{ name = "move_to_goal_bc" }', '{ name = "move_to_goal", collisions_expected = true }')
    trials = plan(parse_experiment(text, "mine.toml"), (0,), ("robots=4,empty,kinematic",))
    assert [each.cell.behaviour for each in trials] == ["navigate_bc", "move_to_goal"]
    bad, good = TrialResult(seed=0, outcome=outcome(robot_events=2)), TrialResult(seed=0, outcome=outcome())
    assert summarise(zip(trials, (good, bad), strict=True)).passed
    assert not summarise(zip(trials, (bad, good), strict=True)).passed
    assert summarise(zip(trials, (good, bad), strict=True)).collisions == 2


def test_nothing_measured_is_no_success() -> None:
    (trial,) = made()[:1]
    report = summarise([(trial, TrialResult(seed=3, outcome=None, failure="x"))])
    (cell,) = report.to_json()["cells"]
    assert (cell["collisions"], cell["arrived_fraction"], cell["mean_arrival_s"]) == (None, None, None)
    assert not report.passed


def test_a_cell_of_which_nothing_counts_is_unknown_and_no_success() -> None:
    first, second = made()[:2]
    apart = TrialResult(seed=3, outcome=outcome(safe_start=False, robot_events=4))
    report = summarise([(first, apart), (replace(second, cell=replace(second.cell, robots=5)), apart)])
    assert not report.passed
    assert all(math.isnan(each.arrived_fraction) for each in report.cells)
    cell = report.to_json()["cells"][0]
    assert [cell[name] for name in ("collisions", "all_arrived_fraction", "longest_s", "deadlocks")] == [None] * 4
    assert cell["unsafe_start_collisions"] == 4
    assert "nothing counted: navigate_bc map=own empty kinematic slow N=4" in closing(report)
    console = Console(width=130, record=True, file=io.StringIO())
    console.print(table(report))
    assert console.export_text().splitlines()[1].split()[-9:] == ["1", *["-"] * 8]


def test_one_trial_that_counts_is_enough() -> None:
    (trial,) = made()[:1]
    found = [TrialResult(seed=3, outcome=outcome(safe_start=False)), TrialResult(seed=4, outcome=outcome())]
    report = summarise([(trial, found[0]), (replace(trial, seed=4), found[1])])
    assert report.passed
    assert report.to_json()["cells"][0]["collisions"] == 0


# ---------------------------------------------------------------------------------------------------- mistakes
@pytest.mark.parametrize(
    ("line", "twice", "words"),
    [
        ("robots = [4, 32]", "robots = [4, 32, 4]", "groups[0].robots: 4 is given twice"),
        ('scenarios = ["empty", "concave"]', 'scenarios = ["empty", "empty"]', "scenarios: 'empty' is given twice"),
        ('["kinematic", "pybullet"]', '["kinematic", "kinematic"]', "engines: 'kinematic' is given twice"),
        ('[{ name = "formation_bc" }]', '[{ name = "formation_bc" }, { name = "formation_bc" }]', "is given twice"),
    ],
)
def test_what_stands_twice_in_a_list_is_refused(line: str, twice: str, words: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(words)):
        parse_experiment(TEXT.replace(line, twice, 1), "mine.toml")


def test_an_error_in_a_group_is_the_only_one() -> None:
    text = TEXT.replace("seeds_at_most = 2", "seeds_at_most = 0")
    with pytest.raises(ConfigError) as caught:
        parse_experiment(text, "mine.toml")
    assert len(str(caught.value).splitlines()) == 1, str(caught.value)
    with pytest.raises(ConfigError, match=r"robots.*at least 1"):
        parse_experiment(TEXT.replace("robots = [8]", "robots = []"), "mine.toml")


@pytest.mark.parametrize("text", ["9223372036854775808", "0-9999999999", "1-" + "9" * 30])
def test_too_large_and_too_many_seeds_are_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"largest seed|seeds: 100000 at most"):
        parse_seeds(text)


def test_a_long_name_makes_no_long_directory() -> None:
    trial = made()[0]
    long = [replace(trial, cell=replace(trial.cell, scenario="deep/" * 60 + name)) for name in "ab"]
    assert all(len(trial_id(each)) < 140 for each in long)
    assert trial_id(long[0]) != trial_id(long[1])


def test_groups_are_told_apart_where_nothing_else_differs() -> None:
    cell = made()[0].cell
    other = replace(cell, group="longer")
    assert differ_by_group([cell, other])
    assert not differ_by_group([cell, replace(other, robots=5)])
    assert not differ_by_group(each.cell for each in plan(load_experiment("paper"), (0,)))
    assert differ_by_group(each.cell for each in plan(load_experiment("safety"), (0,)))  # an estimator, for one
    found = TrialResult(seed=3, outcome=outcome(robot_events=1))
    report = summarise([(replace(made()[0], cell=each), found) for each in (cell, other)])
    assert "collided: longer navigate_bc" in closing(report)
