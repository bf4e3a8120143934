"""The directory of a trial: what stands in it, that it is whole or not there, and that its file is all it takes."""

from __future__ import annotations

import os
import socket
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment import Trial, arena_of, load_experiment, plan
from fullswarm.evaluate.experiment import run as experiment
from fullswarm.evaluate.provenance import Provenance
from fullswarm.evaluate.trial import Keeper
from fullswarm.evaluate.trial_folder import (
    COVERAGE_FILE,
    PROVENANCE_FILE,
    RESULT_FILE,
    TRAJECTORY_FILE,
    TRIAL_FILE,
    TRIALS,
    Trajectory,
    launch_text,
    load_trial,
    parse_trial,
    read_kept,
    read_record,
    sweep,
    trial_id,
    write_files,
)
from tests.unit.experiment_work import Trouble, answer

ALL_FILES = sorted((TRIAL_FILE, RESULT_FILE, PROVENANCE_FILE, TRAJECTORY_FILE, COVERAGE_FILE))


def trial(seed: int = 0) -> Trial:
    (one,) = plan(load_experiment("paper"), (seed,), ("robots=4,uniform,move_to_goal_bc",), engine="kinematic")
    return one


def refuse(trial: Trial) -> None:
    raise ConfigError("it must not be")


def names(folder: Path) -> list[str]:
    return sorted(each.name for each in folder.iterdir())


# ---------------------------------------------------------------------------------------------------- the directory
def test_a_kept_trial(tmp_path: Path) -> None:
    result = Keeper(tmp_path, "paper", answer)(trial())
    folder = tmp_path / TRIALS / trial_id(trial())
    assert names(tmp_path / TRIALS) == [folder.name]
    assert names(folder) == ALL_FILES
    record = read_record(folder)
    assert record is not None
    assert (record.id, record.experiment, record.trial) == (folder.name, "paper", trial())
    assert (record.outcome, record.end_reason) == (result.outcome, "all arrived")
    assert record.onboard == record.truth == {"work.total_m": 1.0}
    path = Trajectory.load(folder / TRAJECTORY_FILE)
    assert path.pose.shape == (5, 4, 3)
    with np.load(folder / COVERAGE_FILE) as file:
        assert file["frame"].tolist() == [0.0, 0.0, 0.5, 2.0, 2.0]
        assert file["covered"].sum() == 2
    about = msgspec.json.decode((folder / PROVENANCE_FILE).read_bytes(), type=Provenance)
    assert (about.attempts, about.runner, about.host) == (1, "pool", socket.gethostname())
    assert about.started.endswith("+00:00")
    assert about.packages["numpy"] == np.__version__
    assert len(about.configuration) == 64


def test_a_trial_that_fails_is_kept_and_replaced(tmp_path: Path) -> None:
    failed = Keeper(tmp_path, "paper", refuse)(trial())  # type: ignore[arg-type]  # it never answers
    assert (failed.outcome, failed.failure) == (None, "it must not be")
    folder = tmp_path / TRIALS / trial_id(trial())
    record = read_record(folder)
    assert record is not None
    assert (record.outcome, record.failure, record.end_reason) == (None, "it must not be", "failed")
    assert names(folder) == sorted((TRIAL_FILE, RESULT_FILE, PROVENANCE_FILE))
    assert read_kept(tmp_path, trial()) is None
    Keeper(tmp_path, "paper", answer)(trial(), 2)
    kept = read_kept(tmp_path, trial())
    assert kept is not None
    assert (kept.outcome, kept.attempts) == (answer(trial()).outcome, 2)
    assert names(tmp_path / TRIALS) == [folder.name]


def test_a_kept_outcome_is_not_replaced(tmp_path: Path) -> None:
    Keeper(tmp_path, "paper", answer)(trial())
    folder = tmp_path / TRIALS / trial_id(trial())
    before = (folder / PROVENANCE_FILE).read_bytes()
    Keeper(tmp_path, "paper", refuse)(trial())  # type: ignore[arg-type]  # it never answers
    assert (folder / PROVENANCE_FILE).read_bytes() == before
    assert names(tmp_path / TRIALS) == [folder.name]


def test_a_changed_trial_is_another_one(tmp_path: Path) -> None:
    Keeper(tmp_path, "paper", answer)(trial())
    slower = replace(trial(), body=(("speed_limit_m_s", 1.0), *trial().body[1:]))
    assert trial_id(slower) != trial_id(trial())
    assert read_kept(tmp_path, slower) is None
    assert read_kept(tmp_path, trial()) is not None


def test_what_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="name too long"):
        write_files(tmp_path, "one", {RESULT_FILE: b"{}", "x" * 300: b""})
    assert names(tmp_path / TRIALS) == []


def test_leftovers_of_the_dead_are_removed(tmp_path: Path) -> None:
    dead, host = 2**22 + 1, socket.gethostname()  # beyond the largest pid
    for name in (f".a-{host}-{dead}", f".a-{host}-{dead}.old", f".b-{host}-{os.getppid()}", ".c-elsewhere-7", ".d"):
        (tmp_path / TRIALS / name).mkdir(parents=True)
        (tmp_path / TRIALS / name / RESULT_FILE).write_text("{")
    os.utime(tmp_path / TRIALS / ".d", (0.0, 0.0))
    assert sweep(tmp_path) == 3
    assert names(tmp_path / TRIALS) == [f".b-{host}-{os.getppid()}", ".c-elsewhere-7"]


