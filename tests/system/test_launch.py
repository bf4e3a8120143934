"""Processes that are killed while they start, or cannot start: a reason is given, and nothing is left behind."""

from __future__ import annotations

import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig, load_swarm
from fullswarm.errors import ConfigError
from fullswarm.launch.ports import on_free_ports
from fullswarm.launch.supervisor import FIRST_BACKOFF_S, STEADY_S, Supervisor
from fullswarm.runtime import Runtime

pytestmark = pytest.mark.system

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


def test_a_demo_moves_to_ports_that_are_free() -> None:
    config = SwarmConfig.model_validate({"robot": [{"id": "r1"}]})
    with socket.socket() as tcp, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        tcp.bind(("127.0.0.1", 0))
        udp.bind(("127.0.0.1", 0))
        ports = tcp.getsockname()[1], udp.getsockname()[1]
        taken = config.model_copy(
            update={
                "hub": config.hub.model_copy(update={"endpoint": f"tcp/127.0.0.1:{ports[0]}"}),
                "world": config.world_or_default.model_copy(update={"address": f"127.0.0.1:{ports[1]}"}),
            }
        )
        moved = on_free_ports(taken)
    assert moved.hub.endpoint != taken.hub.endpoint
    assert moved.world_or_default.address != taken.world_or_default.address


def test_swarms_side_by_side_do_not_wish_for_the_same_free_ports() -> None:
    robots = [{"id": "r1"}, {"id": "m1", "emulate": "rover"}, {"id": "c1", "emulate": "create2"}]
    config = SwarmConfig.model_validate({"robot": robots})
    first, second = (on_free_ports(config, wished=False) for _ in range(2))
    assert len({config.hub.endpoint, first.hub.endpoint, second.hub.endpoint}) == 3
    assert len({each.world_or_default.address for each in (config, first, second)}) == 3
    rovers = {each.robot[1].driver for each in (first, second)}
    assert len(rovers) == 2
    assert not any(":14550" in driver for driver in rovers)
    assert [each.driver.partition(":")[0] for each in first.robot] == ["", "mavlink+udp", "create"]


class Process:
    """A process that ends when it is told, with `code`; `born` is the code of those that end as they are started."""

    born: int | None = None

    def __init__(self, *_: Any, **__: Any) -> None:
        self.code = Process.born

    def poll(self) -> int | None:
        return self.code

    def wait(self, _: float | None = None) -> int:
        return 0

    def terminate(self) -> None:
        self.code = 0


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Runtime, Supervisor]]:
    monkeypatch.setattr(subprocess, "Popen", Process)
    Process.born = None
    runtime = Runtime(SimClock())
    made = Supervisor(SwarmConfig(), runtime)
    made.start()
    yield runtime, made
    made.close()


def test_no_agent_is_started_for_a_robot_with_a_computer_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "Popen", Process)
    Process.born = None
    robots = [
        {"id": "r1", "driver": "create:///dev/ttyUSB0", "host": "10.0.0.11"},
        {"id": "r2", "driver": "create:///dev/ttyUSB0", "host": "127.0.0.1"},
        {"id": "r3", "driver": "create:///dev/ttyUSB1"},
        {"id": "r4", "host": "10.0.0.14"},
    ]
    made = Supervisor(SwarmConfig.model_validate({"robot": robots}), Runtime(SimClock()))
    made.start()
    made.close()
    assert set(made.children) == {"hub", "core", "centralised", "world", "r2", "r3", "r4"}


@pytest.mark.parametrize("named", [False, True])
def test_a_core_that_is_started_again_knows_what_it_had_accepted(
    named: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Without a database of its own it would answer for requests that it has forgotten."""
    monkeypatch.setattr(subprocess, "Popen", Process)
    Process.born = None
    mine = tmp_path / "mine.db"
    made = Supervisor(SwarmConfig.model_validate({"core": {"store": mine} if named else {}}), Runtime(SimClock()))
    made.start()
    made.close()
    assert load_swarm(made.folder / "fleet.toml").core.store == (mine if named else made.folder / "core.db")


def end(supervisor: Supervisor, code: int) -> None:
    process: Any = supervisor.children["hub"].process
    process.code = code


def test_a_process_that_ran_well_is_started_again_soon(watched: tuple[Runtime, Supervisor]) -> None:
    runtime, supervisor = watched
    for number in range(6):  # it dies once a day
        runtime.run(STEADY_S + 1.0)
        end(supervisor, 1)
        runtime.run(FIRST_BACKOFF_S + 0.3)
        assert supervisor.alive("hub")
        assert supervisor.children["hub"].starts == number + 2


def test_a_process_that_dies_at_once_is_started_ever_more_rarely(watched: tuple[Runtime, Supervisor]) -> None:
    runtime, supervisor = watched
    Process.born = 1
    end(supervisor, 1)
    runtime.run(60.0)
    assert 10 <= supervisor.children["hub"].starts <= 20


def test_wrong_settings_end_the_supervisor_with_the_code_for_that(watched: tuple[Runtime, Supervisor]) -> None:
    runtime, supervisor = watched
    end(supervisor, 2)
    with pytest.raises(ConfigError, match="hub"):
        runtime.run(1.0)
