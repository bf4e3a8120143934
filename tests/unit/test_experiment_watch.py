"""`fullswarm experiment watch`: folders that grow while somebody looks, on a simulated clock."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import pytest
import typer
from rich.console import Console
from typer.testing import CliRunner

from fullswarm.cli import experiment as commands
from fullswarm.clock import SimClock
from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment.watch import ExperimentFolder, Watch, headline, progress_of, span, view, watch
from fullswarm.evaluate.trial_folder import RESULT_FILE, TRIALS, trial_id
from fullswarm.runtime import Runtime
from tests.unit.pictures_world import a_trial, write_trial

BEGAN_S = 1_800_000_000.0
"""Since 1970; of all folders here."""

app = typer.Typer()
app.command("watch")(commands.watch)
app.command("replay")(commands.replay)


def asked(folder: Path, **fields: Any) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "experiment.json").write_text(json.dumps({"name": "paper", **fields}))


def text_of(folder: ExperimentFolder, now_s: float, height: int | None = None) -> str:
    console = Console(width=130, record=True, file=io.StringIO())
    console.print(view(progress_of(folder, now_s), now_s, height))
    return console.export_text()


def test_a_growing_folder_is_read_once_for_each_trial(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: list[str] = []
    decode = msgspec.json.decode

    def counted(data: bytes, **how: Any) -> Any:
        reads.append("")
        return decode(data, **how)

    monkeypatch.setattr(msgspec.json, "decode", counted)
    asked(tmp_path, trials=10)
    folder = ExperimentFolder(tmp_path)
    assert folder.refresh()
    assert not folder.refresh()
    for seed in range(4):
        write_trial(tmp_path, a_trial(seed), at_s=BEGAN_S + seed)
    reads.clear()
    assert folder.refresh()
    assert not folder.refresh()
    assert len(folder.finished) == 4
    assert len(reads) == 4 + 2  # and experiment.json each time


def test_what_is_half_written_does_not_count(tmp_path: Path) -> None:
    (tmp_path / TRIALS / ".navigate.part").mkdir(parents=True)
    (tmp_path / TRIALS / ".navigate.part" / RESULT_FILE).write_text("{}")
    (tmp_path / TRIALS / "empty").mkdir()
    (tmp_path / TRIALS / "a_file").write_text("")
    broken = tmp_path / TRIALS / "broken"
    broken.mkdir()
    (broken / RESULT_FILE).write_text("{")
    folder = ExperimentFolder(tmp_path)
    assert folder.refresh()  # the broken one is news, once
    assert not folder.refresh()
    progress = progress_of(folder, BEGAN_S)
    assert (progress.finished, progress.unreadable) == (0, ("broken",))
    assert "unreadable: broken" in text_of(folder, BEGAN_S)
    write_trial(tmp_path, a_trial(0))
    (tmp_path / TRIALS / trial_id(a_trial(0)) / RESULT_FILE).replace(broken / RESULT_FILE)
    assert folder.refresh()
    assert progress_of(folder, BEGAN_S).unreadable == ()


def test_a_failed_trial_that_is_run_again_is_read_again(tmp_path: Path) -> None:
    folder_path, trial = tmp_path, a_trial(0)
    write_trial(folder_path, trial, failure="killed")
    folder = ExperimentFolder(folder_path)
    folder.refresh()
    assert progress_of(folder, BEGAN_S).failed == 1
    assert not folder.refresh()
    write_trial(folder_path, trial, contacts=2)
    assert folder.refresh()
    progress = progress_of(folder, BEGAN_S)
    assert (progress.failed, progress.finished, progress.collisions) == (0, 1, 2)


def test_counts_speed_and_time_left(tmp_path: Path) -> None:
    asked(tmp_path, trials=100)
    for seed in range(11):
        write_trial(tmp_path, a_trial(seed), at_s=BEGAN_S + 2.0 * seed, contacts=int(seed == 3))
    write_trial(tmp_path, a_trial(11), at_s=BEGAN_S + 22.0, failure="it <raised> [bold]")
    folder = ExperimentFolder(tmp_path)
    folder.refresh()
    progress = progress_of(folder, BEGAN_S + 22.0)
    assert progress.trials_per_s == pytest.approx(0.5)
    assert progress.left_s == pytest.approx(88 / 0.5)
    assert progress.real_time_factor == pytest.approx(10 * 30.0 / 22.0)
    assert progress.arrived_fraction == pytest.approx(0.75)
    assert progress.collisions == 1
    assert not progress.over
    text = text_of(folder, BEGAN_S + 25.0)
    assert "paper: 12 of 100 trials, about" in text
    assert "1 collision, 1 failed, 75.0 % of robots arrived" in text
    assert "failed: it <raised> [bold]" in text
    assert "3 s ago" in text
    assert text.splitlines()[1] == "━" * 7 + "─" * 53  # 12 % of 60
    slower = progress_of(folder, BEGAN_S + 42.0)
    assert slower.trials_per_s is not None
    assert slower.trials_per_s < 0.3  # nothing for 20 s


def test_a_pause_says_nothing_about_the_speed(tmp_path: Path) -> None:
    asked(tmp_path, trials=100)
    for seed in range(10):
        write_trial(tmp_path, a_trial(seed), at_s=BEGAN_S + seed)
    for seed in range(10, 20):
        write_trial(tmp_path, a_trial(seed), at_s=BEGAN_S + 3600.0 + seed)  # started again
    folder = ExperimentFolder(tmp_path)
    folder.refresh()
    assert progress_of(folder, BEGAN_S + 3619.0).trials_per_s == pytest.approx(1.0)


def test_an_experiment_that_stands_still_is_told(tmp_path: Path) -> None:
    asked(tmp_path, trials=100)
    for seed in range(10):
        write_trial(tmp_path, a_trial(seed), at_s=BEGAN_S + seed)
    folder = ExperimentFolder(tmp_path)
    folder.refresh()
    assert "nothing has finished" not in text_of(folder, BEGAN_S + 20.0)
    assert progress_of(folder, BEGAN_S + 300.0).left_s is None
    assert "nothing has finished for 5 min" in text_of(folder, BEGAN_S + 309.0)


def test_a_start_that_is_written_down_counts(tmp_path: Path) -> None:
    asked(tmp_path, trials=100, started="2027-01-15T08:00:10Z")  # ten seconds after BEGAN_S
    for seed in range(12):
        write_trial(tmp_path, a_trial(seed), at_s=BEGAN_S + (seed if seed < 10 else 10 + 5 * (seed - 9)))
    folder = ExperimentFolder(tmp_path)
    folder.refresh()
    assert progress_of(folder, BEGAN_S + 20.0).trials_per_s == pytest.approx(0.2)


def test_only_trials_that_are_asked_for_count(tmp_path: Path) -> None:
    ids = [write_trial(tmp_path, a_trial(seed)) for seed in range(5)]
    asked(tmp_path, trials=[*ids[:3], "to-come"])
    folder = ExperimentFolder(tmp_path)
    folder.refresh()
    progress = progress_of(folder, BEGAN_S)
    assert (progress.finished, progress.total) == (3, 4)


@pytest.mark.parametrize("content", ["", "[]", "{", '{"trials": "many", "started": 7, "name": 3}', '{"trials": true}'])
def test_a_strange_experiment_file_does_not_stop_the_view(tmp_path: Path, content: str) -> None:
    write_trial(tmp_path, a_trial(0))
    (tmp_path / "experiment.json").write_text(content)
    folder = ExperimentFolder(tmp_path)
    folder.refresh()
    progress = progress_of(folder, BEGAN_S)
    assert (progress.total, progress.left_s, progress.finished, progress.over) == (None, None, 1, False)
    assert headline(progress) == "paper: 1 trials"


def test_cells_that_do_not_fit_are_counted_and_the_newest_come_first(tmp_path: Path) -> None:
    for robots in range(1, 41):
        write_trial(tmp_path, a_trial(0, robots=robots), at_s=BEGAN_S + robots)
    folder = ExperimentFolder(tmp_path)
    folder.refresh()
    text = text_of(folder, BEGAN_S + 40.0, height=24)
    assert "and 31 more cells" in text
    assert len(text.splitlines()) <= 24
    assert text.index("  40  ") < text.index("  39  ")
    assert "group" not in text
    assert "more cells" not in text_of(folder, BEGAN_S + 40.0)


def test_cells_of_several_groups_name_theirs(tmp_path: Path) -> None:
    trial = a_trial(0)
    write_trial(tmp_path, trial)
    write_trial(tmp_path, replace(trial, cell=replace(trial.cell, group="bad network", network="loss=20%")))
    folder = ExperimentFolder(tmp_path)
    folder.refresh()
    lines = text_of(folder, BEGAN_S).splitlines()
    assert [sum(line.startswith(name) for line in lines) for name in ("group", "bad network", "paper ")] == [1, 1, 1]


def test_a_long_failure_is_told_in_full_unless_lines_are_counted(tmp_path: Path) -> None:
    write_trial(tmp_path, a_trial(0), failure="because " * 30 + "of this")
    folder = ExperimentFolder(tmp_path)
    folder.refresh()
    assert "of this" in " ".join(text_of(folder, BEGAN_S).split())
    counted = text_of(folder, BEGAN_S, height=24)
    assert "of this" not in counted
    assert "…" in counted


def test_a_folder_that_is_none_is_named(tmp_path: Path) -> None:
    for path, message in ((tmp_path / "none", "no such folder"), (tmp_path, "neither trials/ nor experiment.json")):
        with pytest.raises(ConfigError, match=message):
            ExperimentFolder(path)


# ------------------------------------------------------------------------------------------------ the command
class Growing:
    """An experiment that finishes a trial every two simulated seconds."""

    def __init__(self, path: Path, total: int) -> None:
        self.runtime, self._path, self._total, self.done = Runtime(SimClock()), path, total, 0
        asked(path, trials=total)
        self.runtime.every(2.0, self._finish)

    def wall_s(self) -> float:
        return BEGAN_S + self.runtime.now_s()

    def _finish(self) -> None:
        if self.done < self._total:
            write_trial(self._path, a_trial(self.done), at_s=self.wall_s())
            self.done += 1


def test_the_view_ends_when_all_trials_have(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    growing = Growing(tmp_path, 5)
    assert watch(Watch(tmp_path), growing.runtime, growing.wall_s) == 0
    assert growing.done == 5
    assert growing.runtime.now_s() == pytest.approx(10.0)
    said = capfd.readouterr()
    assert "paper: 5 of 5 trials, all done" in said.out
    first, *_, last = said.err.splitlines()
    assert first.startswith("0 of 5 trials, 0 collisions, 0 failed")
    assert last.startswith("5 of 5 trials, ")


def test_json_is_a_line_at_each_change(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    growing = Growing(tmp_path, 3)
    watch(Watch(tmp_path, as_json=True), growing.runtime, growing.wall_s)
    lines = [json.loads(line) for line in capfd.readouterr().out.splitlines()]
    assert [line["finished"] for line in lines] == [0, 1, 2, 3]
    assert [line["over"] for line in lines] == [False, False, False, True]
    assert lines[2]["left_s"] == pytest.approx(2.0)
    assert lines[0]["arrived_fraction"] is None
    assert lines[3]["cells"][0]["seeds"] == 3
    assert lines[3]["last"][0]["arrived"] == 3


def test_ctrl_c_leaves_with_the_last_state(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    growing = Growing(tmp_path, 50)

    def interrupt() -> None:
        raise KeyboardInterrupt

    growing.runtime.after(5.0, interrupt)
    assert watch(Watch(tmp_path), growing.runtime, growing.wall_s) == 0
    said = capfd.readouterr()
    assert "2 of 50 trials" in said.out
    assert said.err.splitlines()[-1] == "left; the experiment goes on"
    assert len(said.err.splitlines()) <= 3, "a line each five seconds"


def test_older_settings_are_told_and_counted_nowhere(tmp_path: Path) -> None:
    names = [write_trial(tmp_path, a_trial(seed), contacts=seed) for seed in range(3)]
    asked(tmp_path, trials=names[:1])
    folder = ExperimentFolder(tmp_path)
    folder.refresh()
    progress = progress_of(folder, BEGAN_S)
    assert (progress.finished, progress.collisions, progress.older) == (1, 0, 2)
    assert "2 trials of older settings are in no figure" in text_of(folder, BEGAN_S)
    asked(tmp_path, trials=[])
    folder.refresh()
    assert progress_of(folder, BEGAN_S).finished == 3


def test_what_is_not_utf_8_is_unreadable(tmp_path: Path) -> None:
    name = write_trial(tmp_path, a_trial(0))
    (tmp_path / TRIALS / name / RESULT_FILE).write_bytes(b'{"id": "\xff"}')
    (tmp_path / "experiment.json").write_bytes(b'"\xff"')
    folder = ExperimentFolder(tmp_path)
    assert folder.refresh()
    assert progress_of(folder, BEGAN_S).unreadable == (name,)


def test_once_is_a_snapshot(tmp_path: Path) -> None:
    asked(tmp_path, trials=10)
    write_trial(tmp_path, a_trial(0))
    people = CliRunner().invoke(app, ["watch", str(tmp_path), "--once"])
    assert people.exit_code == 0
    assert "paper: 1 of 10 trials" in people.stdout
    program = CliRunner().invoke(app, ["watch", str(tmp_path), "--once", "--json"])
    assert json.loads(program.stdout)["trials"] == 10
    missing = CliRunner().invoke(app, ["watch", str(tmp_path / "none"), "--once"])
    assert missing.exit_code == 2
    assert "no such folder" in missing.stderr


def test_a_thousand_trials_are_looked_through_quickly(tmp_path: Path) -> None:
    for seed in range(1000):
        write_trial(tmp_path, a_trial(seed), at_s=BEGAN_S + seed)
    folder = ExperimentFolder(tmp_path)
    folder.refresh()
    looked: list[Path] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Path, "stat", lambda self, **_: looked.append(self))
        assert not folder.refresh()
    assert looked == []  # no file is touched again


@pytest.mark.parametrize(("seconds", "text"), [(8.4, "8 s"), (180.0, "3 min"), (9000.0, "2.5 h")])
def test_times_for_people(seconds: float, text: str) -> None:
    assert span(seconds) == text
