"""What the supervisor starts, on which ports, and when it starts a process again; no process, simulated time."""

from __future__ import annotations

import io
import json
import math
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig, load_swarm
from fullswarm.errors import ConfigError
from fullswarm.keys import Keys
from fullswarm.launch.network import on_free_ports
from fullswarm.launch.supervisor import (
    END_S,
    FIRST_BACKOFF_S,
    FROZEN_S,
    SILENT_S,
    SPARE_FIRST_S,
    SPARE_NEXT_S,
    SPARES,
    STEADY_S,
    WATCH_S,
    Supervisor,
)
from fullswarm.operator.render import footer_lines
from fullswarm.operator.view import FleetView
from fullswarm.runtime import Runtime


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
    first, second = (on_free_ports(config, prefer_configured=False) for _ in range(2))
    assert len({config.hub.endpoint, first.hub.endpoint, second.hub.endpoint}) == 3
    assert len({each.world_or_default.address for each in (config, first, second)}) == 3
    rovers = {each.robot[1].driver for each in (first, second)}
    assert len(rovers) == 2
    assert not any(":14550" in driver for driver in rovers)
    assert [each.driver.partition(":")[0] for each in first.robot] == ["", "mavlink+udp", "create"]


class Told(io.BytesIO):
    """A pipe that remembers what was written into it."""

    text = ""

    def close(self) -> None:
        if not self.closed:
            self.text = self.getvalue().decode()
        super().close()


class Process:
    """A process that ends when it is told, with `code`; `born` is the code of those that end as they are started."""

    born: int | None = None
    spares = 0  # how many were ever made

    def __init__(self, words: list[str], *_: Any, pass_fds: tuple[int, ...], **__: Any) -> None:
        self.code = Process.born
        self.is_spare = words[3] == "spare"
        Process.spares += self.is_spare
        self.stdin = Told()
        self.alive = os.dup(pass_fds[0])  # it has an end of the pipe of its own

    def beat(self) -> None:
        os.write(self.alive, b".")

    def kill(self) -> None:
        self.code = -signal.SIGKILL

    def poll(self) -> int | None:
        return self.code

    def wait(self, _: float | None = None) -> int:
        return 0

    def terminate(self) -> None:
        self.code = 0

    def __del__(self) -> None:
        os.close(self.alive)


@pytest.fixture
def watched(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[Runtime, Supervisor]]:
    monkeypatch.setattr(subprocess, "Popen", Process)
    Process.born, Process.spares = None, 0
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
    assert load_swarm(made.folder / "fleet.toml").core.store == (mine if named else made.folder / "core.db")
    made.close()


def end(supervisor: Supervisor, code: int) -> None:
    process: Any = supervisor.children["hub"].process
    process.code = code


def test_a_process_that_ran_well_is_started_again_at_once(watched: tuple[Runtime, Supervisor]) -> None:
    runtime, supervisor = watched
    for number in range(6):  # it dies once a day
        runtime.run(STEADY_S + 1.0)
        end(supervisor, 1)
        runtime.run(WATCH_S)
        assert supervisor.alive("hub")
        assert supervisor.children["hub"].starts == number + 2


def test_a_process_that_dies_at_once_is_started_ever_more_rarely(watched: tuple[Runtime, Supervisor]) -> None:
    runtime, supervisor = watched
    Process.born = 1
    end(supervisor, 1)
    runtime.run(60.0)
    assert 10 <= supervisor.children["hub"].starts <= 20


def test_a_process_that_died_is_followed_by_one_that_has_imported_all(watched: tuple[Runtime, Supervisor]) -> None:
    runtime, supervisor = watched
    runtime.run(SPARE_FIRST_S + 0.1)
    assert not hub_of(supervisor).is_spare
    end(supervisor, 1)
    runtime.run(WATCH_S)
    second = hub_of(supervisor)
    assert second.is_spare
    order = json.loads(second.stdin.text)
    assert order["arguments"][0] == "hub"
    assert order["arguments"][-1] == "--with-parent"
    assert order["log"] == order["data"] == str(supervisor.folder / "hub.log")
    second.beat()  # on the pipe that the supervisor now watches
    runtime.run(WATCH_S)
    assert supervisor.children["hub"].looks() == "running"
    runtime.run(STEADY_S)
    supervisor.children["core"].process = None  # only the hub is looked at here
    end(supervisor, 1)
    runtime.run(WATCH_S)
    assert hub_of(supervisor).is_spare
    assert hub_of(supervisor) is not second


