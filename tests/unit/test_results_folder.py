"""Reading a results folder: what is broken is named and costs nothing else."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from fullswarm.errors import ConfigError
from fullswarm.evaluate.results import read_folder, read_records
from fullswarm.evaluate.results.folder import older_in
from fullswarm.evaluate.results.quantities import values_of
from fullswarm.evaluate.trial_folder import PROVENANCE_FILE, RESULT_FILE, TRIALS
from fullswarm.units import unit_of
from tests.unit.results_fixture import FAILURE, a_record, a_trial, write_folder, write_trial


def test_all_trials_are_read_in_order(tmp_path: Path) -> None:
    write_folder(tmp_path)
    folder = read_folder(tmp_path)
    assert (len(folder.trials), folder.problems) == (32, [])
    assert [each.record.failure for each in folder.failed] == [FAILURE]
    keys = [(each.record.trial.cell.scenario, each.record.trial.cell.robots) for each in folder.trials]
    assert keys == sorted(keys)
    assert all(each.path.name == each.record.id for each in folder.trials)
    assert folder.trials[0].provenance.git == "0123abc"


def test_unfinished_directories_are_ignored(tmp_path: Path) -> None:
    path = write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    shutil.copytree(path, path.with_name(f".{path.name}-host-1"))
    assert len(read_records(tmp_path)) == 1


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": "fullswarm.trial/1"}', "\x00\xff"])
def test_a_broken_result_is_named(tmp_path: Path, text: str) -> None:
    write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    broken = write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 1))
    (broken / RESULT_FILE).write_bytes(text.encode("latin-1"))
    folder = read_folder(tmp_path)
    assert len(folder.trials) == 1
    assert [each.path for each in folder.problems] == [broken]
    assert RESULT_FILE in folder.problems[0].reason


def test_a_missing_result_and_one_of_another_trial_or_version_are_named(tmp_path: Path) -> None:
    paths = [write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, seed)) for seed in range(3)]
    (paths[0] / RESULT_FILE).unlink()
    shutil.copy(paths[2] / RESULT_FILE, paths[1] / RESULT_FILE)
    text = json.loads((paths[2] / RESULT_FILE).read_text())
    (paths[2] / RESULT_FILE).write_text(json.dumps({**text, "format": "fullswarm.trial/99"}))
    folder = read_folder(tmp_path)
    assert folder.trials == []
    reasons = {each.path: each.reason for each in folder.problems}
    assert "No such file" in reasons[paths[0]]
    assert "another trial" in reasons[paths[1]]
    assert "fullswarm.trial/99" in reasons[paths[2]]


def test_a_trial_with_broken_provenance_counts_and_is_named(tmp_path: Path) -> None:
    path = write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    (path / PROVENANCE_FILE).write_text("{")
    folder = read_folder(tmp_path)
    assert len(folder.trials) == 1
    assert "counts" in folder.problems[0].reason


def test_what_was_asked_for_and_is_not_there_is_missing(tmp_path: Path) -> None:
    path = write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    (tmp_path / "experiment.json").write_text(json.dumps({"name": "paper", "trials": [path.name, "other"], "new": 1}))
    assert read_folder(tmp_path).missing == ["other"]


def test_only_trials_that_were_asked_for_count(tmp_path: Path) -> None:
    paths = [write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, seed)) for seed in range(3)]
    (tmp_path / "experiment.json").write_text(json.dumps({"name": "paper", "trials": [paths[1].name]}))
    folder = read_folder(tmp_path)
    assert ([each.path for each in folder.trials], folder.older) == ([paths[1]], 2)
    assert (older_in(tmp_path, [paths[1].name]), older_in(tmp_path, [])) == (2, 0)
    (tmp_path / "experiment.json").write_text(json.dumps({"name": "paper", "trials": []}))
    assert (len(read_records(tmp_path)), read_folder(tmp_path).older) == (3, 0)  # of joined shards


def test_a_folder_of_older_trials_alone_is_no_mistake(tmp_path: Path) -> None:
    write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    (tmp_path / "experiment.json").write_text(json.dumps({"name": "paper", "trials": ["another"]}))
    folder = read_folder(tmp_path)
    assert (folder.trials, folder.older, folder.missing) == ([], 1, ["another"])


def test_a_folder_without_trials_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="not a results folder"):
        read_folder(tmp_path)
    (tmp_path / TRIALS).mkdir()
    with pytest.raises(ConfigError, match="no trials"):
        read_folder(tmp_path)


def test_values_of_an_outcome() -> None:
    values = values_of(a_record(a_trial("move_to_goal", "concave", 8, 0)))
    assert values[("outcome", "events")] == 8.0
    assert values[("outcome", "arrived_fraction")] == 7 / 8
    assert ("outcome", "arrival_s") not in values  # somebody was late: there is no such time
    assert values[("truth", "work.total_m")] == 120.0
    assert not any(source == "outcome" for source, _ in values_of(a_record(a_trial("m", "empty", 4, 0), "died")))


@pytest.mark.parametrize(
    ("name", "unit"), [("work.total_m", "m"), ("a_m2", "m²"), ("v_m_s", "m/s"), ("t_s", "s"), ("events", "")]
)
def test_units_come_from_names(name: str, unit: str) -> None:
    assert unit_of(name) == unit
