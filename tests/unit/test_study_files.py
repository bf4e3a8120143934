"""Study files and folders: errors with lines, what comes next, and a key that stays sealed."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest

from fullswarm.errors import ConfigError
from fullswarm.operator.console.study import TRIAL, TrialRecord
from fullswarm.study.file import SWARM, check_fleets
from fullswarm.study.folder import KEY, Due, StudyFolder, begin, open_folder, progress
from fullswarm.study.session import prepare
from tests.unit.study_lab import STUDY, write_study

NAMES = ("generous-margin", "tight-margin")


def finish(folder: StudyFolder, due: Due, state: str = "complete", seal: str | None = None) -> None:
    """Note a trial as its console does."""
    path = folder.folder_of(due)
    path.mkdir(parents=True, exist_ok=True)
    record = TrialRecord(
        participant=due.participant, label=due.label, number=due.number, attempt=due.attempt,
        seal=folder.seal if seal is None else seal, setting="f", version="1", state=state,  # type: ignore[arg-type]
    )  # fmt: skip
    (path / TRIAL).write_bytes(msgspec.json.encode(record))


def next_of(folder: StudyFolder, participant: str) -> Due:
    due = folder.due(participant)
    assert due is not None
    return due


def test_all_errors_of_a_file_come_at_once_with_their_lines(tmp_path: Path) -> None:
    text = (
        STUDY.replace('name = "tight-margin"', 'name = "generous-margin"')
        .replace('truth = "stopped"', 'truth = "stopped"\nchoices = ["a", "b"]')
        .replace("at_s = [5.0]", "at_s = [99.0]")
        .replace("participants = 4", 'participants = ["P01", "Anna Smith"]')
    )
    with pytest.raises(ConfigError) as caught:
        write_study(tmp_path, text)
    said = str(caught.value).splitlines()
    assert [line.split(": ")[1] for line in said] == [
        "participants", "conditions[1].name", "probes[0].at_s", "probes[0].truth",
    ]  # fmt: skip
    assert f"{tmp_path / 'study.toml'}:3: participants: 'Anna Smith' is no code" in said[0]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('task = "Keep them apart."', 'taks = "x"', "did you mean 'task'?"),
        ('truth = "stopped"', 'truth = "stoped"', "nothing is counted as 'stoped'"),
        ("duration_s = 20.0", "duration_s = -1.0", "greater than 0"),
        ("participants = 4", "participants = 0", "must be 1 to"),
        ('truth = "stopped"', 'correct = "yes"', "must be a number in quotes"),
        ('fleet = "hall.toml"', "", "has no fleet"),
        ("set = [", 'request = { behaviour = "x", parameters = { goal = { a = 1 } } }\nset = [', "request"),
    ],
)
def test_a_mistake_is_explained(tmp_path: Path, old: str, new: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said.replace("?", r"\?")):
        write_study(tmp_path, STUDY.replace(old, new, 1))


def test_fleets_are_checked_with_the_settings_of_each_condition(tmp_path: Path) -> None:
    check_fleets(write_study(tmp_path))
    study = write_study(tmp_path, STUDY.replace("margin_m=0.02", "margin_n=0.02"))
    with pytest.raises(ConfigError, match=r"study.toml:\d+: conditions\[1\]\.fleet: .*margin_m"):
        check_fleets(study)


def test_an_interrupted_trial_comes_again_and_a_complete_one_does_not(tmp_path: Path) -> None:
    folder = begin(write_study(tmp_path), tmp_path / "data")
    first = next_of(folder, "P02")
    assert (first.number, first.of, first.attempt) == (1, 2, 1)
    finish(folder, first, "interrupted")
    again = next_of(folder, "P02")
    assert (again.number, again.label, again.attempt) == (1, first.label, 2)
    finish(folder, again)
    second = next_of(folder, "P02")
    assert second.number == 2
    assert {first.label, second.label} == {"A", "B"}
    finish(folder, second)
    assert folder.due("P02") is None
    row = next(row for row in progress(folder) if row.participant == "P02")
    assert (row.complete, row.interrupted, row.next) == (2, 1, None)
    with pytest.raises(ConfigError, match="no participant 'P99'"):
        folder.order("P99")


def test_a_folder_keeps_its_key_and_takes_no_other_file(tmp_path: Path) -> None:
    study = write_study(tmp_path)
    one, two = begin(study, tmp_path / "data"), begin(study, tmp_path / "data")
    assert one.seal == two.seal
    assert [one.condition(label) for label in "AB"] == [two.condition(label) for label in "AB"]
    with pytest.raises(ConfigError, match="not the file with which this study began"):
        begin(write_study(tmp_path, STUDY.replace("seed = 3", "seed = 4")), tmp_path / "data")
    with pytest.raises(ConfigError, match="holds no study"):
        begin(study, tmp_path)


def test_labels_are_drawn_anew_for_each_study(tmp_path: Path) -> None:
    study = write_study(tmp_path)
    drawn = {begin(study, tmp_path / f"data{number}").condition("A") for number in range(40)}
    assert drawn == set(NAMES), "with two conditions, 40 equal draws have a chance of 2 in 10^12"


def test_neither_a_plan_nor_a_record_nor_a_path_names_the_condition(tmp_path: Path) -> None:
    folder = begin(write_study(tmp_path), tmp_path / "data")
    for participant in ("P01", "P02"):
        prepared = prepare(folder, next_of(folder, participant))
        finish(folder, next_of(folder, participant))
        assert prepared.config.swarm == SWARM
    for path in (tmp_path / "data").rglob("*"):
        assert not any(name in path.name for name in NAMES)
        if path.is_file() and path.name != "study.toml":  # that lists them all, without labels
            assert not any(name.encode() in path.read_bytes() for name in NAMES), path


def test_the_settings_of_the_condition_reach_the_swarm(tmp_path: Path) -> None:
    folder = begin(write_study(tmp_path), tmp_path / "data")
    margins = {}
    for number in (1, 2):
        due = next_of(folder, "P01")
        assert due.number == number
        margins[folder.condition(due.label)] = prepare(folder, due).config.agent.safety_margin_m
        finish(folder, due)
    assert margins == {"generous-margin": 0.2, "tight-margin": 0.02}


def test_unblinding_is_noted_and_an_exchanged_key_is_noticed(tmp_path: Path) -> None:
    folder = begin(write_study(tmp_path), tmp_path / "data")
    finish(folder, next_of(folder, "P01"))
    assert not (tmp_path / "data" / "unblinded.json").exists()
    assert set(folder.unblind().values()) == set(NAMES)
    assert folder.opened
    noted = json.loads((tmp_path / "data" / "unblinded.json").read_text())
    assert (noted["complete_trials"], set(noted["conditions"])) == (1, {"A", "B"})
    finish(folder, next_of(folder, "P02"), seal="another")
    with pytest.raises(ConfigError, match="run with another key"):
        open_folder(tmp_path / "data").unblind()
    (tmp_path / "data" / KEY).write_text("rubbish")
    with pytest.raises(ConfigError, match="the key cannot be read"):
        open_folder(tmp_path / "data")
