"""Recordings: what a kill leaves of one, what other people's readers make of it, and the recorder on a bus.

The files are read by the library's own readers, protobuf by its own decoder and JSON by `jsonschema`.
"""

from __future__ import annotations

import json
import math
import random
import struct
from collections.abc import Sequence
from io import BytesIO
from pathlib import Path
from typing import Any

import jsonschema
import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from fullswarm.bus.base import Carried, Tap, matches
from fullswarm.bus.codec import encode
from fullswarm.clock import SimClock
from fullswarm.errors import ConfigError
from fullswarm.identity.access import TOPICS
from fullswarm.keys import Keys
from fullswarm.messages import CameraPicture, Message, RangeReport, RobotStates, SeenObstacles, SensorScan
from fullswarm.record.reading import contents, repair
from fullswarm.record.recorder import FLUSH_S, LOG_BYTES, LogTail, Recorder, _schema
from fullswarm.record.recording import MOST_CHANNELS, Attachment, Recording, Schema
from fullswarm.record.scene import FRAMES_S
from fullswarm.runtime import Runtime
from tests.unit.wild import KINDS, Wild

PLAIN = Schema("plain", "", b"", "json")
START_NS = 1_790_000_000_000_000_000


def payloads(data: bytes) -> list[bytes]:
    """Return the messages of a whole file, by the library's reader with its index."""
    return [message.data for _, _, message in make_reader(BytesIO(data)).iter_messages()]


