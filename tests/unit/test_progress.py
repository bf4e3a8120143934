from __future__ import annotations

import io
from itertools import pairwise

import pytest

from fullswarm.clock import SimClock
from fullswarm.output import Progress, duration, progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_in_a_pipe_the_first_line_comes_within_two_seconds_and_then_one_each_five() -> None:
    clock, pipe = SimClock(), io.StringIO()
    lines_at: list[float] = []
    with Progress("trials", 40, clock=clock, stream=pipe) as shown:
        for tenth in range(1, 201):
            clock.advance_to(0.1 * tenth)
            before = pipe.getvalue()
            shown.at(tenth // 10, "3 failed") if tenth % 10 == 0 else shown.tick()
            if pipe.getvalue() != before:
                lines_at.append(clock.now_s())
    assert lines_at[0] <= 2.0
    assert all(4.9 < later - earlier < 5.2 for earlier, later in pairwise(lines_at))
    assert "\x1b" not in pipe.getvalue()
    assert "\r" not in pipe.getvalue()
    assert pipe.getvalue().splitlines()[1] == "6 of 40 trials, 3 failed, about 37 s left"


def test_short_work_prints_nothing_in_a_pipe() -> None:
    clock, pipe = SimClock(), io.StringIO()
    with Progress("frames", clock=clock, stream=pipe) as shown:
        for done in range(1, 8):
            clock.advance_to(0.1 * done)
            shown.parts(done, 7)
    assert pipe.getvalue() == ""


def test_work_whose_parts_are_long_says_at_once_how_many_there_are() -> None:
    clock, pipe = SimClock(), io.StringIO()
    with Progress("episodes", 2, clock=clock, stream=pipe, at_once=True) as shown:
        shown.at(0)
        assert pipe.getvalue() == "0 of 2 episodes, 0 s\n"
        clock.advance_to(2.0)
        shown.at(1)
        clock.advance_to(4.0)
        shown.at(2)
    assert pipe.getvalue().splitlines() == ["0 of 2 episodes, 0 s", "2 of 2 episodes, about 0 s left"]


def test_a_terminal_has_one_line_that_is_written_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "60")
    clock, terminal = SimClock(), Terminal()
    with Progress("trials", 4, clock=clock, stream=terminal) as shown:
        for done in range(1, 4):
            clock.advance_to(float(done))
            shown.at(done)
        shown.say("failed: one of them")
        clock.advance_to(4.0)
        shown.at(4)
    text = terminal.getvalue()
    assert text.count("\n") == 2, "the message between, and the end"
    last = text.rsplit("\r\x1b[K", 1)[1]
    assert last == "[########################] 4 of 4 trials, about 0 s left\n"
    assert all(len(part.split("\n")[0]) < 60 for part in text.split("\r\x1b[K"))


def test_what_else_is_printed_takes_the_place_of_the_live_line(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("TERM", "xterm")
    clock, terminal = SimClock(), Terminal()
    with Progress("trials", 4, clock=clock, stream=terminal, at_once=True) as shown:
        shown.at(0)
        progress("is it safe?")
        assert terminal.getvalue().endswith("\r\x1b[K")
    assert capsys.readouterr().err == "is it safe?\n"
    assert "\n" not in terminal.getvalue(), "no line stands there any more that would have to be ended"


def test_a_terminal_without_abilities_gets_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "dumb")
    clock, terminal = SimClock(), Terminal()
    with Progress("trials", 4, clock=clock, stream=terminal, at_once=True) as shown:
        shown.at(0)
    assert terminal.getvalue() == "0 of 4 trials, 0 s\n"


def test_a_reader_that_has_gone_does_not_end_the_work() -> None:
    class Gone(io.StringIO):
        def write(self, _: str) -> int:
            raise BrokenPipeError

    with Progress("trials", 4, clock=SimClock(), stream=Gone(), at_once=True) as shown:
        shown.at(4)


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.4, "0 s"), (99.0, "99 s"), (600.0, "10 min"), (12000.0, "3 h 20 min")]
)
def test_durations(seconds: float, text: str) -> None:
    assert duration(seconds) == text
