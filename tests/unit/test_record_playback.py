"""A recording in the console: what pages are shown against the file as the public reader gives it."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
from mcap.reader import make_reader

from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.errors import ConfigError
from fullswarm.keys import Keys
from fullswarm.messages import BehaviourRequest, HealthReport, RobotMeasurement, RobotStates, StopRequest
from fullswarm.operator.console import frames
from fullswarm.record.decoding import Decoder
from fullswarm.record.lockstep import _TapBus
from fullswarm.record.playback import Playback, RecordedSwarm
from fullswarm.record.recorder import Recorder
from fullswarm.record.recording import Attachment, Recording
from fullswarm.runtime import Runtime
from fullswarm.schemas import tag_of
from tests.unit.console_bench import Page, health

KEYS = Keys("lab")
START_NS = 1_800_000_000_000_000_000
FLEET = b'swarm = "lab"\n[fleet]\ncount = 2\nprefix = "r"\ndriver = "sim"\n[world]\nbounds_m = [0.0, 0.0, 7.0, 6.0]\n'


def record(path: Path, seconds: float) -> None:
    """Record two robots that drive along x, a request at 5 s and a stop at 12 s."""
    runtime = Runtime(SimClock(50.0))
    bus = LocalBus(runtime.mailbox)
    recording = Recording(path, {"swarm": "lab"}, [Attachment("fleet.toml", "application/toml", FLEET)])
    recorder = Recorder(_TapBus(bus, runtime.now_s), KEYS, runtime, recording, START_NS)
    for number in range(round(seconds * 20)):
        at_s = number / 20.0
        bus.publish(
            KEYS.state("all", "h"),
            RobotStates(
                host="h", sequence=number, stamp_s=at_s, robots=("r1", "r2"), x_m=(0.1 * at_s, 1.0),
                y_m=(1.0, 0.05 * at_s), heading_rad=(0.0, 0.5), speed_m_s=(0.1, 0.05), turn_rad_s=(0.0, 0.0),
                radius_m=(0.17, 0.17),
            ),
        )  # fmt: skip
        if number % 10 == 0:
            robots = (health("r1", behaviour="flocking"), health("r2"))
            bus.publish(KEYS.health("h"), HealthReport(host="h", process="p", version="1", robots=robots))
        if number == 100:
            bus.publish(KEYS.behaviour_request, BehaviourRequest(id="a", behaviour="flocking", source="x", robots=()))
        if number == 240:
            bus.publish(KEYS.stop, StopRequest(id="b", robots=(), source="anna", stamp_s=0.0))
        runtime.run(0.05)
    recorder.close()


class Bench:
    def __init__(self, path: Path) -> None:
        self.runtime = Runtime(SimClock())
        self.playback = Playback(path, self.runtime, RecordedSwarm(path), {})

    def read(self) -> None:
        while not self.playback.read:
            self.playback.read_one()

    def look(self, page: Page, session: Any, at_s: float) -> dict[str, Any]:
        assert session.handle(frames.Look(ref=1, at=at_s), page).ok
        self.runtime.mailbox.drain()
        self.playback.timeline._serve()
        return page.last("history")


@pytest.fixture
def bench(file: Path) -> Iterator[Bench]:
    opened = Bench(file)
    yield opened
    opened.playback.close()


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recording") / "run.mcap"
    record(path, 30.0)
    return path


def places(path: Path, at_s: float) -> dict[str, tuple[float, float]]:
    """Return where the robots last were at a time from the first message on, by the public reader."""
    found: dict[str, tuple[float, float]] = {}
    with path.open("rb") as stream:
        first_ns = None
        for _, channel, message in make_reader(stream).iter_messages():
            first_ns = message.log_time if first_ns is None else first_ns
            if channel.topic.startswith("/state/") and message.log_time - first_ns <= 1e9 * at_s:
                rows = json.loads(message.data)
                found |= {robot: (rows["x_m"][k], rows["y_m"][k]) for k, robot in enumerate(rows["robots"])}
    return found


@pytest.mark.parametrize("at_s", [0.5, 9.9, 10.1, 17.3, 29.0])
def test_robots_are_where_the_file_says(bench: Bench, file: Path, at_s: float) -> None:
    bench.read()
    page = Page()
    session = bench.playback.join("key", "anna", page)
    found = bench.look(page, session, at_s)
    states = [frame for _, frame in found["frames"] if frame["t"] == "state" and frame["at"] <= at_s + 1e-6]
    shown = {row[0]: row[1:3] for row in states[-1]["robots"]}
    for robot, place in places(file, at_s).items():
        assert shown[robot] == pytest.approx(place, abs=0.02)  # kept ten times a second


def test_log_arena_and_time_of_day_are_those_of_the_recording(bench: Bench) -> None:
    bench.read()
    page = Page()
    session = bench.playback.join("key", "anna", page)
    span = page.last("timeline")
    assert (span["recording"], span["read"]) == ("run.mcap", None)
    assert span["from"] == 0.0
    assert span["to"] == pytest.approx(30.0, abs=1.0)
    assert [each["kind"] for each in page.last("events")["events"]] == ["request", "stop"]
    early, late = bench.look(page, session, 3.0), bench.look(page, session, 25.0)
    assert [entry["kind"] for entry in late["log"]] == ["request", "stop"]
    assert [round(entry["at"]) for entry in late["log"]] == [5, 12]
    world = next(frame for _, frame in early["frames"] if frame["t"] == "world")
    assert world["arena"] == [0.0, 0.0, 7.0, 6.0]
    fleet = next(frame for _, frame in late["frames"] if frame["t"] == "fleet")
    assert {row["robot"]: row["behaviour"] for row in fleet["robots"]} == {"r1": "flocking", "r2": ""}


def test_a_page_sees_how_much_has_been_read_and_what_has_been(bench: Bench) -> None:
    for _ in range(300):
        bench.playback.read_one()
    page = Page()
    session = bench.playback.join("key", "anna", page)
    span = page.last("timeline")
    assert 0.0 < span["read"] <= 1.0
    assert 3.0 < span["to"] < 20.0
    assert bench.look(page, session, 2.0)["frames"]
    bench.read()
    bench.playback._show()
    assert page.last("timeline")["read"] is None
    bench.playback.leave(session, page)
    count = len(page.frames)
    bench.playback._show()
    assert len(page.frames) == count


def test_nothing_can_be_sent_to_a_recording(bench: Bench) -> None:
    page = Page()
    session = bench.playback.join("key", "anna", page)
    request, lease = frames.Request(ref=1, behaviour="flocking"), frames.Lease(ref=1, hold=True)
    for command in (frames.Stop(ref=1), frames.Estop(ref=1), request, lease):
        answer = session.handle(command, page)
        assert not answer.ok
        assert "recording" in answer.reason


def test_what_is_no_recording_is_refused_in_words(tmp_path: Path) -> None:
    path = tmp_path / "x.mcap"
    with pytest.raises(ConfigError, match="cannot be read"):
        RecordedSwarm(path)
    path.write_bytes(b"hello")
    with pytest.raises(ConfigError, match="no MCAP file"):
        RecordedSwarm(path)
    Recording(path.with_name("empty.mcap")).close()
    with pytest.raises(ConfigError, match="no message"):
        RecordedSwarm(path.with_name("empty.mcap"))


def test_a_file_that_was_cut_off_is_shown_as_far_as_it_goes(file: Path, tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    path.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    bench = Bench(path)
    bench.read()
    assert bench.playback.timeline.history.to_s > 5.0
    bench.playback.close()


def test_segments_of_a_recording_are_not_kept_in_memory(bench: Bench) -> None:
    bench.read()
    assert bench.playback.timeline.history.size == sum(length for _, length in bench.playback._shelf._places)


def test_numbers_that_are_not_finite_come_back() -> None:
    measured = RobotMeasurement(
        host="h", process="p", robots=("r1",), columns={"c": (math.inf,)}, totals={"a": math.nan, "b": 2.0}, stamp_s=0.0
    )
    decoder, schema = Decoder(), f"fullswarm.{tag_of(RobotMeasurement)}"
    found = decoder.decode(schema, msgspec.json.encode(measured))
    assert isinstance(found, RobotMeasurement)
    assert math.isnan(found.totals["a"])
    assert found.totals["b"] == 2.0
    for garbage in (b"", b"{", b"[1]", b'{"robots": 5}', b"\xff\xfe", b"[" * 5000):
        assert decoder.decode(schema, garbage) is None
    assert decoder.decode("fullswarm.HealthReport/1", b"{}") is None
    assert decoder.unread == 7
