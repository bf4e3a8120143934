"""Comparing trials in pairs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import msgspec
import pytest

from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment import Trial
from fullswarm.evaluate.results.compare import Comparison, MetricComparison, compare, compare_by
from fullswarm.evaluate.trial_folder import trial_id
from tests.unit.results_fixture import a_record, a_trial, write_folder, write_trial


def metric(found: Comparison, source: str, name: str) -> MetricComparison:
    return next(each for each in found.overall if (each.source, each.name) == (source, name))


def with_parameter(trial: Trial, name: str, value: str) -> Trial:
    return replace(trial, cell=replace(trial.cell, parameters=((name, value),)))


def test_two_behaviours_of_one_folder_are_paired_by_seed(tmp_path: Path) -> None:
    write_folder(tmp_path)
    found = compare_by(tmp_path, "behaviour", "move_to_goal", "move_to_goal_bc")
    assert (found.pairs, found.alone_a, found.alone_b) == (15, 1, 1)  # the failed one and its partner
    events = metric(found, "outcome", "events").result
    assert (events.less, events.equal, events.more) == (15, 0, 0)
    assert events.mean_b == 0.0
    assert events.high < 0.0
    assert metric(found, "truth", "work.total_m").unit == "m"
    assert metric(found, "truth", "work.total_m").result.equal == 15
    cells = {each.cell for each in found.cells}
    assert len(cells) == 4
    assert "concave N=4 kinematic paper" in cells
    assert json.dumps(found.to_json(), allow_nan=False)


def test_two_folders_pair_the_same_trials(tmp_path: Path) -> None:
    first, second = write_folder(tmp_path / "a", seeds=2), tmp_path / "b"
    write_trial(second, a_trial("move_to_goal", "uniform", 8, 0))
    write_trial(second, a_trial("move_to_goal", "uniform", 8, 7))
    found = compare(first, second)
    assert (found.pairs, found.alone_a, found.alone_b) == (1, 15, 1)
    assert all(each.result.mean_difference == 0.0 for each in found.overall)


def test_folders_with_one_behaviour_each_are_compared_across(tmp_path: Path) -> None:
    write_folder(tmp_path / "a", behaviours=("rendezvous",), seeds=3)
    write_folder(tmp_path / "b", behaviours=("rendezvous_bc",), seeds=3)
    found = compare(tmp_path / "a", tmp_path / "b")
    assert found.pairs == 11
    assert metric(found, "outcome", "robot_events").result.mean_difference < 0.0


def test_engines_are_compared_within_a_behaviour(tmp_path: Path) -> None:
    for engine in ("kinematic", "pybullet"):
        for seed in range(2):
            write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, seed, engine))
    found = compare_by(tmp_path, "engine", "kinematic", "pybullet")
    assert found.pairs == 2


def test_an_ambiguous_behaviour_wants_its_parameters(tmp_path: Path) -> None:
    write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    for value in ("own", "given"):
        write_trial(tmp_path, with_parameter(a_trial("navigate", "empty", 4, 0), "map", value))
    with pytest.raises(ConfigError, match="several trials"):
        compare_by(tmp_path, "behaviour", "move_to_goal", "navigate")
    assert compare_by(tmp_path, "behaviour", "navigate map=own", "navigate map=given").pairs == 1


def in_group(trial: Trial, group: str) -> Trial:
    return replace(trial, cell=replace(trial.cell, group=group), agent=(("safety_margin_m", len(group) / 100.0),))


def test_groups_that_differ_by_nothing_else_are_kept_apart(tmp_path: Path) -> None:
    for behaviour in ("move_to_goal", "move_to_goal_bc"):
        for group in ("near", "far"):
            for seed in range(2):
                write_trial(tmp_path, in_group(a_trial(behaviour, "empty", 4, seed), group))
    found = compare_by(tmp_path, "behaviour", "move_to_goal", "move_to_goal_bc")
    assert found.pairs == 4
    assert {each.cell for each in found.cells} == {"empty N=4 kinematic paper near", "empty N=4 kinematic paper far"}
    assert compare_by(tmp_path, "group", "near", "far").pairs == 4
    assert compare(tmp_path, tmp_path).pairs == 8


def test_names_of_groups_keep_nobody_apart_elsewhere(tmp_path: Path) -> None:
    write_trial(tmp_path / "a", in_group(a_trial("move_to_goal", "empty", 4, 0), "near"))
    write_trial(tmp_path / "b", in_group(a_trial("move_to_goal", "empty", 4, 0), "far"))
    assert compare(tmp_path / "a", tmp_path / "b").pairs == 1


def test_trials_that_began_outside_the_safe_set_are_left_out(tmp_path: Path) -> None:
    for behaviour in ("move_to_goal", "move_to_goal_bc"):
        for seed in range(2):
            trial = a_trial(behaviour, "empty", 4, seed)
            record = a_record(trial)
            if seed == 1 and record.outcome:
                outcome = msgspec.structs.replace(record.outcome, safe_start=False)
                record = msgspec.structs.replace(record, outcome=outcome, id=trial_id(trial))
            write_trial(tmp_path, trial, record=record)
    assert compare_by(tmp_path, "behaviour", "move_to_goal", "move_to_goal_bc").pairs == 1


def test_what_cannot_be_compared_is_said(tmp_path: Path) -> None:
    write_folder(tmp_path / "a", seeds=1)
    write_trial(tmp_path / "b", a_trial("move_to_goal", "empty", 4, 0))
    with pytest.raises(ConfigError, match="has a partner"):
        compare(tmp_path / "a", tmp_path / "b")
    with pytest.raises(ConfigError, match="cannot be compared by"):
        compare_by(tmp_path / "a", "colour", "red", "blue")
    with pytest.raises(ConfigError, match=r"did you mean 'move_to_goal_bc'"):
        compare_by(tmp_path / "a", "behaviour", "move_to_goal", "move_to_goal_cb")
