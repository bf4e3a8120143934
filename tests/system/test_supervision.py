"""`fullswarm up` in real processes: one that is frozen, and one of another release."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.launch.liveness import PERIOD_S
from fullswarm.launch.network import on_free_ports
from fullswarm.launch.supervisor import SILENT_S, SPARE_FIRST_S
from fullswarm.messages import RequestStatus, Version, versions
from fullswarm.operator.client import Operator
from fullswarm.operator.view import FleetView, ProcessRow
from fullswarm.reasons import Code
from fullswarm.runtime import Mailbox, Runtime
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


class Up:
    """A running `fullswarm up` with two simulated robots, and an operator."""

    def __init__(self, folder: Path) -> None:
        free = on_free_ports(SwarmConfig(), prefer_configured=False)
        file = folder / "fleet.toml"
        file.write_text(FLEET.format(hub=free.hub.endpoint, world=free.world_or_default.address))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "fullswarm", "up", str(file)], stderr=subprocess.PIPE, text=True
        )
        self.runtime = Runtime(MonotonicClock(), Mailbox())
        self.bus = ZenohBus(self.runtime.mailbox, hub=free.hub.endpoint)
        self.view = FleetView(self.bus, Keys(), self.runtime, ("r1", "r2"))
        self.operator = Operator(self.bus, Keys(), self.runtime, "test")

    def rows(self) -> dict[str, ProcessRow]:
        self.runtime.run(0.05)
        return {row.state.name: row for row in self.view.snapshot().processes}

    def running(self) -> bool:
        """Tell whether all processes run and the robots are there."""
        found, seen = self.rows(), self.view.snapshot().robots
        ready = [row.robot for row in seen if row.health is not None and row.health.lifecycle == "READY"]
        return len(found) == 6 and all(row.state.phase == "running" for row in found.values()) and len(ready) == 2

    def ask(self, behaviour: str, robot: str) -> RequestStatus:
        """Ask for a behaviour; return how that went."""
        told: list[RequestStatus] = []
        self.operator.request(behaviour, (robot,), {}, told.append)
        done = ("running", "refused", "superseded")
        until(lambda: any(each.phase in done for each in told), 20.0, each=lambda: self.runtime.run(0.05))
        return next(each for each in told if each.phase in done)

    def close(self) -> None:
        self.view.close()
        self.operator.close()
        self.bus.close()
        self.process.send_signal(signal.SIGINT)
        try:
            self.process.communicate(timeout=20)
        finally:
            self.process.kill()


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    made = Up(tmp_path_factory.mktemp("up"))
    try:
        until(made.running, 60.0, "all processes running")
        yield made
    finally:
        made.close()


def child(up: Up, word: str) -> psutil.Process | None:
    """Return a process of the swarm by a word of its command line."""
    found = (each for each in psutil.Process(up.process.pid).children() if word in each.cmdline())
    return next(found, None)


def test_a_killed_robot_s_next_process_was_there_before(up: Up) -> None:
    """It has imported all, shows what it is now, and writes into the robot's own log."""
    spare: list[psutil.Process] = []

    def is_there() -> bool:
        up.runtime.run(0.05)
        spare[:] = [each for each in [child(up, "spare")] if each is not None]
        return bool(spare)

    until(is_there, SPARE_FIRST_S + 30.0, "there is a spare process")
    robot = child(up, "r2")
    assert robot is not None
    robot.kill()
    until(lambda: up.rows()["r2"].state.starts == 2 and up.running(), 30.0, "r2 runs again")
    again = child(up, "r2")
    assert again is not None
    assert again.pid == spare[0].pid
    words = [each for each in again.cmdline() if each]
    assert (words[1:5], words[-1]) == (["-m", "fullswarm", "agent", "r2"], "--with-parent")
    files = [Path(f"/proc/{again.pid}/fd/{number}").readlink() for number in (0, 1, 2)]
    assert (str(files[0]), files[1].name, files[2].name) == ("/dev/null", "r2.log", "r2.log")


def test_a_frozen_core_is_started_again_and_operators_learn_why(up: Up) -> None:
    """SIGSTOP: the system lists the process as before, but its loop stands."""
    core = next(each for each in psutil.Process(up.process.pid).children() if "core" in each.cmdline())
    core.suspend()
    took_s = until(lambda: up.rows()["core"].state.phase == "frozen", 20.0, "the core is reported as frozen")
    until(lambda: up.rows()["core"].state.starts == 2 and up.running(), 30.0, "the core runs again")
    assert took_s > SILENT_S - 2 * PERIOD_S
    assert up.rows()["core"].text.startswith("core was frozen and was killed and runs again")
    assert up.rows()["hub"].text == ""


def test_no_robot_drives_beside_one_of_another_release(up: Up) -> None:
    assert up.ask("rendezvous", "r1").phase == "running"
    old = Version(name="r9", software="0.0.9", kinds={**versions(), "RobotStates": 1})

    def announce() -> None:
        up.bus.publish(Keys().version("r9"), old)
        up.runtime.run(0.05)

    def stands() -> bool:
        row = next(row for row in up.view.snapshot().robots if row.robot == "r1")
        return row.health is not None and row.health.stop_code == Code.VERSION and not row.health.moving

    until(stands, 10.0, "r1 stands", each=announce)
    answer = up.ask("rendezvous", "r2")
    assert (answer.phase, answer.code) == ("refused", Code.VERSION)
    assert "RobotStates 1" in answer.reason

    def welcome() -> bool:
        return up.ask("rendezvous", "r2").phase == "running"

    until(welcome, 15.0, "it is accepted once that one has gone")
