"""Processes that are killed while they start, or cannot start: a reason is given, and nothing is left behind."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

FLEET = """
[hub]
endpoint = "tcp/127.0.0.1:{port}"
[[robot]]
id = "r1"
driver = "null://r1"
[[robot]]
id = "r2"
driver = "null://r2"
"""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def fleet(tmp_path: Path) -> Path:
    path = tmp_path / "fleet.toml"
    path.write_text(FLEET.format(port=free_port()))
    return path


@pytest.fixture
def started() -> Iterator[list[subprocess.Popen[str]]]:
    processes: list[subprocess.Popen[str]] = []
    yield processes
    for process in processes:
        process.kill()
        process.communicate()


def start(started: list[subprocess.Popen[str]], *arguments: str) -> subprocess.Popen[str]:
    process = subprocess.Popen([sys.executable, "-m", "fullswarm", *arguments], stderr=subprocess.PIPE, text=True)
    started.append(process)
    return process


def children_of(process: subprocess.Popen[str], count: int) -> list[psutil.Process]:
    """Wait until so many children have been started."""
    deadline_s = time.monotonic() + 30.0
    while time.monotonic() < deadline_s:
        found = psutil.Process(process.pid).children()
        if len(found) >= count:
            return found
        assert process.poll() is None, process.communicate()[1]
        time.sleep(0.002)
    raise AssertionError("no children")


def all_gone(children: list[psutil.Process], within_s: float = 20.0) -> bool:
    _, alive = psutil.wait_procs(children, within_s)
    for each in alive:
        each.kill()
    return not alive


def test_a_supervisor_killed_while_it_starts_leaves_nobody(fleet: Path, started: list[subprocess.Popen[str]]) -> None:
    process = start(started, "up", str(fleet))
    children = children_of(process, 5)
    process.kill()  # before any child has got further than its imports
    process.wait()
    assert all_gone(children)


def test_ctrl_c_twice_while_it_starts_leaves_nobody(fleet: Path, started: list[subprocess.Popen[str]]) -> None:
    process = start(started, "up", str(fleet))
    children = children_of(process, 5)
    for _ in range(2):
        process.send_signal(signal.SIGINT)
        time.sleep(0.005)
    _, complaint = process.communicate(timeout=20)
    assert process.returncode in (130, -signal.SIGINT)
    assert "Traceback" not in complaint
    assert all_gone(children)


@pytest.mark.alone
@pytest.mark.parametrize("after_s", [0.0, 0.4, 1.2])
def test_ctrl_c_while_it_starts(fleet: Path, started: list[subprocess.Popen[str]], after_s: float) -> None:
    process = start(started, "up", str(fleet))
    children = children_of(process, 5)
    time.sleep(after_s)
    process.send_signal(signal.SIGINT)
    _, complaint = process.communicate(timeout=20)
    assert process.returncode == 130
    assert "Traceback" not in complaint
    assert all_gone(children, 1.0)


@pytest.mark.alone
def test_a_port_that_is_taken_ends_all_with_a_reason(fleet: Path, started: list[subprocess.Popen[str]]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", int(fleet.read_text().split(":", 2)[1].split('"')[0])))
        taken.listen()
        process = start(started, "up", str(fleet))
        children = children_of(process, 1)
        _, complaint = process.communicate(timeout=30)
    assert process.returncode == 2
    assert "another program listens on this port" in complaint
    assert "Traceback" not in complaint
    assert all_gone(children, 1.0)


@pytest.mark.parametrize("setting", ["hub.endpoint=foo", "hub.endpoint=tcp/127.0.0.1:99999", "world.address=foo"])
def test_an_address_that_is_none_gets_a_clear_error(setting: str, started: list[subprocess.Popen[str]]) -> None:
    process = start(started, "demo", "--headless", "--seconds", "4", "--set", setting)
    _, complaint = process.communicate(timeout=30)
    assert process.returncode == 2
    assert setting.partition("=")[2] in complaint
    assert "bug" not in complaint