def test_a_folder_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("")
    with pytest.raises(ConfigError, match="cannot use the folder"):
        sweep(tmp_path / "out")


# ---------------------------------------------------------------------------------------------------- trial.toml
def test_the_file_is_the_trial(tmp_path: Path) -> None:
    Keeper(tmp_path, "paper", answer)(trial())
    launch = load_trial(tmp_path / TRIALS / trial_id(trial()))
    assert (launch.experiment, launch.trial) == ("paper", trial())
    assert load_trial(tmp_path / TRIALS / trial_id(trial()) / TRIAL_FILE) == launch


def test_the_file_holds_the_scenario(tmp_path: Path) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text('name = "mine"\nbounds_m = [0, 0, 9, 9]\n[spawn]\nregion_m = [1, 1, 8, 8]\n'
                    '[goal]\ncentre_m = [4, 4]\nradius_m = 2.0\n')  # fmt: skip
    one = replace(trial(), arena=arena_of(str(mine)), cell=replace(trial().cell, scenario=str(mine)))
    text = launch_text(one, "x")
    mine.unlink()
    assert parse_trial(text, "t").trial == one


setting = st.one_of(st.booleans(), st.integers(-5, 5), st.floats(-1e6, 1e6, width=32), st.text("aé\"\\\n'", max_size=6))


@settings(max_examples=25, deadline=None)
@example({"map": 0}, None)
@example({"map": False}, None)  # equal to the one before, but not the same
@given(st.dictionaries(st.sampled_from(["map", "gain", "x-y"]), setting), st.one_of(st.none(), st.floats(0.1, 1e4)))
def test_every_trial_survives_its_file(parameters: dict[str, bool | int | float | str], limit_s: float | None) -> None:
    pairs = tuple(parameters.items())
    one = replace(trial(3), cell=replace(trial().cell, parameters=pairs), time_limit_s=limit_s, agent=pairs, stop=pairs)
    again = parse_trial(launch_text(one, 'a "b"'), "t")
    assert (again.trial, again.experiment) == (one, 'a "b"')
    assert trial_id(again.trial) == trial_id(one)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("seed = 0", "seed = ", "TOML"),
        ("seed = 0", 'seed = "0"', "seed"),
        ("seed = 0", "sed = 0", "sed"),
        ("fullswarm.launch/1", "fullswarm.launch/9", "launch/9"),
        ("robots = 4", "robots = 4.5", "robots"),
        ("radius_m = 4.0", "radius_m = -4.0", "radius_m"),
    ],
)
def test_a_wrong_file_says_what_is_wrong(old: str, new: str, words: str) -> None:
    text = launch_text(trial(), "paper")
    assert old in text
    with pytest.raises(ConfigError, match=words) as caught:
        parse_trial(text.replace(old, new, 1), "some/trial.toml")
    assert "some/trial.toml" in str(caught.value)


def test_no_file(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot read the trial"):
        load_trial(tmp_path / "nothing.toml")


def test_one_trial_again(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Keeper(tmp_path, "paper", answer)(trial())
    folder = tmp_path / TRIALS / trial_id(trial())
    assert experiment.run_again(folder, tmp_path / "again", run_one=answer) == 0
    out, err = capsys.readouterr()
    assert "the same result as before" in err
    assert "work.total_m" in out
    again = tmp_path / "again" / TRIALS / folder.name
    for name in (TRIAL_FILE, RESULT_FILE, TRAJECTORY_FILE, COVERAGE_FILE):
        assert (again / name).read_bytes() == (folder / name).read_bytes()
    assert experiment.run_again(folder, as_json=True, run_one=Trouble(tmp_path / "notes", raises=0)) == 1
    out, err = capsys.readouterr()
    assert '"failure": "ValueError: no law of nature"' in out
    assert "not the result that it had before" in err


def test_one_trial_again_says_what_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Keeper(tmp_path, "paper", refuse)(trial())  # type: ignore[arg-type]  # it never answers
    folder = tmp_path / TRIALS / trial_id(trial())
    assert experiment.run_again(folder, tmp_path, run_one=answer) == 0
    err = capsys.readouterr().err
    assert f"kept in {folder}" in err
    assert "not the result that it had before" in err  # it had failed
    before = (folder / PROVENANCE_FILE).read_bytes()
    assert experiment.run_again(folder, tmp_path, run_one=answer) == 0
    err = capsys.readouterr().err
    assert "\nkept in" not in f"\n{err}"
    assert f"not kept: it has a result in {folder} already, which stays" in err
    assert "the same result as before" in err
    assert (folder / PROVENANCE_FILE).read_bytes() == before


def test_files_that_are_not_utf_8_are_no_records(tmp_path: Path) -> None:
    Keeper(tmp_path, "paper", answer)(trial())
    folder = tmp_path / TRIALS / trial_id(trial())
    (folder / PROVENANCE_FILE).write_bytes(b'{"host": "\xff"}')
    kept = read_kept(tmp_path, trial())
    assert kept is not None
    assert kept.attempts == 1
    (folder / RESULT_FILE).write_bytes(b'{"id": "\xff"}')
    assert read_kept(tmp_path, trial()) is None
