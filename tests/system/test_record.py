"""`fullswarm up --record` and `fullswarm record` in real processes; the files are read by the library's own reader."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import psutil
import pytest
from mcap.reader import make_reader

from fullswarm.config import SwarmConfig
from fullswarm.launch.network import on_free_ports
from tests.waiting import until

FLEET = """
[hub]
endpoint = "{hub}"
[world]
address = "{world}"
engine = "kinematic"
[fleet]
count = 2
"""


def fullswarm(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "fullswarm", *arguments], capture_output=True, text=True, check=False, timeout=60
    )


class Up:
    """A running `fullswarm up --record`."""

    def __init__(self, folder: Path) -> None:
        free = on_free_ports(SwarmConfig(), prefer_configured=False)
        file, self.recording = folder / "fleet.toml", folder / "run.mcap"
        file.write_text(FLEET.format(hub=free.hub.endpoint, world=free.world_or_default.address))
        self.hub = ("--hub", free.hub.endpoint)
        self.process = subprocess.Popen(
            [sys.executable, "-m", "fullswarm", "up", str(file), "--record", str(self.recording)],
            stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def lifecycles(self) -> list[str]:
        found = fullswarm("status", *self.hub, "--json")
        return [] if found.returncode else [each.get("lifecycle") for each in json.loads(found.stdout)["robots"]]

    def ready(self) -> bool:
        return self.lifecycles() == ["READY", "READY"]

    def close(self) -> str:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        try:
            return self.process.communicate(timeout=30)[1]
        finally:
            self.process.kill()


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    made = Up(tmp_path_factory.mktemp("up"))
    try:
        yield made
    finally:
        made.close()


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    """Return (topic, time in ns, data) of a whole file."""
    reader = make_reader(BytesIO(path.read_bytes()))
    return [(channel.topic, message.log_time, message.data) for _, channel, message in reader.iter_messages()]


def start(up: Up, path: Path) -> subprocess.Popen[str]:
    """Start `record start`; return once it records."""
    process = subprocess.Popen(
        [sys.executable, "-m", "fullswarm", "record", "start", *up.hub, "--out", str(path)],
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    until(lambda: path.exists() and path.stat().st_size > 10_000, 60.0, "something is recorded")
    return process


def agents(up: Up, robot: str) -> list[psutil.Process]:
    """Return the processes of this `up` that are the agent of a robot."""
    found = []
    for each in psutil.Process(up.process.pid).children():
        with contextlib.suppress(psutil.Error):  # it has just ended
            if f"fullswarm agent {robot} " in " ".join(each.cmdline()):
                found.append(each)
    return found


def test_a_recorder_that_is_killed_has_lost_less_than_a_second(up: Up, tmp_path: Path) -> None:
    until(up.ready, 90.0, "the swarm is ready")
    path = tmp_path / "mine.mcap"
    process = start(up, path)
    time.sleep(1.0)
    process.kill()
    killed_ns = time.time_ns()
    process.communicate()
    assert fullswarm("record", "info", str(path)).returncode == 1
    repaired = fullswarm("record", "repair", str(path), "--out", str(tmp_path / "whole.mcap"))
    assert repaired.returncode == 0, repaired.stderr
    found = messages(tmp_path / "whole.mcap")
    states = [at for topic, at, _ in found if topic.startswith("/state/")]
    assert 0 < killed_ns - max(states) < 1e9
    assert fullswarm("record", "info", str(tmp_path / "whole.mcap")).returncode == 0


def test_a_recording_is_ended_from_another_terminal(up: Up, tmp_path: Path) -> None:
    until(up.ready, 90.0, "the swarm is ready")
    path = tmp_path / "mine.mcap"
    process = start(up, path)
    other = fullswarm("record", "stop", "--swarm", "other")
    assert (other.returncode, process.poll()) == (2, None)
    assert "no recording of swarm 'other'" in other.stderr
    ended = fullswarm("record", "stop")
    assert ended.stderr.splitlines() == [f"ends: {path}"]  # that of `up` goes on
    process.communicate(timeout=30)
    info = json.loads(fullswarm("record", "info", str(path), "--json").stdout)
    assert info["whole"]
    assert info["about"]["fullswarm.end"] == {"dropped": "0", "strange": "0", "refused": "0"}
    assert fullswarm("record", "start", *up.hub, "--out", str(path)).returncode == 2


def test_a_run_is_recorded_from_its_start_to_its_end(tmp_path: Path) -> None:
    up = Up(tmp_path)
    try:
        until(up.ready, 90.0, "the swarm is ready")
        asked = fullswarm("request", "rendezvous", *up.hub)
        assert asked.returncode == 0, asked.stderr
        (agent,) = agents(up, "r2")
        agent.kill()
        until(lambda: agents(up, "r2") not in ([], [agent]), 30.0, "the agent is started again")
        until(lambda: up.lifecycles()[1:] in (["READY"], ["ACTIVE"]), 60.0, "the agent has its robot again")
    finally:
        said = up.close()
    assert f"recorded to {up.recording}" in said
    found = messages(up.recording)
    topics = Counter(topic for topic, _, _ in found)
    assert {"/behaviour/request", "/state/all/r1", "/state/all/r2", "/heartbeat/core", "/tf", "/scene"} <= set(topics)
    told: list[Any] = [json.loads(data) for topic, _, data in found if topic == "/behaviour/status"]
    assert any(each["behaviour"] == "rendezvous" and each["phase"] == "running" for each in told)
    times = [at for _, at, _ in found]
    assert times == sorted(times)
    with up.recording.open("rb") as stream:
        (fleet,) = [each for each in make_reader(stream).iter_attachments() if each.name == "fleet.toml"]
    assert up.hub[1].encode() in fleet.data
    again = fullswarm("replay", str(up.recording), "--json")
    assert again.returncode == 0, again.stdout + again.stderr
    outcomes = json.loads(again.stdout)
    assert sorted(each["name"] for each in outcomes) == ["centralised", "core", "r1", "r2", "r2"]
    commands = {name: [each["commands"] for each in outcomes if each["name"] == name] for name in ("r1", "r2")}
    assert min(commands["r1"]) > 20
    assert min(commands["r2"]) > 0  # the second one may have come up just before the end
    assert sum(commands["r2"]) > 20


def test_up_refuses_a_file_that_is_there_before_it_starts_anything(tmp_path: Path) -> None:
    file = tmp_path / "fleet.toml"
    file.write_text('[[robot]]\nid = "r1"\ndriver = "null://r1"\n')
    taken = tmp_path / "run.mcap"
    taken.touch()
    for path, words in ((taken, "there already"), (tmp_path / "no" / "run.mcap", "no such folder")):
        tried = fullswarm("up", str(file), "--record", str(path))
        assert (tried.returncode, tried.stdout) == (2, "")
        assert words in tried.stderr
