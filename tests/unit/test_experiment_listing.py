"""`fullswarm experiment list`: what can be run, what is wrong with a file, and how far results are; on real files."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest
import typer
from typer.testing import CliRunner

from fullswarm.cli import experiment as commands
from fullswarm.clock import SimClock
from fullswarm.evaluate.experiment import listing
from fullswarm.evaluate.experiment.listing import Listing, follow
from fullswarm.runtime import Runtime
from tests.unit.pictures_world import a_trial, write_trial

BEGAN_S = 1_800_000_000.0
FILE = """
name = "meet"
description = "Two robots"
seeds = "0-3"
[limits.create]
speed_limit_m_s = 0.5
turn_limit_rad_s = 4.25
[small]
seeds = "0"
[[groups]]
name = "g"
behaviours = [{ name = "move_to_goal_bc" }]
scenarios = ["empty"]
robots = [2]
engines = ["kinematic"]
limits = ["create"]
"""


def listed(folder: Path, now_s: float = BEGAN_S) -> dict[str, dict[str, Any]]:
    return {each["id"]: each for each in Listing(folder, lambda: now_s).entries()}


def asked(folder: Path, **fields: Any) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "experiment.json").write_text(json.dumps({"name": "meet", **fields}))


def test_files_and_the_package_are_listed_with_their_trials(tmp_path: Path) -> None:
    (tmp_path / "meet.toml").write_text(FILE)
    found = listed(tmp_path)
    assert next(iter(found)) == "file:meet.toml"
    assert {"package:paper", "package:safety"} < found.keys()
    meet = found["file:meet.toml"]
    assert (meet["name"], meet["description"], meet["fault"], meet["results"]) == ("meet", "Two robots", "", None)
    assert (meet["trials"], meet["small_trials"], meet["seeds"], meet["small_seeds"]) == (4, 1, "0-3", "0")
    assert (meet["source"], meet["out"]) == (str(tmp_path / "meet.toml"), str(tmp_path / "meet"))
    assert found["package:paper"]["trials"] == 640


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("name = 5", "must be text"),
        ("", "groups: is missing"),
        ("[", "not valid TOML"),
        (FILE.replace("move_to_goal_bc", "move_to_gaol"), "move_to_gaol"),
        (FILE.replace('"empty"', '"nowhere.toml"'), "no file 'nowhere.toml'"),
        (FILE.replace("[2]", "[1000000]"), "too many"),
        (FILE.replace('"0-3"', '"0-99999"').replace('"kinematic"', '"kinematic", "pybullet", "drivetrain"'), "too"),
        ("#" * (listing.LARGEST_FILE + 1), "kB"),
        (FILE.replace("Two robots", "\\ud800"), ""),
    ],
)  # fmt: skip
def test_a_file_with_a_fault_is_listed_with_its_message(tmp_path: Path, text: str, words: str) -> None:
    (tmp_path / "wrong.toml").write_text(text)
    found = listed(tmp_path)["file:wrong.toml"]
    assert words in found["fault"]
    assert found["fault"]
    assert len(found["fault"]) <= listing.LONGEST_FAULT + 2


def test_a_file_that_is_no_text_is_a_fault(tmp_path: Path) -> None:
    (tmp_path / "wrong.toml").write_bytes(b"name = '\xff'")
    assert listed(tmp_path)["file:wrong.toml"]["fault"]


def test_what_is_no_file_and_no_results_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "folder.toml").mkdir()
    (tmp_path / ".hidden.toml").write_text(FILE)
    (tmp_path / "notes").mkdir()
    os.mkfifo(tmp_path / "pipe.toml")
    assert {each["kind"] for each in listed(tmp_path).values()} == {"package"}
    assert {each["kind"] for each in listed(tmp_path / "missing").values()} == {"package"}


def test_a_fault_is_gone_when_the_scenario_beside_the_file_is_there(tmp_path: Path) -> None:
    (tmp_path / "meet.toml").write_text(FILE.replace('"empty"', '"hall.toml"'))
    here = Listing(tmp_path, lambda: BEGAN_S)
    assert here.entries()[0]["fault"]
    (tmp_path / "hall.toml").write_text(Path(listing.__file__).parents[1].joinpath("scenarios/empty.toml").read_text())
    found = {each["id"]: each for each in here.entries()}
    assert found["file:meet.toml"]["fault"] == ""
    assert found["file:hall.toml"]["fault"], "a scenario is no experiment"


def test_results_are_followed_and_those_of_a_shell_are_listed_too(tmp_path: Path) -> None:
    out = tmp_path / "of_a_shell"
    ids = [a_trial(seed) for seed in range(4)]
    asked(out, trials=4)
    here = Listing(tmp_path, lambda: BEGAN_S + 2.0)

    def results() -> Any:
        return next(each for each in here.entries() if each["kind"] == "folder")["results"]

    assert results()["finished"] == 0
    for seed, trial in enumerate(ids[:3]):
        write_trial(out, trial, at_s=BEGAN_S + seed)
    now = results()
    assert (now["trials"], now["finished"], now["failed"], now["over"], now["going"]) == (4, 3, 0, False, True)
    assert now["left_s"] == 1
    assert now["cells"][0]["trials"] == 3
    assert now["report"] == ""
    write_trial(out, ids[3], at_s=BEGAN_S + 3.0)
    (out / "report.html").write_text("")
    os.utime(out / "report.html", (BEGAN_S + 4.0, BEGAN_S + 4.0))
    done = results()
    assert (done["finished"], done["over"], done["report"]) == (4, True, "fresh")
    os.utime(out / "report.html", (BEGAN_S, BEGAN_S))
    assert results()["report"] == "old"


def test_an_experiment_of_the_packages_name_has_results_of_its_own(tmp_path: Path) -> None:
    (tmp_path / "paper.toml").write_text(FILE)
    found = listed(tmp_path)
    assert found["file:paper.toml"]["out"] != found["package:paper"]["out"]


def test_a_huge_folder_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listing, "MOST_STORED", 3)
    for number in range(listing.MOST_FILES + 20):
        (tmp_path / f"e{number:03d}.toml").write_text("name = 5")
    asked(tmp_path / "many", trials=9)
    for number in range(4):
        (tmp_path / "many" / "trials" / f"t{number}").mkdir(parents=True)
    found = listed(tmp_path)
    assert sum(each["kind"] == "file" for each in found.values()) == listing.MOST_FILES
    assert "too many" in found["folder:many"]["fault"]
    assert found["folder:many"]["results"] is None


def test_the_list_is_kept_in_a_file_until_its_parent_ends(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "meet.toml").write_text(FILE)
    to, runtime, parent = tmp_path / "list.json", Runtime(SimClock()), [os.getppid()]
    monkeypatch.setattr(os, "getppid", lambda: parent[0])
    runtime.after(2.5, lambda: asked(tmp_path / "meet", trials=4))
    runtime.after(4.5, lambda: parent.append(parent.pop() + 1))
    assert follow(tmp_path, to, parent[0], runtime) == 0
    assert runtime.now_s() == pytest.approx(5.0)
    found = json.loads(to.read_text())
    assert found["format"] == listing.FORMAT
    assert found["experiments"][0]["results"]["trials"] == 4
    assert to.stat().st_mode & 0o777 == 0o600


def test_the_command_prints_a_table_or_json(tmp_path: Path) -> None:
    app = typer.Typer()
    app.command("list")(commands.list_experiments)
    app.command("watch")(commands.watch)
    (tmp_path / "meet.toml").write_text(FILE)
    (tmp_path / "wrong.toml").write_text("name = 5")
    text = CliRunner().invoke(app, ["list", str(tmp_path)])
    assert text.exit_code == 0, text.output
    assert "faulty" in text.output
    assert "not run" in text.output
    plain = CliRunner().invoke(app, ["list", str(tmp_path), "--json"])
    assert json.loads(plain.stdout)["format"] == listing.FORMAT
    missing = CliRunner().invoke(app, ["list", str(tmp_path / "missing")])
    assert missing.exit_code == 2
