"""Cameras at real ports: a stream that is lost comes back, the live picture is served, a video is judged."""

from __future__ import annotations

import http.client
import json
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import numpy as np
import pytest

from fullswarm.clock import MonotonicClock
from fullswarm.errors import ConfigError
from fullswarm.localization.camera import run
from fullswarm.localization.camera.camera_file import write_camera
from fullswarm.localization.camera.plan import plan_of
from fullswarm.localization.camera.preview import Preview
from fullswarm.localization.camera.sources import LiveSource, Shot, recorded
from fullswarm.runtime import Mailbox, Runtime
from tests.unit import camera_lab as lab

cv2 = pytest.importorskip("cv2")
DEADLINE_S = 30.0


class MjpegCamera:
    """A network camera: JPEG pictures over HTTP, one after the other, each of another grey."""

    def __init__(self, port: int = 0) -> None:
        self.ending = threading.Event()
        camera = self

        class Handler(BaseHTTPRequestHandler):
            def do_GET(self) -> None:
                self.send_response(200)
                self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=b")
                self.end_headers()
                number = 0
                while not camera.ending.wait(0.02):
                    number += 1
                    _, data = cv2.imencode(".jpg", np.full((120, 160), number % 200, np.uint8))
                    head = f"--b\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n".encode()
                    try:
                        self.wfile.write(head + data.tobytes() + b"\r\n")
                    except OSError:
                        return

            def log_message(self, *_: object) -> None:
                pass

        ThreadingHTTPServer.allow_reuse_address = True
        self.server = ThreadingHTTPServer(("127.0.0.1", port), Handler)
        self.server.daemon_threads = True
        self.port = self.server.server_address[1]
        threading.Thread(target=self.server.serve_forever, args=(0.05,), daemon=True).start()

    def close(self) -> None:
        self.ending.set()
        self.server.shutdown()
        self.server.server_close()


def until(runtime: Runtime, shots: list[Shot], count: int) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while len(shots) < count:
        assert time.monotonic() < deadline, f"{len(shots)} of {count} pictures"
        runtime.run(0.1)


def said(source: LiveSource) -> str:
    return source.problem  # of its thread: a type checker must not take it for unchanged


def test_a_lost_stream_is_reported_and_opened_again() -> None:
    camera, runtime = MjpegCamera(), Runtime(MonotonicClock(), Mailbox())
    shots: list[Shot] = []
    source = LiveSource(f"http://127.0.0.1:{camera.port}/", runtime.clock, runtime.mailbox, shots.append, rate_hz=50.0)
    assert "no picture yet" in source.problem
    source.start()
    try:
        until(runtime, shots, 5)
        assert not said(source)
        assert shots[-1].grey.shape == (120, 160)
        assert [each.time_s for each in shots] == sorted(each.time_s for each in shots)
        camera.close()
        deadline = time.monotonic() + DEADLINE_S
        while not said(source):
            assert time.monotonic() < deadline
            runtime.run(0.1)
        camera, count = MjpegCamera(camera.port), len(shots)
        until(runtime, shots, count + 5)
        assert not said(source)
    finally:
        source.close()
        camera.close()


@pytest.fixture
def preview() -> Iterator[Preview]:
    served = Preview("127.0.0.1:0")
    yield served
    served.close()


def fetch(preview: Preview, path: str, host: str = "") -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(urlsplit(preview.address).netloc, timeout=10)
    connection.request("GET", path, headers={"Host": host} if host else {})
    return connection.getresponse()


def test_the_live_picture_is_served_while_somebody_looks(preview: Preview) -> None:
    before = preview.watched
    response = fetch(preview, "/stream.mjpg")
    assert response.headers["Content-Type"].startswith("multipart/x-mixed-replace")
    assert (before, preview.watched) == (False, True)
    preview.show(b"\xff\xd8 first")
    head = response.fp.readline() + response.fp.readline() + response.fp.readline() + response.fp.readline()
    assert b"Content-Length: 8" in head
    assert response.fp.read(8) == b"\xff\xd8 first"
    response.close()


def test_another_site_cannot_read_the_picture(preview: Preview) -> None:
    assert fetch(preview, "/", host="evil.example:80").status == 403
    assert fetch(preview, "/").status == 200
    assert fetch(preview, "/etc/passwd").status == 404


def test_it_is_not_served_to_the_network_by_accident() -> None:
    with pytest.raises(ConfigError, match="open to the network"):
        Preview("0.0.0.0:0")


def video(path: Path, frames: int) -> None:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 20.0, lab.SIZE, False)
    for number in range(frames):
        writer.write(lab.pictures().picture(lab.in_circles(number / 20.0), {}))
    writer.release()


def test_a_video_is_judged_line_by_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    video(tmp_path / "v.avi", 6)
    write_camera(lab.calibrated(), tmp_path / "c.toml")
    code = run.judge(str(tmp_path / "v.avi"), lab.calibrated(), "c.toml", plan_of(lab.fleet()), as_json=True)
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert code == 0
    assert len(lines) == 6 * 8
    for line in lines:
        truth = lab.in_circles(line["frame"] / 20.0)[line["robot"]]
        assert line["time_s"] == pytest.approx(line["frame"] / 20.0)
        assert lab.away_m(truth, line["x_m"], line["y_m"]) < 0.01
        assert lab.turned_rad(truth, line["heading_rad"]) < 0.05
        assert 0.0 < line["sigma_m"] < 0.02
        assert 0.0 < line["quality"] <= 1.0


def test_a_file_that_is_no_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "v.mp4").write_bytes(b"no video")
    with pytest.raises(ConfigError, match="no video that can be read"):
        list(recorded(str(tmp_path / "v.mp4")))
    with pytest.raises(ConfigError, match="no such file"):
        list(recorded(str(tmp_path / "w.mp4")))