def test_what_was_flushed_survives_a_kill_at_any_later_byte(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    made = Recording(path, {"swarm": "s"})
    flushed: list[tuple[int, int]] = []  # (bytes of the file, messages in it)
    for number in range(60):
        made.write(f"/t{number % 3}", "r1", PLAIN, START_NS + number, b"%d" % number)
        if number % 7 == 6:
            made.flush()
            flushed.append((path.stat().st_size, number + 1))
    made.close()
    whole = path.read_bytes()
    cut, out = tmp_path / "cut.mcap", tmp_path / "out.mcap"
    for size in range(flushed[0][0], len(whole), 97):
        cut.write_bytes(whole[:size])
        out.unlink(missing_ok=True)
        found = repair(cut, out)
        least = max(count for at, count in flushed if at <= size)
        assert found.whole
        assert payloads(out.read_bytes())[:least] == [b"%d" % number for number in range(least)]
        assert contents(cut).messages >= least
        assert not contents(cut).whole or size == len(whole)


@given(st.binary(max_size=400), st.integers(0, 2000))
@settings(max_examples=60, deadline=None)
def test_damaged_bytes_give_what_came_before_them_or_one_error(garbage: bytes, at: int) -> None:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.mcap"
        made = Recording(path)
        for number in range(100):
            made.write("/t", "", PLAIN, START_NS + number, b"%d" % number)
            made.flush()
        made.close()
        data = path.read_bytes()
        path.write_bytes(data[: at % len(data)] + garbage)
        try:
            read = contents(path).messages
            kept = payloads_of_repair(path)
        except ConfigError:
            return
        assert kept == [b"%d" % number for number in range(len(kept))][:read]


def payloads_of_repair(path: Path) -> list[bytes]:
    out = path.with_name("out.mcap")
    repair(path, out)
    return payloads(out.read_bytes())


def test_each_file_of_a_long_recording_can_be_read_by_itself_and_old_ones_go(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    fleet = Attachment("fleet.toml", "application/toml", b"swarm = 1")
    chance = random.Random(1)
    made = Recording(path, {"swarm": "s"}, [fleet], limit_bytes=20_000, keep=2)
    for number in range(200):
        made.write("/t", "r1", PLAIN, START_NS + number, chance.randbytes(600))
        made.flush()
    made.close()
    left = sorted(tmp_path.iterdir())
    assert len(made.files) > 3
    assert left == sorted(made.files[-2:])
    for each in left:
        found = contents(each)
        assert found.whole
        assert found.messages
        assert found.attachments == {"fleet.toml": 9}
        assert found.about["fullswarm"]["swarm"] == "s"


def test_a_recording_never_overwrites_and_says_where_it_cannot_write(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    Recording(path).close()
    with pytest.raises(ConfigError, match="there already"):
        Recording(path)
    with pytest.raises(ConfigError, match=r"cannot record|Not a directory"):
        Recording(path / "below" / "run.mcap")
    with pytest.raises(ConfigError, match="no MCAP file"):
        contents(Path(__file__))
    with pytest.raises(ConfigError, match="cannot be read"):
        contents(tmp_path / "none.mcap")
    with pytest.raises(ConfigError, match="there already"):
        repair(path, path)


def test_invented_keys_do_not_fill_the_memory(tmp_path: Path) -> None:
    made = Recording(tmp_path / "run.mcap")
    for number in range(MOST_CHANNELS + 5):
        made.write(f"/t{number}", "", PLAIN, START_NS, b"{}")
    assert (made.messages, made.refused) == (MOST_CHANNELS, 5)
    made.close()


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_every_message_fits_its_json_schema(kind: type[Message]) -> None:
    import msgspec

    schema = json.loads(_schema(kind).data)
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    wild = Wild(3, ("r1", "core"), misfits=0.0)
    for _ in range(20):
        validator.validate(json.loads(msgspec.json.encode(wild.message(kind))))
    with pytest.raises(jsonschema.ValidationError):
        validator.validate({"kind": "Nothing/1"})


class Air:
    """A bus on which a test says what is heard."""

    def __init__(self, runtime: Runtime) -> None:
        self.runtime, self.dropped, self.open = runtime, 7, True
        self.expressions: list[str] = []
        self.heard: list[Carried] = []

    def tap(self, expressions: Sequence[str]) -> Tap:
        self.expressions = list(expressions)
        return self

    def take(self) -> list[Carried]:
        heard, self.heard = self.heard, []
        return heard

    def close(self) -> None:
        self.open = False

    def say(self, key: str, message: Message | bytes, sender: str = "r1") -> None:
        data = message if isinstance(message, bytes) else encode(message)
        self.heard += [
            Carried(number, self.runtime.now_s(), key, sender, data)
            for number, expression in enumerate(self.expressions)
            if matches(expression, key)
        ]


class Rig:
    """A recorder on the air, in simulated time."""

    def __init__(self, folder: Path, logs: Path | None = None) -> None:
        self.runtime, self.path = Runtime(SimClock()), folder / "run.mcap"
        self.air = Air(self.runtime)
        self.recording = Recording(self.path)
        self.failures: list[str] = []
        self.recorder = Recorder(
            self.air, Keys("s"), self.runtime, self.recording, START_NS, logs, self.failures.append
        )

    def read(self) -> dict[str, list[tuple[int, Any]]]:
        """Close, and return (time, decoded message) by topic."""
        self.recorder.close()
        found: dict[str, list[tuple[int, Any]]] = {}
        reader = make_reader(BytesIO(self.path.read_bytes()), decoder_factories=[DecoderFactory()])
        for schema, channel, message in reader.iter_messages():
            if channel.message_encoding == "json":
                decoded: Any = json.loads(message.data)
            else:
                assert schema is not None
                decoded = DecoderFactory().decoder_for("protobuf", schema)(message.data)  # type: ignore[misc]
            found.setdefault(channel.topic, []).append((message.log_time, decoded))
        return found


def states(x_m: float, robots: tuple[str, ...] = ("r1",)) -> RobotStates:
    many = len(robots)
    return RobotStates(
        host=robots[0], sequence=1, stamp_s=0.0, robots=robots, x_m=(x_m,) * many, y_m=(2.0,) * many,
        heading_rad=(1.0,) * many, speed_m_s=(0.0,) * many, turn_rad_s=(0.0,) * many, radius_m=(0.17,) * many,
    )  # fmt: skip


def test_a_recorder_writes_messages_and_what_viewers_draw_of_them(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    for step in range(8):
        rig.air.say("s/state/all/r1", states(1.0 + step))
        rig.runtime.run(0.1)
    rig.air.say("s/obstacles/r1", SeenObstacles(host="r1", rows=((1.0, 2.0, 0.5, 0.25, 0.0, 0.1),), stamp_s=0.0))
    rig.air.say("s/camera/hall", CameraPicture(camera="hall", jpeg=b"\xff\xd8"))
    rig.air.say("other/state/all/r1", states(9.0))
    rig.air.say("s/state/all/r1", b"garbage")
    rig.runtime.run(1.5)
    found = rig.read()
    recorded = found["/state/all/r1"]
    assert [each["x_m"] for _, each in recorded] == [[1.0 + step] for step in range(8)]
    assert [round(1e-9 * (at - START_NS), 3) for at, _ in recorded] == [round(0.1 * step, 3) for step in range(8)]
    frames = [each.transforms[0] for _, each in found["/tf"]]
    assert [(each.child_frame_id, each.parent_frame_id, each.translation.x) for each in frames] == [
        ("r1", "world", 1.0 + step) for step in range(8)
    ]
    assert frames[0].rotation.z == pytest.approx(0.479425538604203)  # sin(1/2)
    last = found["/scene"][-1][1].entities
    assert [(each.id, each.frame_id) for each in last] == [("robot r1", "r1"), ("obstacles", "world")]
    assert last[0].cylinders[0].size.x == pytest.approx(0.34)
    assert (last[1].cubes[0].size.x, last[1].cubes[0].size.y) == pytest.approx((1.2, 0.7))
    assert found["/camera/hall"][0][1].data == b"\xff\xd8"
    assert rig.recorder.strange == 1
    assert contents(rig.path).about["fullswarm.end"] == {"dropped": "7", "strange": "1", "refused": "0"}
    assert not rig.failures


def test_frames_of_robots_that_send_at_about_the_same_time_are_one_message(tmp_path: Path) -> None:
    rig, names = Rig(tmp_path), [f"r{number}" for number in range(1, 9)]
    for step in range(20):
        for name in names:
            state = msgspec.structs.replace(states(1.0 + step), robots=(name,), host=name)
            rig.air.say(f"s/state/all/{name}", state)
            rig.runtime.run(0.05 / len(names))
    rig.runtime.run(1.0)
    found = rig.read()
    assert [len(found[f"/state/all/{name}"]) for name in names] == [20] * 8
    drawn = [each for _, message in found["/tf"] for each in message.transforms]
    assert sorted((each.child_frame_id, each.translation.x) for each in drawn) == sorted(
        (name, 1.0 + step) for step in range(20) for name in names
    )
    assert len(found["/tf"]) <= 25
    lags_s = [
        1e-9 * (at - each.timestamp.seconds * 10**9 - each.timestamp.nanos)
        for at, message in found["/tf"]
        for each in message.transforms
    ]
    assert min(lags_s) >= 0.0
    assert max(lags_s) <= FRAMES_S + 0.05


def test_a_scan_is_recorded_once_as_viewers_show_it(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    scan = SensorScan(
        sensor="front", mount=(0.1, 0.2, 1.0), robot_at=None, first_rad=-0.5, step_rad=0.25,
        distances=struct.pack("<3H", 1234, 65534, 65535), max_m=4.0, stamp_s=6.9,
    )  # fmt: skip
    rig.air.say("s/range/report/r1", RangeReport(robot="r1", scans=(scan,), stamp_s=7.0))
    rig.runtime.run(0.5)
    found = rig.read()
    assert [topic for topic in found if "r1" in topic] == ["/scan/r1/front"]
    ((_, drawn),) = found["/scan/r1/front"]
    assert (drawn.frame_id, drawn.start_angle, drawn.end_angle) == ("r1", -0.5, 0.0)
    assert (drawn.pose.position.x, drawn.pose.position.y) == (0.1, 0.2)
    assert list(drawn.ranges) == pytest.approx([1.234, math.inf, math.nan], nan_ok=True)
    assert drawn.timestamp.seconds * 10**9 + drawn.timestamp.nanos == START_NS - 100_000_000


def test_a_robot_that_is_gone_is_drawn_no_more(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.air.say("s/state/all/r1", states(1.0))
    rig.runtime.run(20.0)
    scenes = [[each.id for each in scene.entities] for _, scene in rig.read()["/scene"]]
    assert scenes[0] == ["robot r1", "obstacles"]
    assert scenes[-1] == ["obstacles"]


def test_all_that_an_observer_may_receive_is_recorded(tmp_path: Path) -> None:
    rig, wild = Rig(tmp_path), Wild(5, ("r1", "core"), misfits=0.0)
    sent: dict[str, int] = {}
    for topic in TOPICS:
        for kind in topic.messages:
            key = topic.expression("r1").replace("*", "a")
            rig.air.say(f"s/{key}", wild.message(kind))
            if "observer" in topic.receive and kind not in (CameraPicture, RangeReport):
                sent[f"/{key}"] = sent.get(f"/{key}", 0) + 1
    rig.runtime.run(1.0)
    found = {topic: len(each) for topic, each in rig.read().items() if topic not in ("/tf", "/scene", "/robots")}
    assert {topic: count for topic, count in found.items() if not topic.startswith(("/camera/", "/scan/"))} == sent
    assert rig.recorder.strange == 0


def test_a_full_disk_ends_the_recording_and_is_said_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rig = Rig(tmp_path)

    def full() -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Recording, "flush", lambda _: full())
    rig.air.say("s/state/all/r1", states(1.0))
    rig.runtime.run(5 * FLUSH_S)
    rig.air.say("s/state/all/r1", states(1.0))
    rig.recorder.close()
    assert rig.failures == ["the recording ends here: No space left on device"]
    assert rig.recorder.failed


def test_a_next_file_that_is_there_already_ends_the_recording_with_its_name(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.recording.limit_bytes = 1
    (tmp_path / "run.2.mcap").touch()
    rig.air.say("s/state/all/r1", states(1.0))
    rig.runtime.run(5 * FLUSH_S)
    assert len(rig.failures) == 1
    assert "run.2.mcap: this file is there already" in rig.failures[0]
    assert contents(rig.path).whole


def test_logs_are_recorded_from_now_on_line_by_line(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    core, robot = logs / "core.log", logs / "r1.log"
    core.write_text("before\n")
    rig = Rig(tmp_path, logs)
    with core.open("a") as file:
        file.write("2026-11-27 09:00:00 [warning  ] a robot is gone   robot=r1\nhalf a ")
    robot.write_text("Traceback\n")
    rig.runtime.run(FLUSH_S)
    with core.open("a") as file:
        file.write("line\n")
    rig.runtime.run(FLUSH_S)
    core.write_text("anew\n")  # a log that became too long begins anew
    rig.runtime.run(FLUSH_S)
    lines = [(each.name, each.level, each.message) for _, each in rig.read()["/log"]]
    assert lines == [
        ("core", 3, "2026-11-27 09:00:00 [warning  ] a robot is gone   robot=r1"),
        ("r1", 0, "Traceback"),
        ("core", 0, "half a line"),
        ("core", 0, "anew"),
    ]


def test_a_log_without_an_end_does_not_hold_the_recorder_up(tmp_path: Path) -> None:
    tail = LogTail(tmp_path)
    log = tmp_path / "core.log"
    log.write_bytes(b"x" * (3 * LOG_BYTES) + b"\nlast\n")
    found = [line for _ in range(6) for line in tail.read()]
    assert found[-1] == ("core", "last")
