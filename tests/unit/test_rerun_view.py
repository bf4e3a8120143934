"""What Rerun gets of a swarm: written into its own file format, read back with its own reader."""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import rerun as rr
from rerun.chunk import RrdReader
from typer.testing import CliRunner

from fullswarm.bus import LocalBus
from fullswarm.cli.main import app
from fullswarm.clock import SimClock
from fullswarm.keys import Keys
from fullswarm.messages import CameraPicture, Message, RangeReport, RequestStatus, SeenObstacles, SensorScan
from fullswarm.record.layout import MOST_SERIES
from fullswarm.record.rerun_view import MARGIN_M, RerunView, blueprint
from fullswarm.runtime import Mailbox, Runtime
from tests.unit.test_recording import START_NS, Rig, states
from tests.unit.test_viewer import health

KEYS = Keys("s")


class Stage:
    """A view in simulated time that draws into a file."""

    def __init__(self, folder: Path, logs: Path | None = None) -> None:
        self.path, self.runtime = folder / "run.rrd", Runtime(SimClock(), Mailbox())
        self.bus = LocalBus(self.runtime.mailbox)
        self.stream = rr.RecordingStream("test")
        self.stream.save(self.path)
        self.view = RerunView(self.bus, KEYS, self.runtime, self.stream, self.wall_s, logs)

    def wall_s(self) -> float:
        return 1e-9 * START_NS + self.runtime.now_s()

    def say(self, key: str, message: Message, run_s: float = 0.1) -> None:
        self.bus.publish(key, message)
        self.runtime.run(run_s)

    def read(self) -> dict[str, list[dict[str, Any]]]:
        """Close, and return the rows of each entity in the order of time, without Rerun's own columns."""
        self.view.close()
        self.stream.disconnect()
        return rows_of(self.path)


def rows_of(path: Path) -> dict[str, list[dict[str, Any]]]:
    found: dict[str, list[dict[str, Any]]] = {}
    for chunk in RrdReader(path).stream():
        for row in chunk.to_record_batch().to_pylist():
            named = {name.rpartition(":")[2]: value for name, value in row.items() if value is not None}
            found.setdefault(chunk.entity_path, []).append(named)
    for rows in found.values():
        rows.sort(key=lambda row: row["time"].timestamp() if "time" in row else 0.0)
    return found


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    made = Stage(tmp_path)
    yield made
    made.stream.disconnect()


def seconds(row: dict[str, Any]) -> float:
    """Return when a row was drawn, from the beginning."""
    return float(row["time"].timestamp()) - 1e-9 * START_NS


def test_robots_are_drawn_where_they_are_with_their_names_and_headings(stage: Stage) -> None:
    for step in range(5):
        stage.say(KEYS.state("all", "r1"), states(1.0 + step, ("r1", "r2")))
        stage.say(KEYS.state("all", "r3"), msgspec.structs.replace(states(9.0, ("r3",)), sequence=step))
    found = stage.read()
    last = found["/world/robots"][-1]
    assert last["labels"] == ["r1", "r2", "r3"]
    assert [each[:2] for each in last["centers"]] == [[5.0, 2.0], [5.0, 2.0], [9.0, 2.0]]
    assert last["radii"] == pytest.approx([0.17] * 3)
    assert len(set(last["colors"])) == 3
    arrow = found["/world/headings"][-1]
    assert arrow["vectors"][0] == pytest.approx([1.6 * 0.17 * math.cos(1.0), 1.6 * 0.17 * math.sin(1.0), 0.0])
    assert [seconds(row) for row in found["/world/robots"]] == sorted({seconds(row) for row in found["/world/robots"]})
    assert 0.0 <= seconds(last) <= 1.1


def test_a_robot_that_is_silent_or_nowhere_is_not_drawn(stage: Stage) -> None:
    stage.say(KEYS.state("all", "r1"), states(1.0, ("r1",)))
    stage.say(KEYS.state("all", "r2"), states(math.nan, ("r2",)))
    stage.runtime.run(15.0)
    found = stage.read()["/world/robots"]
    assert found[0]["labels"] == ["r1"]
    assert found[-1]["labels"] == []
    assert 9.0 < seconds(found[-1]) < 11.0
    assert len(found) < 5  # nothing is drawn while nothing moves


def test_charts_have_a_series_per_robot(stage: Stage) -> None:
    robots = tuple(f"r{number}" for number in range(MOST_SERIES + 5))
    state = msgspec.structs.replace(states(1.0, robots), speed_m_s=tuple(0.01 * row for row in range(len(robots))))
    stage.say(KEYS.state("all", "r1"), state)
    stage.say(KEYS.health("r3"), health("r3", battery=0.5, deviation_m_s=0.2))
    stage.say(KEYS.health("r4"), health("r4"), run_s=1.0)
    found = stage.read()
    assert len([name for name in found if name.startswith("/speed/")]) == MOST_SERIES
    assert found["/speed/r7"][-1]["scalars"] == pytest.approx([0.07])
    assert found["/battery/r3"][-1]["scalars"] == pytest.approx([0.5])
    assert found["/deviation/r3"][-1]["scalars"] == pytest.approx([0.2])
    assert "/battery/r4" not in found  # it is not known


