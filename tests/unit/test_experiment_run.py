"""Trials that really run, the referee, worker processes that die, and going on where a run was cut off."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fullswarm.config import WorldConfig
from fullswarm.evaluate.experiment import Outcome, Trial, TrialResult, load_experiment, plan
from fullswarm.evaluate.experiment.pool import Pool
from fullswarm.evaluate.experiment.run import Options, run
from fullswarm.evaluate.lockstep_swarm import run_trial, widened
from fullswarm.evaluate.results.folder import read_records
from fullswarm.evaluate.trial_folder import RESULT_FILE, TRIALS
from fullswarm.evaluate.witness import Referee, Standard, in_safe_set
from fullswarm.simulation.world import World
from tests.unit.experiment_work import answer, misbehave

FILTERS = ("engine=kinematic", "limits=paper", "robots=8", "scenario=empty_dense", "move_to_goal_bc")


def trial(**changes: object) -> Trial:
    (one,) = plan(load_experiment("safety"), (0,), FILTERS)
    cell = {key: value for key, value in changes.items() if hasattr(one.cell, key)}
    rest = {"arena": "", **{key: value for key, value in changes.items() if key not in cell}}
    return replace(one, cell=replace(one.cell, **cell), **rest)  # type: ignore[arg-type]  # names are given by the test


def outcome_of(result: TrialResult) -> Outcome:
    assert result.outcome is not None, result.failure
    return result.outcome


# ---------------------------------------------------------------------------------------------------- referee
def world(*poses: tuple[float, float, float], **changes: object) -> World:
    config = WorldConfig.model_validate({"engine": "kinematic", "bounds_m": (0.0, 0.0, 4.0, 4.0), **changes})
    return World(config, [f"r{row}" for row in range(len(poses))], np.array(poses))


def referee_of(body: World) -> Referee:
    return Referee(body, Standard.of_world(body, body.pose[:, :2].copy(), 0.5))


def drive(body: World, referee: Referee, steps: int, twists: list[list[float]]) -> None:
    for _ in range(steps):
        body.set_twists(np.array(twists))
        body.step()
        referee.sample()


def test_a_meeting_counts_once_for_each_robot() -> None:
    body = world((1.0, 2.0, 0.0), (3.0, 2.0, math.pi))
    referee = referee_of(body)
    drive(body, referee, 250, [[0.5, 0.0], [0.5, 0.0]])
    assert referee.robots.own.events.tolist() == [1, 1]
    assert referee.obstacles.events.tolist() == [0, 0]


def test_parting_and_meeting_again_counts_again() -> None:
    body = world((1.0, 2.0, 0.0), (3.0, 2.0, math.pi))
    referee = referee_of(body)
    drive(body, referee, 150, [[0.5, 0.0], [0.5, 0.0]])
    drive(body, referee, 60, [[-0.3, 0.0], [0.0, 0.0]])
    drive(body, referee, 60, [[0.5, 0.0], [0.0, 0.0]])
    assert referee.robots.own.events.tolist() == [2, 2]


def test_walls_and_boxes_count_apart() -> None:
    body = world((1.0, 1.0, 0.0), (1.0, 3.0, 0.0), boxes=[(2.0, 1.0, 0.5, 0.5, 0.0)])
    referee = referee_of(body)
    drive(body, referee, 400, [[0.5, 0.0], [0.5, 0.0]])
    assert referee.robots.own.events.tolist() == [0, 0]
    assert referee.obstacles.events.tolist() == [1, 1]


def test_commands_above_the_limits_are_seen() -> None:
    body = world((1.0, 1.0, 0.0), (1.0, 3.0, 0.0))
    limits = body.descriptions[0].limits
    for row in range(2):
        body.set_limits(row, widened(limits))
    referee = referee_of(body)
    drive(body, referee, 3, [[limits.speed_m_s, -limits.turn_rad_s], [0.0, 0.0]])
    assert referee.above_limits == 0
    drive(body, referee, 2, [[limits.speed_m_s + 1e-3, 0.0], [0.0, limits.turn_rad_s + 1e-3]])
    assert referee.above_limits == 4


@pytest.mark.parametrize(
    ("second", "safe"),
    [
        ((1.38, 2.0, 0.0), True),  # 0.34 + 0.03 is the least
        ((1.36, 2.0, 0.0), False),
        ((3.79, 2.0, 0.0), True),
        ((3.81, 2.0, 0.0), False),
        ((3.0, 3.29, 0.0), True),
        ((3.0, 3.31, 0.0), False),
    ],
)
def test_safe_set(second: tuple[float, float, float], safe: bool) -> None:
    body = world((1.0, 2.0, 0.0), second, boxes=[(3.0, 3.75, 0.5, 0.5, 0.0)])
    assert in_safe_set(body, 0.03) is safe


# ---------------------------------------------------------------------------------------------------- trials
def test_a_trial_ends_when_all_have_arrived() -> None:
    outcome = outcome_of(run_trial(trial()))
    assert (outcome.robots, outcome.arrived, outcome.events, outcome.safe_start) == (8, 8, 0, True)
    assert outcome.above_limits == 0
    assert 4.0 < outcome.simulated_s < 20.0


def test_a_trial_repeats() -> None:
    assert outcome_of(run_trial(trial(seed=3))) == outcome_of(run_trial(trial(seed=3)))


def test_without_the_filter_they_collide() -> None:
    outcome = outcome_of(run_trial(trial(behaviour="move_to_goal")))
    assert outcome.robot_events > 0


def test_the_time_limit_ends_a_trial() -> None:
    outcome = outcome_of(run_trial(trial(time_limit_s=2.0)))
    assert outcome.simulated_s == pytest.approx(2.0)
    assert outcome.arrived < outcome.robots


def test_a_bad_network_and_noise() -> None:
    result = run_trial(trial(network="loss=20%,delay=50ms", noise_m=0.01, robots=4, time_limit_s=3.0))
    assert outcome_of(result).simulated_s == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"behaviour": "move_to_gaol"}, "did you mean"),
        ({"robots": 500}, "do not fit"),
        ({"scenario": "nowhere"}, "no scenario"),
        ({"parameters": (("gain", -1.0),)}, "gain"),
    ],
)
def test_a_trial_that_cannot_run_says_why(changes: dict[str, object], words: str) -> None:
    result = run_trial(trial(**changes))
    assert result.outcome is None
    assert words in result.failure


# ---------------------------------------------------------------------------------------------------- processes
def test_trials_whose_process_dies_or_hangs_fail_alone() -> None:
    trials = [replace(trial(), seed=seed) for seed in range(6)]
    with Pool(2, 3.0, misbehave, retries=1) as pool:
        found = [(one.seed, result) for one, result in pool.run(trials)]
    results = dict(found)
    assert sorted(seed for seed, _ in found) == list(range(6))
    assert {seed for seed, result in results.items() if result.outcome is None} == {1, 2}
    assert "exit code 3 (2 times)" in results[1].failure
    assert "longer than 3 s (2 times)" in results[2].failure
    assert [results[seed].attempts for seed in range(6)] == [1, 2, 2, 2, 1, 1]
    assert [results[seed].lost for seed in range(4)] == [False, True, True, False]


def test_a_run_goes_on_where_it_was_cut_off(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = Options("safety", "0-1", ("group=paper", "empty", "kinematic", "map=given"), jobs=1, folder=tmp_path)
    assert run(options, answer) == 1  # the crowds of 32 collide
    assert "16 of 16 trials, 4 collisions, 0 failed" in capsys.readouterr().err
    kept = sorted((tmp_path / TRIALS).iterdir())
    assert len(kept) == 16
    for each in kept[:5]:
        shutil.rmtree(each)
    (kept[5] / RESULT_FILE).write_bytes((kept[5] / RESULT_FILE).read_bytes()[:40])
    assert run(replace(options, as_json=True), answer) == 1
    out, err = capsys.readouterr()
    assert "10 of 16 trials are in" in err
    assert "6 of 6 trials" in err
    document = json.loads(out)
    assert (document["trials_done"], document["trials_failed"], len(document["cells"])) == (16, 0, 8)
    assert [each["collisions"] for each in document["cells"]] == [0, 0, 0, 2] * 2
    assert sorted((tmp_path / TRIALS).iterdir()) == kept
    assert len(read_records(tmp_path)) == 16


def test_the_table_names_who_collided(capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        run(Options("safety", "1", ("group=paper", "empty", "kinematic", "map=given", "limits=paper"), jobs=1), answer)
        == 1
    )
    out = capsys.readouterr().out
    assert "collided: navigate_bc map=given empty kinematic paper N=32: seeds [1]" in out
    assert "4 trials done, 0 failed, 2 collisions" in out
