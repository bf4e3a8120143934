"""The joystick commands that need no swarm, on SDL's virtual pads."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fullswarm import output
from fullswarm.cli.main import app
from fullswarm.operator.joystick import devices, mapping
from fullswarm.operator.joystick.mapping import CONTROLS
from fullswarm.testing.pad import VirtualPad


@pytest.fixture(autouse=True)
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setattr(devices, "gamepads", tuple)
    return tmp_path / "fullswarm" / mapping.FILE


@pytest.fixture
def pad() -> Iterator[VirtualPad]:
    made = VirtualPad("Known")
    yield made
    made.unplug()


def run(*arguments: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(app, ["joystick", *arguments])
    return result.exit_code, result.stdout, result.stderr


def test_list_names_pads_and_marks_unknown_ones(pad: VirtualPad) -> None:
    odd = VirtualPad("Odd", known=False, product=19)
    code, out, _ = run("list", "--json")
    assert code == 0
    assert [(each["number"], each["name"], each["known"]) for each in json.loads(out)] == [
        (1, "Known", True),
        (2, "Odd", False),
    ]
    assert "fullswarm joystick map" in run("list")[1]
    odd.unplug()


def test_list_without_a_pad_ends_with_1() -> None:
    assert run("list", "--json") == (1, "[]\n", "no gamepad yet: plug one in\n")


def test_test_shows_what_a_control_would_ask_for(pad: VirtualPad) -> None:
    pad.axis("leftx", -1.0)
    pad.button("b", True)
    code, out, err = run("test", "--seconds", "0.3")
    assert (code, out) == (0, "")
    assert "Known: leftx -1.0 = move_left_bc / move_right_bc, b = estop" in err


def test_wrong_bindings_end_with_2_before_anything_else(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('[buttons]\nstop = "q"\n')
    code, out, err = run("--bindings", str(path))
    assert (code, out) == (2, "")
    assert "mine.toml:2: buttons.stop: 'q' is not a button" in err


@pytest.mark.slow
def test_map_skips_what_is_not_moved_and_names_missing_controls(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    odd = VirtualPad("Odd", known=False, product=19)
    said: list[str] = []

    def follow(text: str) -> None:
        said.append(text)
        odd.button(4, "(LB)" in text)

    monkeypatch.setattr(output, "progress", follow)
    code, out, _ = run("map", "--patience", "0.5")
    assert code == 1
    assert all(any(prompt in text for text in said) for _, prompt in CONTROLS)
    [line] = mapping.read_file(home)
    assert line.text == out.strip()
    assert line.controls == {"leftshoulder": "b4"}
    assert "the default bindings need leftx, lefty, a, b" in said[-1]
    odd.unplug()


def test_map_without_a_pad_or_with_two_is_an_error(pad: VirtualPad) -> None:
    other = VirtualPad("Other", product=2)
    code, _, err = run("map")
    assert code == 2
    assert "several pads are plugged in (give a number: 1: Known, 2: Other)" in err
    other.unplug()
    pad.unplug()
    code, _, err = run("map")
    assert (code, "no gamepad is plugged in" in err) == (2, True)
