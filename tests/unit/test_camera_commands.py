"""`fullswarm track`: the commands from an empty folder to a calibrated camera, the node of a camera, the sheets."""

from __future__ import annotations

import re
import zlib
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fullswarm.bus import LocalBus
from fullswarm.cli.main import app
from fullswarm.clock import SimClock
from fullswarm.config import load_swarm
from fullswarm.errors import ConfigError
from fullswarm.keys import Keys
from fullswarm.localization.camera.node import CameraNode, Show
from fullswarm.localization.camera.plan import plan_of
from fullswarm.localization.camera.rehearsal import SimulatedCamera
from fullswarm.localization.camera.sources import Shot
from fullswarm.localization.publisher import FixPublisher, Names
from fullswarm.messages import CameraPicture, FixSourceReport, PoseFix
from fullswarm.runtime import Mailbox, Runtime
from tests.unit import camera_lab as lab

pytest.importorskip("cv2")


def track(*words: str) -> str:
    result = CliRunner().invoke(app, ["track", *words])
    assert result.exit_code == 0, result.output
    return result.output


def failing(*words: str) -> str:
    result = CliRunner().invoke(app, ["track", *words])
    assert result.exit_code == 2, result.output
    return result.output


def test_from_an_empty_folder_to_a_calibrated_camera(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    track("init", "lab.toml", "--robots", "8", "--emulate", "create2")
    track("sheets", "lab.toml")
    source = "world://?width=960&high=540&focal_px=550"
    track("calibrate", "lens", "lab.toml", "--source", source)
    assert "m above the floor" in track("calibrate", "floor", "lab.toml", "--source", source)
    assert (tmp_path / "camera-ceiling.toml").exists()
    config = load_swarm(tmp_path / "lab.toml")
    assert config.camera[0].calibration == tmp_path / "camera-ceiling.toml"
    assert len(plan_of(config).robots) == 8
    assert len(plan_of(config).floor) == 6


def test_mistakes_are_answered_with_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    track("init", "lab.toml")
    assert "is there already" in failing("init", "lab.toml")
    assert "calibrate lens" in failing("run", "lab.toml")
    assert "no room" in failing("init", "b.toml", "--robots", "60", "--floor", "2x2")
    assert "did you mean 'ceiling'" in failing("calibrate", "lens", "lab.toml", "--camera", "celing")
    assert "known: a4, letter" in failing("sheets", "--paper", "a5")
    assert "--video" in failing()
    with pytest.raises(ConfigError, match="unknown setting 'heigth_m'"):
        SimulatedCamera.of_url("world://?heigth_m=3")


def test_two_things_cannot_have_one_tag(tmp_path: Path) -> None:
    file = tmp_path / "lab.toml"
    file.write_text('[[robot]]\nid = "a"\n[[robot]]\nid = "b"\ntag = 1\n')
    with pytest.raises(ConfigError, match="tag 1 is on robot a as well"):
        plan_of(load_swarm(file))


def inflated(pdf: bytes) -> list[bytes]:
    """Return the content of each compressed stream of a PDF."""
    found = []
    for part in re.findall(rb"stream\r?\n(.*?)endstream", pdf, re.DOTALL):
        try:
            found.append(zlib.decompress(part))
        except zlib.error:
            continue
    return found


def test_the_sheets_are_true_to_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The PDF itself is read: sizes of the pages, and of the pictures on them, in points of 1/72 inch."""
    monkeypatch.chdir(tmp_path)
    track("sheets", "--robots", "2", "--out", "s.pdf", "--tag-size-m", "0.1")
    pdf = (tmp_path / "s.pdf").read_bytes()
    point_mm = 25.4 / 72.0
    pages = {
        tuple(round(float(each) * point_mm) for each in box.split()[2:])
        for box in re.findall(rb"/MediaBox \[([^\]]*)\]", pdf)
    }
    assert pages == {(210, 297), (297, 210)}
    scales = re.findall(
        rb"([\d.]+) 0 0 -?([\d.]+) [\d.]+ [\d.]+ cm /\w+ Do", b" ".join(b" ".join(inflated(pdf)).split())
    )
    sizes_mm = sorted({tuple(round(float(each) * point_mm, 1) for each in scale) for scale in scales})
    assert sizes_mm == [(100.0, 100.0), (140.0, 140.0), (238.0, 170.0)]  # robots, floor, board of 7 by 5 squares


class Bench:
    """A camera's node with a bus, on a simulated clock."""

    def __init__(self) -> None:
        self.runtime = Runtime(SimClock(), Mailbox())
        self.bus = LocalBus(self.runtime.mailbox)
        self.fixes: list[PoseFix] = []
        self.reports: list[FixSourceReport] = []
        self.pictures: list[CameraPicture] = []
        keys = Keys("swarm")
        self.bus.subscribe(keys.pose_fix(), PoseFix, self.fixes.append)
        self.bus.subscribe(keys.fix_source(), FixSourceReport, self.reports.append)
        self.bus.subscribe(keys.camera(), CameraPicture, self.pictures.append)
        publisher = FixPublisher(self.bus, self.runtime, keys, Names(), sensor="camera ceiling")
        self.node = CameraNode(
            self.bus, self.runtime, keys, publisher, "ceiling", lab.calibrated(), "c.toml", plan_of(lab.fleet()),
            lambda: "the cable is out", Show(),
        )  # fmt: skip

    def look(self, number: int, time_s: float | None = None) -> None:
        self.runtime.run(0.05)
        stamp_s = self.runtime.now_s() if time_s is None else time_s
        self.node.take(Shot(lab.pictures().picture(lab.in_circles(number / 20.0), {}), stamp_s, number))
        self.runtime.mailbox.drain()


def test_fixes_carry_covariance_marker_and_the_time_of_the_exposure() -> None:
    bench = Bench()
    bench.look(0, time_s=0.02)
    assert {fix.robot for fix in bench.fixes} == {f"r{n}" for n in range(1, 9)}
    fix = next(each for each in bench.fixes if each.robot == "r3")
    assert (fix.marker, fix.sensor, fix.stamp_s) == ("tag 3", "camera ceiling", 0.02)
    assert fix.covariance_m2 is not None
    assert 0.001**2 < fix.covariance_m2[0] < 0.02**2
    assert 0.3 < fix.quality <= 1.0
    assert bench.pictures[0].jpeg.startswith(b"\xff\xd8")


def test_a_source_that_gives_no_picture_or_always_the_same_is_reported() -> None:
    bench = Bench()
    bench.look(0)
    bench.runtime.run(3.5)
    assert bench.reports[-1].problem == "the cable is out"
    assert min(bench.reports[-1].unseen_s) >= 2.0
    frozen = Shot(lab.pictures().picture(lab.in_circles(0.0), {}), 0.0)
    for _ in range(60):
        bench.runtime.run(0.05)
        bench.node.take(frozen)
    count = len(bench.fixes)
    bench.node.take(frozen)
    bench.runtime.mailbox.drain()
    assert bench.reports[-1].problem == "the source repeats the same picture: no fixes"
    assert len(bench.fixes) == count
    bench.look(1)
    bench.look(2)
    assert bench.reports[-1].problem == ""
    assert len(bench.fixes) > count
