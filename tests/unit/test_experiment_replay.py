"""`fullswarm experiment replay`: which trial, which file, and what is wrong with them."""

from __future__ import annotations

from pathlib import Path

import pytest
import typer
from PIL import Image
from PIL.GifImagePlugin import GifImageFile
from typer.testing import CliRunner

from fullswarm.cli import experiment as watch
from fullswarm.clock import SimClock
from fullswarm.errors import ConfigError
from fullswarm.evaluate.pictures import Film
from fullswarm.evaluate.pictures.replay import Replay, replay
from fullswarm.evaluate.results.folder import NAMED, find_trial
from fullswarm.evaluate.trial_folder import RESULT_FILE, TRAJECTORY_FILE, TRIALS, read_record
from tests.unit.pictures_world import a_trial, two_robots, write_trial

app = typer.Typer()
app.command("watch")(watch.watch)
app.command("replay")(watch.replay)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Three trials with trajectories, and a failed one without."""
    out = tmp_path / "out"
    for seed in (1, 2, 12):
        write_trial(out, a_trial(seed), trajectory=two_robots())
    write_trial(out, a_trial(3), failure="the law raised")
    return out


def test_a_trial_is_found_by_the_beginning_of_its_id(folder: Path) -> None:
    two = find_trial(folder, "navigate_bc-map=given-uniform-n4-kinematic-create-s2")
    assert "-s2-" in two.name
    assert find_trial(folder, "*-s12-") == find_trial(folder, find_trial(folder, "*-s12-").name)
    assert find_trial(two) == two  # a trial's own folder


@pytest.mark.parametrize(
    ("wanted", "message"),
    [
        ("*-s1", "2 trials fit"),
        ("", r"4 trials fit .*--trial: navigate_bc"),
        ("formation", "no such trial"),
        ("navigate_bc-map=given-uniform-n4-kinematic-create-s77", "no such trial .*did you mean 'navigate_bc"),
    ],
)
def test_an_unclear_choice_is_named(folder: Path, wanted: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        find_trial(folder, wanted)


def test_hundreds_of_trials_are_not_listed(tmp_path: Path) -> None:
    for seed in range(30):
        (tmp_path / TRIALS / f"navigate_bc-s{seed}").mkdir(parents=True)
    with pytest.raises(ConfigError) as many:
        find_trial(tmp_path)
    with pytest.raises(ConfigError) as none:
        find_trial(tmp_path, "zzz")
    assert "30 trials fit" in str(many.value)
    assert str(many.value).count("navigate_bc") == NAMED
    assert "there are 30" in str(none.value)


def test_a_picture_and_a_film_come_out(folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    still, film = tmp_path / "a.png", tmp_path / "a.gif"
    assert replay(Replay(folder, still, Film(width_px=400), "*-s2-")) == 0
    assert replay(Replay(folder, film, Film(width_px=400, speed=2.0), "*-s2-"), SimClock()) == 0
    with Image.open(still) as picture, GifImageFile(film) as moving:
        assert picture.size == moving.size
        assert moving.n_frames == 21
    said = capfd.readouterr()
    assert said.out.splitlines() == [str(still), str(film)]
    assert said.err == "", "the clock stood still: what takes no time has no progress"


def test_what_is_wrong_is_said_in_one_line(folder: Path, tmp_path: Path) -> None:
    damaged = find_trial(folder, "*-s12-")
    (damaged / TRAJECTORY_FILE).write_bytes(b"PK\x03\x04 not all of it")
    to = tmp_path / "a.png"
    for arguments, message in (
        ([str(folder), "--trial", "*-s3-", "--to", str(to)], "it failed: the law raised"),
        ([str(damaged), "--to", str(to)], "not a trajectory"),
        ([str(folder), "--trial", "*-s2-", "--to", str(tmp_path / "a.jpg")], "cannot make a '.jpg'"),
        ([str(folder), "--trial", "*-s2-", "--to", str(tmp_path / "none" / "a.png")], "no such folder"),
        ([str(folder), "--trial", "*-s2-", "--to", str(to), "--from", "99"], "nothing was recorded"),
        ([str(tmp_path / "none"), "--to", str(to)], "no such folder"),
        ([str(tmp_path), "--to", str(to)], "neither a trial's folder nor an experiment's"),
    ):
        result = CliRunner().invoke(app, ["replay", *arguments])
        assert result.exit_code == 2, result.output
        assert message in result.stderr
        assert result.stderr.count("\n") == 1
        assert result.stdout == ""
    assert not to.exists()


def test_the_command_line_reaches_the_film(folder: Path, tmp_path: Path) -> None:
    to = tmp_path / "a.gif"
    options = ["--speed", "1", "--fps", "5", "--from", "1", "--until", "2", "--width", "400"]
    result = CliRunner().invoke(app, ["replay", str(folder), "--trial", "*-s2-", "--to", str(to), *options])
    assert result.exit_code == 0, result.output
    with GifImageFile(to) as film:
        assert film.n_frames == 6
        assert film.size[0] == 400
        assert film.info["duration"] == 200


def test_a_record_that_is_not_utf_8_costs_no_picture(tmp_path: Path) -> None:
    (tmp_path / RESULT_FILE).write_bytes(b'{"id": "\xff"}')
    assert read_record(tmp_path) is None
