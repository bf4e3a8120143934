"""``fullswarm flash``: cards fit their robots, and what was not written leaves no trust behind."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fullswarm.deploy.flash import card, run
from fullswarm.deploy.flash.result import FirstReport
from fullswarm.errors import Unreachable
from fullswarm.operator import session
from fullswarm.operator.session import Target
from tests.unit.flash_lab import FLEET, MEGA, Lab


@pytest.fixture
def lab(tmp_path: Path) -> Lab:
    made = Lab(tmp_path)
    made.make()
    return made


def hosts(lab: Lab) -> set[str]:
    return {each.name for each in (lab.keys.folder / "hosts").rglob("r*")}


# ---------------------------------------------------------------- host keys
def test_a_card_that_was_not_written_leaves_no_host_key(lab: Lab) -> None:
    assert lab.to_file("--dry-run")[0].exit_code == 0
    assert lab.to_file("--static", "10.9.0.1/24")[0].exit_code == 2
    assert hosts(lab) == set()
    assert lab.to_file()[0].exit_code == 0
    assert hosts(lab) == {"r1_ed25519", "r1_ed25519.pub"}
    assert lab.to_file("--dry-run")[0].exit_code == 0
    assert hosts(lab) == {"r1_ed25519", "r1_ed25519.pub"}  # there is a card that has it


# ---------------------------------------------------------------- what fits
def test_a_simulated_robot_gets_no_card(lab: Lab) -> None:
    lab.fleet.write_text('[hub]\nendpoint = "tcp/10.0.0.1:7447"\n[[robot]]\nid = "r1"\n')
    result, _ = lab.to_file("--dry-run")
    assert (result.exit_code, "robot r1: is simulated" in result.stderr) == (2, True)


def test_a_release_without_the_robots_driver_is_refused(lab: Lab) -> None:
    lab.fleet.write_text(FLEET.replace("create:///dev/ttyUSB0", "mavlink+serial:///dev/ttyACM0", 1))
    result, _ = lab.to_file("--dry-run")
    assert result.exit_code == 2
    assert "lacks what its robots' agents need: mavlink" in result.stderr
    assert "--with mavlink" in result.stderr


def test_an_image_whose_name_says_nothing_of_its_python_is_told_of(lab: Lab) -> None:
    result, _ = lab.to_file("--dry-run")
    assert "its Python is unknown from its name; this release needs 3." in result.stderr


def test_a_card_that_is_not_ours_to_write_is_refused_before_the_image_is_read(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = lab.folder / "card"
    fake.touch()
    monkeypatch.setattr(card, "list_cards", lambda: (card.Card(str(fake), 40 * MEGA, removable=True),))
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != fake)
    result = lab.flash("r1", "--target", "x86_64", "--image", str(lab.image), "--device", str(fake), "--yes", "card")
    assert result.exit_code == 2
    assert "permission denied" in result.stderr
    assert "SHA-256" not in result.stderr
    assert "sudo -E" in result.stderr


def test_a_full_scratch_folder_is_no_bug(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(run, "read_head", full)
    result, _ = lab.to_file()
    assert (result.exit_code, "cannot prepare the cards: No space left" in result.stderr) == (2, True)
    assert "TMPDIR=" in result.stderr


# ---------------------------------------------------------------- --wait
def test_nothing_is_written_when_there_is_no_hub_to_wait_at(lab: Lab) -> None:
    result, _ = lab.to_file("--wait", "--hub", "tcp/127.0.0.1:9")
    assert (result.exit_code, "no hub answers" in result.stderr) == (3, True)
    assert not (lab.folder / "r1.img").exists()


@pytest.mark.parametrize("lost", [True, False])
def test_what_was_written_is_told_whatever_comes_of_waiting(
    lab: Lab, lost: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    @contextmanager
    def connect(*_: object) -> Iterator[None]:
        yield

    def silence(target: Target, robots: list[str], minutes: float) -> tuple[dict[str, FirstReport], list[str]]:
        if lost:
            raise Unreachable("no hub answers", where=str(target))
        return {}, robots

    monkeypatch.setattr(session, "connect", connect)
    monkeypatch.setattr(run, "wait_for_robots", silence)
    result, said = lab.to_file("--wait")
    assert result.exit_code == 3
    assert [each["state"] for each in said["cards"]] == ["written"]
    words = ("r1", "--target", "x86_64", "--image", str(lab.image), "--output", str(lab.folder / "b.img"), "--wait")
    assert "written" in lab.flash(*words).stdout
    assert json.dumps(said)