def test_obstacles_scans_pictures_and_requests_are_drawn(stage: Stage, tmp_path: Path) -> None:
    row = (1.0, 2.0, 0.5, 0.25, 0.5 * math.pi, 0.1)
    stage.say(KEYS.obstacles("r1"), SeenObstacles(host="r1", rows=(row,), stamp_s=0.0), run_s=1.5)
    # Robot at (4, 1) and looks north, sensor 0.1 m ahead of its middle: the middle ray hits at (4, 2.1).
    scan = SensorScan(
        sensor="front", mount=(0.1, 0.0, 0.0), robot_at=(4.0, 1.0, 0.5 * math.pi), first_rad=-0.5 * math.pi,
        step_rad=0.5 * math.pi, distances=struct.pack("<3H", 2000, 1000, 65534), max_m=4.0, stamp_s=0.0,
    )  # fmt: skip
    stage.say(KEYS.range_report("r1"), RangeReport(robot="r1", scans=(scan,), stamp_s=0.0))
    stage.say(KEYS.camera("hall"), CameraPicture(camera="hall", jpeg=b"\xff\xd8picture"))
    stage.say(KEYS.behaviour_status, RequestStatus(request_id="q", behaviour="flocking", phase="refused", reason="no"))
    found = stage.read()
    box = found["/world/obstacles"][-1]
    assert box["centers"][0][:2] == [1.0, 2.0]
    assert box["half_sizes"][0][:2] == pytest.approx([0.6, 0.35])
    assert box["quaternions"][0] == pytest.approx([0.0, 0.0, math.sqrt(0.5), math.sqrt(0.5)])
    points = found["/world/scans/r1/front"][-1]["positions"]
    assert [each[:2] for each in points] == [pytest.approx([6.0, 1.1]), pytest.approx([4.0, 2.1])]
    assert bytes(found["/camera/hall"][-1]["blob"][0]) == b"\xff\xd8picture"
    assert found["/log/requests"][-1]["text"] == ["flocking (no robot): refused; no"]
    assert found["/log/requests"][-1]["level"] == ["WARN"]


def test_lines_of_the_processes_logs_are_drawn(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    stage = Stage(tmp_path, logs)
    (logs / "core.log").write_text("2026-11-27 09:00:00 [warning  ] out of room\n")
    stage.runtime.run(2.5)
    (row,) = stage.read()["/log/core"]
    assert (row["text"], row["level"]) == (["2026-11-27 09:00:00 [warning  ] out of room"], ["WARN"])


def test_the_arena_is_around_what_was_driven_through(stage: Stage) -> None:
    for x_m in (1.0, 8.0):
        stage.say(KEYS.state("all", "r1"), msgspec.structs.replace(states(x_m), sequence=round(x_m)))
    stage.say(KEYS.camera("hall"), CameraPicture(camera="hall", jpeg=b"\xff\xd8"))
    contents = stage.view.contents()
    assert (contents.robots, contents.cameras) == (("r1",), ("hall",))
    found = contents.arena
    assert (found.x_min_m, found.y_min_m) == pytest.approx((1.0 - MARGIN_M, 2.0 - MARGIN_M))
    assert (found.x_max_m, found.y_max_m) == pytest.approx((8.0 + MARGIN_M, 2.0 + MARGIN_M))
    stage.stream.send_blueprint(blueprint(contents))
    stage.read()
    assert RrdReader(stage.path).blueprints()


def recording(folder: Path) -> Path:
    """Return a recording of a robot that drives from x = 1 to 10 m in 0.9 s."""
    rig = Rig(folder)
    for step in range(10):
        rig.air.say("s/state/all/r1", msgspec.structs.replace(states(1.0 + step), sequence=step))
        rig.runtime.run(0.1)
    rig.read()
    return rig.path


def test_a_recording_is_drawn_into_a_file(tmp_path: Path) -> None:
    out = tmp_path / "out.rrd"
    result = CliRunner().invoke(app, ["viewer", "rerun", str(recording(tmp_path)), "--save", str(out)])
    assert (result.exit_code, result.stdout.strip()) == (0, str(out))
    rows = rows_of(out)["/world/robots"]
    assert [row["centers"][0][0] for row in rows] == [1.0 + step for step in range(10)]
    assert [seconds(row) for row in rows] == pytest.approx([0.1 * step for step in range(10)], abs=0.06)
    assert RrdReader(out).blueprints()


def test_what_cannot_be_done_is_refused_in_words(tmp_path: Path) -> None:
    run, out = recording(tmp_path), tmp_path / "out.rrd"
    out.write_text("mine")
    for options, said in (
        (("--save", str(out)), "there already"),
        (("--save", str(tmp_path / "none" / "a.rrd")), "cannot be written"),
        (("--save", "a.rrd", "--connect", "127.0.0.1:9876"), "leave one out"),
        (("--connect", "http://127.0.0.1:9876"), "no address of a viewer"),
    ):
        result = CliRunner().invoke(app, ["viewer", "rerun", str(run), *options])
        assert result.exit_code == 2, result.output
        assert said in result.stderr
        assert "Traceback" not in result.stderr
    assert out.read_text() == "mine"