def test_spares_are_made_one_after_another_and_not_beside_one_that_comes_up(
    watched: tuple[Runtime, Supervisor],
) -> None:
    runtime, supervisor = watched
    runtime.run(SPARE_FIRST_S + 0.1)
    assert Process.spares == 1
    runtime.run(SPARE_NEXT_S - 0.2)
    assert Process.spares == 1
    runtime.run(0.3)
    assert Process.spares == SPARES
    runtime.run(60.0)
    assert Process.spares == SPARES
    for name in ("hub", "core"):  # the second before there is another spare one
        process: Any = supervisor.children[name].process
        process.code = 1
        runtime.run(SPARE_NEXT_S - WATCH_S - 0.1)
        again: Any = supervisor.children[name].process
        assert again.is_spare
    runtime.run(2 * SPARE_NEXT_S + 0.3)
    assert Process.spares == 2 + SPARES


def test_more_that_die_at_once_than_there_are_spares_are_all_started_again(
    watched: tuple[Runtime, Supervisor],
) -> None:
    runtime, supervisor = watched
    runtime.run(SPARE_FIRST_S + SPARES * SPARE_NEXT_S)
    names = ("hub", "core", "centralised")
    processes: list[Any] = [supervisor.children[name].process for name in names]
    for each in processes:
        each.code = 1
    runtime.run(WATCH_S)
    again: list[Any] = [supervisor.children[name].process for name in names]
    assert [each.is_spare for each in again] == [True, True, False]
    assert all(map(supervisor.alive, names))


def test_a_spare_process_that_died_is_not_used(watched: tuple[Runtime, Supervisor]) -> None:
    runtime, supervisor = watched
    Process.born = 1
    runtime.run(SPARE_FIRST_S + 0.1)  # it has died as it was made
    Process.born = None
    end(supervisor, 1)
    runtime.run(WATCH_S)
    assert not hub_of(supervisor).is_spare
    assert supervisor.alive("hub")
    runtime.run(max(SPARE_NEXT_S, STEADY_S) + 0.1)
    end(supervisor, 1)
    runtime.run(WATCH_S)
    assert hub_of(supervisor).is_spare


def test_no_spare_process_has_what_a_developer_changes(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(subprocess, "Popen", Process)
    Process.born = None
    runtime = Runtime(SimClock())
    made = Supervisor(SwarmConfig(), runtime, develop=tmp_path)
    made.start()
    runtime.run(SPARE_FIRST_S + 0.1)
    end(made, 1)
    runtime.run(1.0)
    assert not hub_of(made).is_spare
    made.close()


def test_a_spare_process_that_gets_no_order_says_so() -> None:
    tried = subprocess.run(
        [sys.executable, "-m", "fullswarm", "spare"], input=b"{}\n", capture_output=True, check=False, timeout=60
    )
    assert (tried.returncode, tried.stdout) == (2, b"")
    assert b"error: only `fullswarm up`" in tried.stderr
    ended = subprocess.run([sys.executable, "-m", "fullswarm", "spare"], input=b"", capture_output=True, timeout=60)
    assert (ended.returncode, ended.stderr) == (0, b"")


def test_wrong_settings_end_the_supervisor_with_the_code_for_that(watched: tuple[Runtime, Supervisor]) -> None:
    runtime, supervisor = watched
    end(supervisor, 2)
    with pytest.raises(ConfigError, match="hub"):
        runtime.run(1.0)


def hub_of(supervisor: Supervisor) -> Process:
    process: Any = supervisor.children["hub"].process
    assert isinstance(process, Process)
    return process


def test_a_frozen_process_is_killed_and_started_again(watched: tuple[Runtime, Supervisor]) -> None:
    runtime, supervisor = watched
    first = hub_of(supervisor)
    first.beat()
    runtime.run(SILENT_S / 2)
    assert supervisor.children["hub"].looks() == "running"
    runtime.run(SILENT_S)
    assert supervisor.children["hub"].looks() == "frozen"
    runtime.run(FROZEN_S)
    again = hub_of(supervisor)
    assert (first.code, supervisor.children["hub"].starts) == (-signal.SIGKILL, 2)
    again.beat()
    runtime.run(FROZEN_S - 0.5)
    again.beat()
    runtime.run(FROZEN_S - 0.5)
    assert hub_of(supervisor) is again
    runtime.run(2.0)  # a second time, too
    assert again.code == -signal.SIGKILL


def test_a_process_that_has_not_come_up_yet_is_not_frozen(watched: tuple[Runtime, Supervisor]) -> None:
    runtime, supervisor = watched
    runtime.run(60.0)
    assert supervisor.children["core"].starts == 1
    assert supervisor.children["core"].looks() == "starting"


class Machine:
    """The clock of a computer, which passes by itself while nothing runs."""

    time_s = 0.0

    def now_s(self) -> float:
        return self.time_s


def test_a_suspended_computer_finds_no_process_frozen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subprocess, "Popen", Process)
    Process.born = None
    machine = Machine()
    runtime = Runtime(machine)
    made = Supervisor(SwarmConfig(), runtime)
    made.start()
    for _ in range(5):
        for step in range(20):
            machine.time_s += 0.1
            if step % 5 == 0:
                hub_of(made).beat()
            runtime.serve_due()
        machine.time_s += 1000.0
    assert made.children["hub"].starts == 1
    for _ in range(60):  # and one that is frozen after that is found all the same
        machine.time_s += 0.1
        runtime.serve_due()
    assert made.children["hub"].starts == 2
    made.close()


