"""`fullswarm results`: stdout is data, errors are one line with the right exit code."""

from __future__ import annotations

import json
import webbrowser
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from fullswarm.cli.results import results_app
from fullswarm.evaluate.scenarios.maps import FREE, OCCUPIED, occupied_cells
from fullswarm.evaluate.trial_folder import COVERAGE_FILE, RESULT_FILE, TRAJECTORY_FILE, TRIALS, Trajectory
from tests.unit.results_fixture import FAILURE, a_trial, write_folder, write_trial
from tests.unit.ros_map import read_map

run = CliRunner()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("results"))


def said(*words: str | Path, code: int = 0) -> str:
    result = run.invoke(results_app, [str(each) for each in words])
    assert result.exit_code == code, result.output
    return result.stdout


def complaint(*words: str | Path) -> str:
    result = run.invoke(results_app, [str(each) for each in words])
    assert result.exit_code == 2
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    assert len(result.stderr.splitlines()) == 1
    return result.stderr


def test_list(folder: Path) -> None:
    table = said("list", folder)
    assert len(table.splitlines()) == 9
    found = json.loads(said("list", folder, "--json"))
    assert len(found["cells"]) == 8
    assert found["problems"] == []
    assert sum(each["trials"] for each in found["cells"]) == 32
    assert sum(each["failed"] for each in found["cells"]) == 1
    bare = [each for each in found["cells"] if each["label"] == "move_to_goal"]
    assert sum(each["collisions"] for each in bare) == 15 + 35 + 27 + 43
    assert all(each["parameters"] == {} for each in bare)


def test_list_of_the_working_directory(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    assert len(json.loads(said("list", "--json"))["cells"]) == 8


def test_show_a_trial(folder: Path) -> None:
    name = next(each.name for each in sorted((folder / "trials").iterdir()) if "uniform-n8" in each.name)
    assert json.loads(said("show", folder, name, "--json"))["record"]["id"] == name
    text = said("show", folder, name)
    assert "work.total_m" in text
    assert "end: all arrived" in text


def test_show_a_failed_trial(folder: Path) -> None:
    text = said("show", folder, "behaviour=move_to_goal,scenario=concave,robots=4,seed=3")
    assert FAILURE in text


def test_show_a_cell(folder: Path) -> None:
    what = "behaviour=move_to_goal,scenario=concave,robots=4"
    found = json.loads(said("show", folder, what, "--json"))
    assert (found["trials"], found["failed"], len(found["ids"])) == (4, 1, 4)
    events = next(each for each in found["metrics"] if each["name"] == "events")
    assert (events["source"], events["count"], events["mean"], events["low"] >= 0.0) == ("outcome", 3, 5.0, True)
    assert "4 trials, 1 failed" in said("show", folder, what)
    assert "no trial fits" in complaint("show", folder, "robots=5")


@pytest.mark.parametrize("form", ["csv", "xlsx", "parquet", "mat"])
def test_export(folder: Path, tmp_path: Path, form: str) -> None:
    path = tmp_path / f"t.{form}"
    assert said("export", folder, "--format", form, "--out", path).strip() == str(path)
    assert path.stat().st_size > 500


def test_export_to_stdout(folder: Path) -> None:
    lines = said("export", folder, "--out", "-").splitlines()
    assert len(lines) == 33
    assert lines[0].startswith("trial,experiment,")
    assert len(said("export", folder, "--out", "-", "--long").splitlines()) > 500
    assert "cannot be printed" in complaint("export", folder, "--out", "-", "--format", "mat")
    assert "did you mean 'xlsx'" in complaint("export", folder, "--format", "xls")


def test_compare(folder: Path) -> None:
    words = ("compare", folder, "move_to_goal", "move_to_goal_bc", "--by", "behaviour")
    found = json.loads(said(*words, "--json"))
    assert found["pairs"] == 15
    assert "15 pairs; alone: 1 of A, 1 of B" in said(*words)
    assert "concave N=4" in said(*words, "--cells")
    assert "31 pairs" in said("compare", folder, folder)
    assert "3 words instead of 2" in complaint("compare", folder, folder, folder)


def test_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "results"
    write_trial(folder, a_trial("move_to_goal", "empty", 4, 0))
    opened: list[str] = []

    def note(address: str) -> bool:
        opened.append(address)
        return True

    monkeypatch.setattr(webbrowser, "open", note)
    lines = said("report", folder, "--open", "--plots", tmp_path).splitlines()
    assert lines[0] == str(folder / "report.html")
    assert str(tmp_path / "collisions.svg") in lines
    assert opened == [(folder / "report.html").resolve().as_uri()]


def test_index(tmp_path: Path) -> None:
    write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    assert "1 trials, 0 of them failed" in said("index", tmp_path)
    broken = write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 1))
    (broken / RESULT_FILE).write_text("{")
    found = json.loads(said("index", tmp_path, "--json", code=1))
    assert found["trials"] == 1
    assert found["problems"][0]["directory"] == str(broken)


