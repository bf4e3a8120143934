from __future__ import annotations

import io

import pytest
from rich.console import Console

from fullswarm.operator.joystick.pilot import PilotStatus
from fullswarm.operator.joystick.show import Screen, pad_line, pad_table, status_line, status_text
from fullswarm.operator.joystick.state import PadState

DRIVES = PilotStatus(
    pad="X-Box [pad]", selection="group scouts", robots=2, dead_man=True, behaviour="move_left_bc",
    values={"magnitude": 0.5}, turbo=True, note="filter: r1: keeps clear of r2",
)  # fmt: skip


def drawn(what: object) -> str:
    console = Console(file=io.StringIO(), width=200)
    console.print(what)
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def test_a_pilot_sees_pad_selection_dead_man_behaviour_magnitude_and_reason() -> None:
    text = drawn(status_text(DRIVES))
    for part in ("X-Box [pad]", "group scouts (2)", "DEAD-MAN HELD", "TURBO", "move_left_bc", "magnitude", "+0.50",
                 "filter: r1: keeps clear of r2"):  # fmt: skip
        assert part in text


def test_without_a_pad_it_shows_what_to_do() -> None:
    text = drawn(status_text(PilotStatus(pad="", selection="whole swarm", robots=0, dead_man=False, behaviour="")))
    assert "no gamepad: plug one in" in text
    assert "dead-man up" in text


def test_into_a_file_goes_one_line_per_change_and_to_stderr(capsys: pytest.CaptureFixture[str]) -> None:
    screen = Screen()
    for _ in range(3):
        screen.show(status_text(DRIVES), status_line(DRIVES))
    screen.close()
    out, err = capsys.readouterr()
    assert out == ""
    assert err == "X-Box [pad] | group scouts | move_left_bc | filter: r1: keeps clear of r2\n"


def test_the_table_shows_each_control_and_what_it_asks_for() -> None:
    pads = (
        PadState(1, "Pad", "0" * 32, axes={"leftx": -1.0, "lefty": 0.0}, buttons=frozenset({"b"})),
        PadState(2, "Odd", "1" * 32, known=False),
    )
    meanings = {"leftx": "move_left_bc / move_right_bc", "b": "estop", "a": "stop"}
    text = drawn(pad_table(pads, meanings))
    for part in ("-1.00", "move_left_bc / move_right_bc", "estop", "down", "fullswarm joystick map"):
        assert part in text
    line = pad_line(pads, meanings)
    assert line.startswith("Pad: leftx -1.0 = move_left_bc / move_right_bc, b = estop; Odd: unknown to SDL")
    assert pad_line((), meanings) == "no gamepad"
