"""`fullswarm fixes record` and `fixes play` as processes on real ports; a receiver's bytes over TCP."""

from __future__ import annotations

import math
import subprocess
import sys
from pathlib import Path

import pytest

from fullswarm.clock import MonotonicClock
from fullswarm.emulators.mocap.player import read_recording
from fullswarm.emulators.mocap.raw import RawServer
from fullswarm.localization.schemes import open_source
from fullswarm.localization.sighting import Sighting
from fullswarm.localization.source import Content, Settings
from tests.emulated.test_mocap_protocols import Heard, wait_for
from tests.unit.test_fixes_gnss import ORIGIN, gga


def play(path: Path, *options: str) -> tuple[subprocess.Popen[str], str]:
    """Start a player; return it and where it can be reached."""
    command = [sys.executable, "-m", "fullswarm", "fixes", "play", str(path), "--loop", *options]
    player = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    assert player.stderr is not None
    return player, player.stderr.readline().partition(" at ")[2].partition(";")[0]


def record(path: Path, url: str) -> None:
    command = [sys.executable, "-m", "fullswarm", "fixes", "record", "--source", url, "--axes", "z-up"]
    done = subprocess.run([*command, "--seconds", "8", "--out", str(path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("protocol", ["natnet", "qualisys", "vrpn"])
def test_a_recording_that_is_played_is_recorded_again(tmp_path: Path, protocol: str) -> None:
    first, second = tmp_path / "first.jsonl", tmp_path / "second.jsonl"
    quaternion = f"[0, 0, {math.sin(0.3)}, {math.cos(0.3)}]"
    body = f'{{"name": "Body A", "position": [1.25, -2.0, 0.5], "quaternion": {quaternion}}}'
    head = '{"fullswarm_fixes": 1, "source": "natnet://10.0.0.1", "axes": "z-up", "unit_m": 1.0}'
    first.write_text("\n".join([head, *(f'{{"t": {0.02 * n}, "bodies": [{body}]}}' for n in range(50))]))
    player, address = play(first, "--as", protocol, "--at", "127.0.0.1:0")
    try:
        record(second, f"{protocol}://{address}")
    finally:
        player.kill()
        player.communicate()
    again = read_recording(second)
    shown = [body for line in again.lines for body in line.bodies if body.seen][-1]
    assert (shown.name, again.unit_m) == ("Body A", 0.001 if protocol == "qualisys" else 1.0)
    assert [again.unit_m * each for each in shown.position] == pytest.approx([1.25, -2.0, 0.5], abs=1e-5)
    assert shown.quaternion == pytest.approx((0.0, 0.0, math.sin(0.3), math.cos(0.3)), abs=1e-5)


class Bytes(Heard):
    """Keeps the bytes that a link delivers."""

    def __init__(self) -> None:
        super().__init__()
        self.data: list[bytes] = []

    def arrive(self, arrival_s: float, sender: str, content: Content) -> None:
        assert isinstance(content, bytes)
        self.data.append(content)


def test_a_receiver_behind_a_tcp_port_is_read_and_missed_when_it_ends() -> None:
    server, heard = RawServer((), "127.0.0.1", 0), Bytes()
    server.start()
    url = f"gnss+tcp://127.0.0.1:{server.port}"
    source = open_source(Settings(url, robot="r1", origin_deg=ORIGIN), MonotonicClock())
    try:
        source.start(heard)
        wait_for(lambda: len(heard.data) > 2, lambda: server.send_bytes(gga(north_m=12.0)))
        seen = [each for data in heard.data for each in source.read(data)]
        assert all(isinstance(each, Sighting) and abs(each.y_m - 12.0) < 0.01 for each in seen)
        server.close()
        wait_for(lambda: heard.reports[-1].startswith(f"no connection to {url}: "))
    finally:
        source.close()