def test_operators_learn_which_process_ended_and_why(watched: tuple[Runtime, Supervisor]) -> None:
    runtime, supervisor = watched
    bus = LocalBus(runtime.mailbox)
    view = FleetView(bus, Keys(), runtime)
    supervisor.report_to(bus)
    for name in supervisor.children:
        process: Any = supervisor.children[name].process
        process.beat()

    def hub() -> tuple[str, str]:
        (row,) = (each for each in view.snapshot().processes if each.state.name == "hub")
        return row.state.phase, row.text

    runtime.run(0.5)
    assert hub() == ("running", "")
    hub_of(supervisor).code = -signal.SIGSEGV
    runtime.run(0.2)
    assert hub() == ("ended", "hub was killed by signal 11")
    runtime.run(FIRST_BACKOFF_S)
    assert hub() == ("starting", "hub was killed by signal 11 and is starting again")
    hub_of(supervisor).beat()
    runtime.run(0.2)
    assert hub()[0] == "running"
    assert hub()[1].startswith("hub was killed by signal 11 and runs again")
    assert hub()[1] in footer_lines(view.snapshot())
    runtime.run(SILENT_S)
    assert hub()[0] == "frozen"
    runtime.run(FROZEN_S - SILENT_S)
    assert hub() == ("ended", "hub was frozen and was killed")
    runtime.run(1.0)
    hub_of(supervisor).beat()
    runtime.run(0.2)
    assert "hub was frozen and was killed" in hub()[1]
    view.close()


class Stubborn:
    """A process that ends `needs_s` after SIGTERM, on a clock that only waiting moves."""

    def __init__(self, name: str, needs_s: float, clock: SimClock, events: list[tuple[float, str]]) -> None:
        self.name, self.needs_s, self.clock, self.events = name, needs_s, clock, events
        self.ends_s = math.inf
        self.over = False

    def poll(self) -> int | None:
        return 0 if self.over or self.clock.now_s() >= self.ends_s else None

    def terminate(self) -> None:
        self.events.append((round(self.clock.now_s(), 3), f"terminate {self.name}"))
        self.ends_s = self.clock.now_s() + self.needs_s

    def wait(self, timeout: float | None = None) -> int:
        until_s = self.clock.now_s() + (timeout or 0.0)
        if not self.over and self.ends_s > until_s:
            self.clock.advance_to(until_s)
            raise subprocess.TimeoutExpired(self.name, timeout or 0.0)
        self.clock.advance_to(self.clock.now_s() if self.over else max(self.clock.now_s(), self.ends_s))
        return 0

    def kill(self) -> None:
        self.events.append((round(self.clock.now_s(), 3), f"kill {self.name}"))
        self.over = True


def closed(needs_s: dict[str, float]) -> tuple[float, list[tuple[float, str]]]:
    """Close a supervisor of such processes; return how long that took, and what happened when."""
    clock, events = SimClock(), list[tuple[float, str]]()
    made = Supervisor(SwarmConfig(), Runtime(clock))
    for name, needed_s in needs_s.items():
        made.add(name, name)
        process: Any = Stubborn(name, needed_s, clock, events)
        made.children[name].process = process
    made.close()
    assert not made.folder.exists()
    return clock.now_s(), events


def test_robots_end_first_and_all_others_at_once() -> None:
    names = ("console", "hub", "core", "centralised", "world", "r1", "r2", "r3", "r4")
    took_s, events = closed(dict.fromkeys(names, 0.3))
    first = {f"terminate {name}" for name in ("console", "r1", "r2", "r3", "r4")}
    assert {text for at_s, text in events if at_s == 0.0} == first
    assert {text for at_s, text in events if at_s == 0.3} == {f"terminate {name}" for name in names} - first
    assert took_s == pytest.approx(0.6)


def test_processes_that_do_not_end_are_killed_after_one_common_wait() -> None:
    names = ("console", "hub", "core", "world", *(f"r{number}" for number in range(20)))
    took_s, events = closed(dict.fromkeys(names, math.inf))
    assert took_s == pytest.approx(2 * END_S)
    assert {text for _, text in events if text.startswith("kill")} == {f"kill {name}" for name in names}
    robots_killed = [at_s for at_s, text in events if text.startswith("kill r")]
    support_asked = [at_s for at_s, text in events if text in ("terminate hub", "terminate core", "terminate world")]
    assert max(robots_killed) <= min(support_asked)
