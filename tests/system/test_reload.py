"""`fullswarm up --reload`: a law is edited while robots run it, in real processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fullswarm.bringup.init import lab_files, write
from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.keys import Keys
from fullswarm.messages import RequestStatus, RobotStates
from fullswarm.operator.client import Operator
from fullswarm.operator.view import FleetView
from fullswarm.runtime import Mailbox, Runtime
from tests.system.test_launch import free_port

pytestmark = pytest.mark.alone

FLEET = """
[hub]
endpoint = "tcp/127.0.0.1:{hub}"
[world]
engine = "kinematic"
bounds_m = [-100, -10, 100, 10]
address = "127.0.0.1:{world}"
[[robot]]
id = "r1"
pose = [0, -2, 0]
[[robot]]
id = "r2"
pose = [0, 2, 0]
"""
LAW = """
import numpy as np

def velocity(view, params):
    return np.tile([{speed}, 0.0], (len(view.position), 1))
"""
RECORD = '[glide]\nsummary = "Glide"\nlaw = "glide"\n'
PROMPT_S = 2.0


class UnderDevelopment:
    """`fullswarm up lab.toml --reload` in a lab that is not installed, and its bus."""

    def __init__(self, folder: Path, *options: str, fleet: str = FLEET) -> None:
        write({folder / path: text for path, text in lab_files("my-lab").items()})
        self.law, self.log = folder / "my_lab" / "glide.py", folder / "up.log"
        self.law.write_text(LAW.format(speed=0.3))
        self.law.with_suffix(".toml").write_text(RECORD)
        project = folder / "pyproject.toml"
        project.write_text(project.read_text().replace('ring = "my', 'glide = "my_lab.glide"\nring = "my'))
        hub = free_port()
        (folder / "lab.toml").write_text(fleet.format(hub=hub, world=free_port()))
        with self.log.open("w") as sink:
            command = [sys.executable, "-m", "fullswarm", "up", "lab.toml", "--reload", *options]
            environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
            self.process = subprocess.Popen(command, cwd=folder, stderr=sink, env=environment)
        self.clock, self.statuses = MonotonicClock(), list[RequestStatus]()
        self.runtime = Runtime(self.clock, Mailbox())
        self.bus = ZenohBus(self.runtime.mailbox, hub=f"tcp/127.0.0.1:{hub}")
        self.speed: dict[str, float] = {}
        self.bus.subscribe(Keys("swarm").state(), RobotStates, self._note)
        self.view = FleetView(self.bus, Keys("swarm"), self.runtime, ("r1", "r2"))
        self.operator = Operator(self.bus, Keys("swarm"), self.runtime, "test")

    def _note(self, states: RobotStates) -> None:
        self.speed |= dict(zip(states.robots, states.speed_m_s, strict=True))

    def until(self, condition: Callable[[], bool], what: str, within_s: float = 60.0) -> float:
        began_s = self.clock.now_s()

        def check() -> None:
            if condition() or self.clock.now_s() - began_s > within_s:
                timer.cancel()
                self.runtime.pause()

        timer = self.runtime.every(0.01, check)
        self.runtime.run()
        assert condition(), f"waited for: {what}\n{self.speed} {self.statuses[-1:]}\n{self.log.read_text()}"
        return self.clock.now_s() - began_s

    def ready(self) -> bool:
        seen = self.view.snapshot()
        robots = [row for row in seen.robots if row.health and row.health.lifecycle in ("READY", "ACTIVE")]
        return len(robots) == 2 and "core" in {node.node for node in seen.nodes}

    def drives(self, speed_m_s: float) -> bool:
        return len(self.speed) == 2 and all(abs(each - speed_m_s) < 0.01 for each in self.speed.values())

    def close(self) -> None:
        self.process.send_signal(signal.SIGINT)
        self.process.wait(20.0)
        self.bus.close()


@pytest.fixture
def lab(tmp_path: Path) -> Iterator[UnderDevelopment]:
    made = UnderDevelopment(tmp_path / "my-lab")
    try:
        yield made
    finally:
        made.close()


def test_an_edited_law_runs_within_two_seconds_and_a_broken_one_is_named(lab: UnderDevelopment) -> None:
    lab.until(lambda: lab.ready() and lab.drives(0.0), "robots report")
    lab.operator.request("glide", ("r1", "r2"), {}, lab.statuses.append)
    lab.until(lambda: lab.drives(0.3), "they drive")
    lab.law.write_text(LAW.format(speed=0.15))
    slowest = [1.0]
    lab.runtime.every(0.01, lambda: slowest.append(max(lab.speed.values())))
    took_s = lab.until(lambda: 0.0 in map(abs, slowest) and lab.drives(0.15), "they stand, then run the new law")
    assert took_s < PROMPT_S
    lab.until(lambda: "glide.py is loaded" in lab.log.read_text(), "the terminal says so")
    lab.law.write_text("def velocity(view, params):\n    return (\n")
    took_s = lab.until(lambda: f"{lab.law}:2: SyntaxError" in lab.log.read_text(), "the terminal names the line")
    assert took_s < PROMPT_S
    lab.runtime.run(1.0)
    assert lab.drives(0.15)
    assert lab.statuses[-1].phase == "running"
