"""The bridge's side of ROS 1: its pipe to a process with rospy, and masters and processes that fail."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xmlrpc.client import ServerProxy

import pytest

from fullswarm.clock import MonotonicClock
from fullswarm.errors import ConfigError, Unreachable
from fullswarm.ros_bridge import codec as types
from fullswarm.ros_bridge.link import ROOM, Incoming, Topic
from fullswarm.ros_bridge.ros1_link import BACKLOG_BYTES, Ros1Link
from tests.system.ros_side import free_port
from tests.waiting import until

SYSTEM_PYTHON, MASTER = "/usr/bin/python3", "/usr/bin/rosmaster"
ODOM, CMD = Topic("r1/odom", types.ODOMETRY), Topic("r1/cmd_vel", types.TWIST)


def open_link(uri: str = "http://127.0.0.1:1", python: str = SYSTEM_PYTHON) -> Ros1Link:
    return Ros1Link(uri, python, MonotonicClock(), lambda: time.sleep(0.01))


class Master:
    """A ROS master on a port of its own."""

    def __init__(self, folder: Path) -> None:
        found = subprocess.run([SYSTEM_PYTHON, "-c", "import rospy"], capture_output=True, check=False, timeout=30)
        if found.returncode or not Path(MASTER).exists():
            pytest.skip(
                "ROS 1 is not installed: apt-get install --no-install-recommends python3-rospy python3-rosmaster"
            )
        self.port, self._folder = free_port(), folder
        self.uri = f"http://127.0.0.1:{self.port}"
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        environment = {**os.environ, "ROS_MASTER_URI": self.uri, "ROS_LOG_DIR": str(self._folder)}
        self.process = subprocess.Popen(
            [MASTER, "--core", "-p", str(self.port)], env=environment, stdout=subprocess.DEVNULL
        )
        until(lambda: self.topics() is not None, 20.0, "the master answers")

    def topics(self) -> dict[str, str] | None:
        """Return topic → type, of those that have a publisher or a subscription; None: no master answers."""
        try:
            with ServerProxy(self.uri) as proxy:
                answer: Any = proxy.getTopicTypes("/test")
                return dict(answer[2])
        except OSError:
            return None

    def kill(self) -> None:
        if self.process is not None:
            self.process.kill()
            self.process.wait()


@pytest.fixture
def master(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Master]:
    monkeypatch.setenv("ROS_IP", "127.0.0.1")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path))
    made = Master(tmp_path)
    made.start()
    yield made
    made.kill()


def test_a_python_without_rospy_is_named_with_what_to_install() -> None:
    with pytest.raises(ConfigError, match=r"this Python has no rospy.*python3-rospy"):
        open_link(python=sys.executable)


def test_a_python_that_is_not_there_is_named() -> None:
    with pytest.raises(ConfigError, match=r"/no/python: cannot start"):
        open_link(python="/no/python")


def test_a_master_that_is_not_there_is_named(master: Master) -> None:
    master.kill()
    with pytest.raises(Unreachable, match=r"no ROS master answers.*roscore"):
        open_link(master.uri)


def test_a_master_that_is_started_again_gets_all_topics_again(master: Master) -> None:
    link = open_link(master.uri)
    link.advertise(ODOM)
    link.subscribe(CMD)
    wanted = {"/r1/odom": "nav_msgs/Odometry", "/r1/cmd_vel": "geometry_msgs/Twist"}

    def known() -> bool:
        link.take()
        return wanted.items() <= (master.topics() or {}).items()

    until(known, 10.0, "the master knows both topics")
    link.withdraw("r1/odom")
    until(lambda: link.take() == [] and "/r1/odom" not in published(master), 10.0, "one is withdrawn")
    link.advertise(ODOM)
    master.kill()
    until(lambda: link.take() == [] and not link.up, 15.0, "its loss is noticed")
    dropped = link.dropped
    link.publish("r1/odom", {})
    assert link.dropped == dropped + 1
    master.start()
    until(lambda: known() and link.up, 20.0, "the new master knows both topics")
    link.close()
    until(lambda: published(master) == [], 10.0, "the bridge has left the master")


def published(master: Master) -> list[str]:
    with ServerProxy(master.uri) as proxy:
        answer: Any = proxy.getPublishedTopics("/test", "")
        return [name for name, _ in answer[2] if name.startswith("/r1")]


# ---------------------------------------------------------------- a process that misbehaves
def script(folder: Path, body: str) -> str:
    """Return an executable in place of Python, which says that it is ready and then does as `body` says."""
    path = folder / "python"
    path.write_text(f'#!{sys.executable}\nimport sys, time\nprint(\'{{"op": "ready"}}\', flush=True)\n{body}\n')
    path.chmod(0o755)
    return str(path)


def test_lines_that_are_none_are_counted_and_harm_nothing(tmp_path: Path) -> None:
    good = '{"op": "message", "topic": "/r1/cmd_vel", "sender": "/node", "data": "eA=="}'
    lines = ["", "{", "[]", "7", '{"op": "message"}', good.replace("eA==", "?"), "\xff" * 40, "x" * 1_000_000, good]
    body = f"for line in {lines!r}:\n    print(line, flush=True)\ntime.sleep(30)"
    link = open_link(python=script(tmp_path, body))
    link.subscribe(CMD)
    found: list[Incoming] = []
    until(lambda: bool(found), each=lambda: found.extend(link.take()), what="the good one arrives")
    assert found == [Incoming("r1/cmd_vel", "/node", b"x")]
    assert link.dropped >= 6
    link.close()


def test_a_flood_takes_bounded_room_and_time(tmp_path: Path) -> None:
    good = '{"op": "message", "topic": "/r1/cmd_vel", "sender": "/node", "data": "eA=="}'
    body = f"line = {good!r} + chr(10)\nwhile True:\n    sys.stdout.write(1000 * line)"
    link = open_link(python=script(tmp_path, body))
    link.subscribe(CMD)
    until(lambda: len(link.take()) == ROOM, what="messages arrive")
    began_s = time.process_time()
    for _ in range(10):
        assert len(link.take()) <= ROOM
    assert time.process_time() - began_s < 1.0
    link.close()


def test_a_process_that_reads_nothing_holds_nothing_up(tmp_path: Path) -> None:
    link = open_link(python=script(tmp_path, "time.sleep(30)"))
    link.advertise(ODOM)
    began_s = time.monotonic()
    while link.dropped == 0 and time.monotonic() - began_s < 30.0:
        link.publish("r1/odom", {})
    assert link.dropped > 0
    assert len(link._out) < 2 * BACKLOG_BYTES
    began_s = time.monotonic()
    link.close()
    assert time.monotonic() - began_s < 3.0
