"""Pads through SDL itself, on its virtual joystick: no hardware, no display."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from fullswarm.errors import ConfigError
from fullswarm.operator.joystick import mapping
from fullswarm.operator.joystick.mapping import CONTROLS, Wizard
from fullswarm.operator.joystick.pads import Pads
from fullswarm.operator.joystick.state import PadState, RawState
from fullswarm.testing.pad import VirtualPad


@pytest.fixture
def pads(tmp_path: Path) -> Iterator[Pads]:
    made = Pads(tmp_path / "none.txt")
    yield made
    made.close()


@pytest.fixture
def pad(pads: Pads) -> Iterator[VirtualPad]:
    made = VirtualPad()
    pads.poll()
    yield made
    made.unplug()
    pads.poll()


def only(pads: Pads, pad: VirtualPad) -> PadState:
    return next(each for each in pads.poll() if each.id == pad.id)


def test_a_known_pad_has_axes_and_buttons_by_name(pads: Pads, pad: VirtualPad) -> None:
    pad.axis("leftx", -1.0)
    pad.axis("righty", 0.5)
    pad.axis("lefttrigger", 1.0)
    pad.button("leftshoulder", True)
    pad.button("dpup", True)
    state = only(pads, pad)
    assert (state.name, state.known) == ("Virtual pad", True)
    assert state.axes["leftx"] == -1.0
    assert state.axes["righty"] == pytest.approx(0.5, abs=1e-4)
    assert state.axes["lefttrigger"] == 1.0
    assert state.buttons == {"leftshoulder", "dpup"}


def test_all_buttons_and_axes_arrive_under_their_own_name(pads: Pads, pad: VirtualPad) -> None:
    from fullswarm.operator.joystick.state import AXES, BUTTONS

    for name in BUTTONS[:15]:
        pad.button(name, True)
        assert only(pads, pad).buttons == {name}
        pad.button(name, False)
        assert only(pads, pad).buttons == set()
    for name in AXES:
        pad.axis(name, 1.0)
        assert {axis for axis, value in only(pads, pad).axes.items() if value} == {name}
        pad.axis(name, 0.0)


def test_a_press_between_two_looks_is_not_lost(pads: Pads, pad: VirtualPad) -> None:
    only(pads, pad)
    pad.button("b", True)
    pads._sdl.SDL_JoystickUpdate()
    pad.button("b", False)
    assert only(pads, pad).buttons == {"b"}
    assert only(pads, pad).buttons == set()


def test_pads_come_and_go(pads: Pads, pad: VirtualPad) -> None:
    other = VirtualPad("Second", product=2)
    states = pads.poll()
    assert [each.name for each in states] == ["Virtual pad", "Second"]
    assert states[0].guid != states[1].guid
    other.unplug()
    assert [each.name for each in pads.poll()] == ["Virtual pad"]
    again = VirtualPad("Second", product=2)
    back = pads.poll()[1]
    assert (back.guid, back.id != states[1].id) == (states[1].guid, True)
    again.unplug()


def test_a_pad_that_was_there_before_is_found(tmp_path: Path) -> None:
    before = VirtualPad("Early")
    pads = Pads(tmp_path / "none.txt")
    assert "Early" in [each.name for each in pads.poll()]
    before.unplug()
    pads.close()


def test_rumble_reaches_the_pad_and_a_lost_pad_is_no_error(pads: Pads, pad: VirtualPad) -> None:
    state = only(pads, pad)
    pads.rumble(state.id, 0.5, 0.1)
    assert pad.rumbles == [0x7FFF]
    pad.unplug()
    pads.rumble(state.id, 0.5, 0.1)
    pads.poll()
    pads.rumble(state.id, 0.5, 0.1)
    assert pads.raw(state.id) == RawState()


def test_an_unknown_pad_is_listed_and_becomes_known_by_a_line_of_the_users_file(tmp_path: Path) -> None:
    odd = VirtualPad("Odd", known=False, product=7)
    pads = Pads(tmp_path / "none.txt")
    state = only(pads, odd)
    assert (state.known, dict(state.axes), state.buttons) == (False, {}, frozenset())
    path = tmp_path / "gamecontrollerdb.txt"
    path.write_text(f"# mine\n{state.guid},Odd,leftx:a3,leftshoulder:b2,platform:Linux,\n"
                    f"{state.guid},Odd,leftx:a1,platform:Windows,\n")  # fmt: skip
    pads.close()
    pads = Pads(path)
    odd.axis(3, 1.0)
    odd.button(2, True)
    state = only(pads, odd)
    assert state.known
    assert state.axes["leftx"] == 1.0
    assert state.buttons == {"leftshoulder"}
    odd.unplug()
    pads.close()


def test_a_malformed_line_of_the_users_file_is_reported_with_its_number(tmp_path: Path) -> None:
    path = tmp_path / "gamecontrollerdb.txt"
    path.write_text("# comment\nnonsense\n" + "0" * 32 + ",Pad,leftx:q7,\n")
    with pytest.raises(ConfigError, match=r"gamecontrollerdb.txt:2: .*\n.*:3: 'q7'"):
        Pads(path)


# ---------------------------------------------------------------- the wizard
LAYOUT: dict[str, tuple[str, int, float]] = {  # control → kind, number, the way it goes on an odd pad
    "leftx": ("axis", 3, -1.0),
    "lefty": ("axis", 0, 1.0),
    "rightx": ("axis", 1, 1.0),
    "righty": ("axis", 2, 1.0),
    "leftshoulder": ("button", 11, 1.0),
    "rightshoulder": ("button", 10, 1.0),
    "lefttrigger": ("axis", 4, 1.0),  # rests at -1
    "righttrigger": ("axis", 5, 1.0),  # rests midway
    "a": ("button", 3, 1.0),
    "b": ("button", 0, 1.0),
    "x": ("button", 1, 1.0),
    "y": ("button", 2, 1.0),
    "dpup": ("hat", 0, 1),
    "dpdown": ("hat", 0, 4),
    "dpleft": ("hat", 0, 8),
    "dpright": ("hat", 0, 2),
    "back": ("button", 8, 1.0),
}
REST = {4: -1.0}


def operate(pad: VirtualPad, control: str, on: bool) -> None:
    kind, number, way = LAYOUT[control]
    if kind == "axis":
        pad.axis(number, way if on else REST.get(number, 0.0))
    elif kind == "button":
        pad.button(number, on)
    else:
        pad.hat(number, int(way) if on else 0)


def walk(pads: Pads, pad: VirtualPad) -> Wizard:
    """Follow the wizard's prompts, in its own time."""
    wizard, now_s = Wizard(), 0.0
    asked = {prompt: control for control, prompt in CONTROLS}
    held = ""
    while not wizard.done and now_s < 100.0:
        control = asked.get(wizard.prompt, "")
        if held and control != held:
            operate(pad, held, False)
            held = ""
        elif control in LAYOUT and not held:
            operate(pad, control, True)
            held = control
        elif control and not held:
            wizard.skip()
        pads.poll()
        now_s += 0.01
        wizard.update(now_s, pads.raw(pad.id))
    assert wizard.done
    return wizard


def test_the_wizard_teaches_an_unknown_pad_and_the_line_works_after_a_restart(tmp_path: Path) -> None:
    odd = VirtualPad("Odd, no 8", known=False, product=8, hats=1)
    path = tmp_path / "folder" / "gamecontrollerdb.txt"
    pads = Pads(path)
    for axis, rest in REST.items():
        odd.axis(axis, rest)
    wizard = walk(pads, odd)
    assert wizard.missing == ()
    assert set(wizard.controls) == set(LAYOUT)
    state = only(pads, odd)
    mapping.write_file(path, mapping.build(state.guid, state.name, wizard.controls, "Linux"))
    pads.close()

    pads = Pads(path)
    assert only(pads, odd).known
    for control, (kind, _, _) in LAYOUT.items():
        operate(odd, control, True)
        state = only(pads, odd)
        operate(odd, control, False)
        if kind == "axis":
            assert {name: round(value, 2) for name, value in state.axes.items() if abs(value) > 0.1} == {control: 1.0}
        else:
            assert state.buttons == {control}
    odd.unplug()
    pads.close()