@pytest.mark.parametrize("verb", ["list", "show", "export", "report", "index"])
def test_a_folder_without_results(tmp_path: Path, verb: str) -> None:
    assert "not a results folder" in complaint(verb, tmp_path, *(["x"] if verb == "show" else []))


def test_a_map_of_what_was_covered(folder: Path, tmp_path: Path) -> None:
    done = next(each for each in sorted((folder / TRIALS).iterdir()) if (each / COVERAGE_FILE).exists())
    names = said("map", folder, "--trial", done.name, "--out", tmp_path / "hall").split()
    assert names == [str(tmp_path / "hall.pgm"), str(tmp_path / "hall.yaml")]
    grid, covered = read_map(tmp_path / "hall.yaml"), np.load(done / COVERAGE_FILE)["covered"].astype(bool)
    boxes = occupied_cells(
        grid.frame, tuple(tuple(row) for row in Trajectory.load(done / TRAJECTORY_FILE).boxes.tolist())
    )
    assert ((grid.pixels == FREE) == (covered & ~boxes)).all()
    assert ((grid.pixels == OCCUPIED) == boxes).all()
    failed = next(each for each in (folder / TRIALS).iterdir() if not (each / COVERAGE_FILE).exists())
    assert "no coverage grid" in complaint("map", failed)
    (tmp_path / TRIALS / "x").mkdir(parents=True)
    (tmp_path / TRIALS / "x" / COVERAGE_FILE).write_bytes(b"PK")
    assert "not a coverage grid" in complaint("map", tmp_path, "--trial", "x")


def test_what_older_settings_left_is_told_and_counted_nowhere(tmp_path: Path) -> None:
    paths = [write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, seed)) for seed in range(3)]
    (tmp_path / "experiment.json").write_text(
        json.dumps({"name": "paper", "trials": [each.name for each in paths[:2]]})
    )
    for words in (("list",), ("show", "robots=4"), ("export",), ("report",), ("index",)):
        result = run.invoke(results_app, [words[0], str(tmp_path), *words[1:]])
        assert result.exit_code == 0, result.output
        assert "1 trial of older settings is in no figure; another --out keeps them apart" in result.stderr
    assert json.loads(said("list", tmp_path, "--json"))["cells"][0]["trials"] == 2
    assert len((tmp_path / "results.csv").read_text().splitlines()) == 3


def test_groups_are_a_column_where_nothing_else_differs(tmp_path: Path) -> None:
    for group in ("near", "far"):
        trial = a_trial("move_to_goal", "empty", 4, 0)
        write_trial(tmp_path, replace(trial, cell=replace(trial.cell, group=group)))
    assert said("list", tmp_path).split()[0] == "group"
    assert "near" in said("list", tmp_path)


def test_the_interval_of_a_share_is_one(tmp_path: Path) -> None:
    for seed in range(4):
        write_trial(tmp_path, a_trial("move_to_goal", "concave", 4, seed))
    found = json.loads(said("show", tmp_path, "robots=4", "--json"))
    shares = [each for each in found["metrics"] if each["name"].endswith("fraction") or each["name"] == "all_arrived"]
    assert {each["name"] for each in shares} >= {"arrived_fraction", "all_arrived", "coverage.fraction"}
    known = [each for each in shares if each["low"] is not None]  # what is the same in all trials has no interval
    assert all(0.0 <= each["low"] <= each["high"] <= 1.0 for each in known)
    assert "all_arrived" in {each["name"] for each in known}
    assert [each["high"] for each in shares if each["name"] == "arrived_fraction"] == [1.0]


def test_compare_tells_what_it_cannot_read(tmp_path: Path) -> None:
    write_folder(tmp_path, seeds=2)
    broken = next(each for each in sorted((tmp_path / TRIALS).iterdir()) if "_bc" in each.name)
    (broken / RESULT_FILE).write_bytes(b"\xff")
    words = ["compare", str(tmp_path), "move_to_goal", "move_to_goal_bc", "--by", "behaviour"]
    result = run.invoke(results_app, words)
    assert result.exit_code == 0, result.output
    assert f"unreadable: {broken}" in result.stderr


def test_mistakes_with_files_are_told(tmp_path: Path) -> None:
    place = write_trial(tmp_path, a_trial("move_to_goal", "empty", 4, 0))
    assert "it is a folder" in complaint("export", tmp_path, "--out", tmp_path)
    assert "it is a folder" in complaint("export", tmp_path, "--out", ".")
    whole = (place / TRAJECTORY_FILE).read_bytes()
    (place / TRAJECTORY_FILE).write_bytes(whole[: len(whole) // 2])
    assert "not a trajectory" in complaint("map", tmp_path, "--out", tmp_path / "hall")
    (place / COVERAGE_FILE).write_bytes(b"")
    assert "not a coverage grid" in complaint("map", tmp_path)
