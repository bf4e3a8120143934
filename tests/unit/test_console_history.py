"""The console's history: what it keeps, its bounds, and how pages look back."""

from __future__ import annotations

import json
import random
import zlib
from typing import Any

import pytest

from fullswarm.operator.console import frames
from fullswarm.operator.console import history as histories
from fullswarm.operator.console.history import History, Limits
from fullswarm.operator.console.log import Entry
from tests.unit.console_bench import ConsoleBench, Page, health


@pytest.fixture
def bench() -> ConsoleBench:
    return ConsoleBench()


def drive(bench: ConsoleBench, seconds: float, speed_m_s: float = 0.1) -> None:
    """Let r1 and r2 drive along x, so that x says what time it is."""
    for _ in range(round(seconds / 0.05)):
        now_s = bench.runtime.now_s()
        bench.states("r1", "r2", x_m=speed_m_s * (now_s - 100.0))
        if round(now_s * 20) % 10 == 0:
            bench.report(health("r1"), health("r2"))
            bench.beat()
        bench.run(0.05)


def look(bench: ConsoleBench, page: Page, session: Any, at_s: float) -> dict[str, Any]:
    before = len(page.all("history"))
    assert bench.say(session, page, "look", at=at_s)["ok"]
    bench.run(0.06)
    assert len(page.all("history")) == before + 1
    return page.last("history")


def test_a_page_sees_robots_where_they_were(bench: ConsoleBench) -> None:
    drive(bench, 25.0)
    page, session = bench.join()
    for at_s in (100.5, 107.0, 112.3, 124.5):
        found = look(bench, page, session, at_s)
        assert found["from"] <= at_s <= found["to"] + 0.2
        states = [frame for _, frame in found["frames"] if frame["t"] == "state" and frame["at"] <= at_s]
        assert states[-1]["robots"][0][1] == pytest.approx(0.1 * (at_s - 100.0), abs=0.02)
        kinds = {frame["t"] for _, frame in found["frames"][:8]}
        assert {"trails", "fleet", "world"} <= kinds  # complete from its first moment on


def test_a_page_looks_back_also_when_no_page_was_open_then(bench: ConsoleBench) -> None:
    drive(bench, 12.0)
    page, session = bench.join()
    assert page.last("timeline")["from"] == pytest.approx(100.0, abs=0.3)
    assert look(bench, page, session, 103.0)["from"] < 103.0


def test_the_log_is_that_up_to_the_segment(bench: ConsoleBench) -> None:
    page, session = bench.join()
    drive(bench, 5.0)
    assert bench.say(session, page, "stop")["ok"]
    drive(bench, 20.0)
    early = look(bench, page, session, 101.0)
    assert [entry["kind"] for entry in early["log"]].count("stop") == 1
    assert all(entry["at"] <= early["to"] for entry in early["log"])
    assert [each["event"]["kind"] for each in page.all("event")].count("stop") == 1
    other, _ = bench.join("session-2", "bert")
    assert "stop" in [each["kind"] for each in other.last("events")["events"]]


def test_of_a_thousand_seeks_the_newest_counts(bench: ConsoleBench) -> None:
    drive(bench, 15.0)
    page, session = bench.join()
    for number in range(1000):
        assert bench.say(session, page, "look", at=100.0 + 0.01 * number)["ok"]
    bench.run(1.0)
    assert len(page.all("history")) == 1
    assert page.last("history")["from"] <= 109.99 <= page.last("history")["to"]


def test_pages_that_look_at_once_take_turns(bench: ConsoleBench) -> None:
    drive(bench, 15.0)
    pages = [bench.join(f"session-{number}", "anna") for number in range(4)]
    states = len(pages[0][0].all("state"))
    for _ in range(20):
        for number, (page, session) in enumerate(pages):
            bench.say(session, page, "look", at=101.0 + number)
        drive(bench, 0.1)
    counts = [len(page.all("history")) for page, _ in pages]
    assert all(9 <= count <= 11 for count in counts), counts  # twenty a second for all of them
    assert len(pages[0][0].all("state")) - states >= 38  # what is live comes on as before


def test_a_page_that_left_gets_nothing(bench: ConsoleBench) -> None:
    drive(bench, 2.0)
    page, session = bench.join()
    bench.say(session, page, "look", at=101.0)
    bench.gateway.leave(session, page)
    bench.run(0.2)
    assert page.all("history") == []


def test_a_moment_outside_gives_the_nearest_segment(bench: ConsoleBench) -> None:
    drive(bench, 25.0)
    page, session = bench.join()
    assert look(bench, page, session, -1e9)["from"] == pytest.approx(100.0, abs=0.3)
    assert look(bench, page, session, 1e9)["open"]


@pytest.mark.parametrize("at", ['"x"', "null", "1e13", "NaN", "[]", "true"])
def test_garbage_is_refused(at: str) -> None:
    answer = frames.read_command(f'{{"t":"look","ref":1,"at":{at}}}')
    assert isinstance(answer, frames.Answer)
    assert not answer.ok


# -------------------------------------------------------------------- bounds
def history(**limits: Any) -> History:
    return History(dict, Limits(**limits))


def fill(kept: History, seconds: float, text: str) -> None:
    for number in range(round(10 * seconds)):
        kept.add("state", text, 0.1 * number)


def test_a_history_is_bounded_in_time() -> None:
    kept = history(seconds=60.0)
    fill(kept, 200.0, '{"t":"state"}')
    assert 119.0 <= kept.from_s <= 131.0  # whole segments of 10 s
    assert kept.to_s == pytest.approx(199.9)


def test_a_history_is_bounded_in_bytes() -> None:
    chance = random.Random(1)
    kept = history(bytes=200_000)
    for number in range(5000):
        noise = "".join(chance.choices("0123456789abcdef", k=2000))  # hardly to be compressed
        kept.add("state", f'{{"t":"state","x":"{noise}"}}', 0.1 * number)
        assert kept.size <= 200_000 + 150_000  # the newest segment is kept in any case
    assert kept.from_s > 400.0


def test_a_frame_that_is_too_long_is_left_out() -> None:
    kept = history()
    kept.add("fleet", '{"t":"fleet","x":"' + "x" * histories.FRAME_BYTES + '"}', 0.0)
    assert kept.left_out == 1
    assert json.loads(kept.segment(0.0))["frames"] == []


def test_a_segment_ends_when_it_is_full() -> None:
    kept = history()
    text = '{"t":"state","x":"' + "x" * 100_000 + '"}'
    fill(kept, 6.0, text)
    assert len(kept.segment(0.0)) < histories.SEGMENT_BYTES + 300_000
    assert json.loads(kept.segment(0.0))["to"] < 3.0


def test_lines_are_bounded() -> None:
    kept = history(entries=100)
    for number in range(1000):
        kept.add_entry(Entry(0.1 * number, "12:00:00", "request", "text"))
    assert len(kept.entries) == 100


def test_an_empty_history_has_an_answer() -> None:
    found = json.loads(history().segment(5.0))
    assert found["frames"] == []


def test_segments_are_what_zlib_reads_anywhere() -> None:
    kept = history()
    fill(kept, 15.0, '{"t":"state"}')
    number = kept._segments[0].number
    lines = json.loads(f"[{zlib.decompress(kept.shelf.get(number)).decode()}]")
    assert [line[0] for line in lines] == sorted(line[0] for line in lines)
