"""Motion capture with real processes: datagrams in, a robot that knows where it is, and what happens without them."""

from __future__ import annotations

import json
import math
import signal
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from fullswarm.messages import RobotHealth
from tests.system.live import LiveSwarm


@pytest.fixture
def swarm() -> Iterator[LiveSwarm]:
    swarm = LiveSwarm(
        {
            "agent": {"estimator": "ekf"},
            "robot": [{"id": "r1", "driver": "null://r1", "pose": (1.0, 1.0, 0.0)}],
        },
        watch=False,
    )
    yield swarm
    swarm.close()


class Cameras:
    """Sends where the body is, a hundred times a second, in millimetres and degrees."""

    def __init__(self, swarm: LiveSwarm) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.place = (-2.0, 3.0, 90.0)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._timer = swarm.runtime.every(0.01, self._send)

    def _send(self) -> None:
        x_m, y_m, heading_deg = self.place
        found = {"name": "Rigid Body 1", "x": 1000 * x_m, "y": 1000 * y_m, "heading_deg": heading_deg, "sigma_m": 0.01}
        self._socket.sendto(json.dumps([found]).encode(), ("127.0.0.1", self.port))

    def send_rubbish(self) -> None:
        for _ in range(5):
            for data in (b"hello", b'{"name": "Rigid Body 1", "x": 0, "y": 0, "headin": 1}'):
                self._socket.sendto(data, ("127.0.0.1", self.port))

    def close(self) -> None:
        self._timer.cancel()
        self._socket.close()


@contextmanager
def source(swarm: LiveSwarm, port: int) -> Iterator[subprocess.Popen[str]]:
    """Run `fullswarm fixes`."""
    process = swarm.spawn("fixes", "--listen", f"127.0.0.1:{port}", "--map", "Rigid Body 1=r1", "--unit", "mm")
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def health(swarm: LiveSwarm) -> RobotHealth:
    found = swarm.row("r1").health
    assert found is not None
    return found


def test_a_robot_knows_where_it_is_while_somebody_sees_it(swarm: LiveSwarm) -> None:
    assert health(swarm).pose_source == "odometry"
    cameras = Cameras(swarm)
    try:
        with source(swarm, cameras.port) as process:
            swarm.until(lambda: health(swarm).pose_source == "fixes", 20.0, "the fixes are used")
            swarm.until(lambda: math.dist(at(swarm), (-2.0, 3.0)) < 0.02, 2.0, "it is where it was seen")
            assert 0.0 < health(swarm).position_sigma_m < 0.02

            cameras.place = (0.0, 3.0, 90.0)
            swarm.until(lambda: math.dist(at(swarm), (0.0, 3.0)) < 0.02, 5.0, "it is where it was carried to")
            swarm.until(lambda: "carried" in health(swarm).pose_note, 2.0, "it says so")

            process.send_signal(signal.SIGKILL)
            lost_s = swarm.until(lambda: health(swarm).pose_source == "odometry", 5.0, "the source is missed")
            assert lost_s < 2.0
            assert "stopped" in health(swarm).pose_note
            assert math.dist(at(swarm), (0.0, 3.0)) < 0.02
        with source(swarm, cameras.port) as process:
            swarm.until(lambda: health(swarm).pose_source == "fixes", 20.0, "another source is followed")
            cameras.send_rubbish()
            swarm.rest(0.3)
            process.send_signal(signal.SIGINT)
            out, errors = process.communicate(timeout=5.0)
        assert (process.returncode, out) == (130, "")
        assert errors.count("not JSON") == 2  # when it came, and in the count at the end
        assert errors.count("did you mean 'heading'?") == 1
        assert "Traceback" not in errors
    finally:
        cameras.close()


def at(swarm: LiveSwarm) -> tuple[float, float]:
    row = swarm.row("r1")
    return row.x_m, row.y_m
