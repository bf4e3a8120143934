"""The example behaviours, a package that is not installed: in processes of `fullswarm up`, and in an experiment."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from fullswarm.bus.zenoh_bus import ZenohBus
from fullswarm.clock import MonotonicClock
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.messages import RobotStates, Value
from fullswarm.operator.client import Operator, PendingRequest
from fullswarm.operator.view import FleetView
from fullswarm.registry import DEVELOP
from fullswarm.runtime import Mailbox, Runtime
from tests.system.test_launch import free_port

EXAMPLES = Path(__file__).parents[2] / "examples" / "behaviours"
ROBOTS = ("r1", "r2", "r3")
FLEET = """
[hub]
endpoint = "tcp/127.0.0.1:{hub}"
[world]
engine = "kinematic"
bounds_m = [0, 0, 10, 10]
address = "127.0.0.1:{world}"
[[robot]]
id = "r1"
pose = [3, 3, 0]
[[robot]]
id = "r2"
pose = [5, 4, 1]
[[robot]]
id = "r3"
pose = [4, 6, 2]
"""
TASKS: list[float | list[float]] = [[2.0, 5.0], [4.0, 3.0], [6.0, 5.0]]


class Up:
    """`fullswarm up` with a package under development, the examples, and its bus."""

    def __init__(self, folder: Path, package: Path = EXAMPLES) -> None:
        hub, self.log = free_port(), folder / "up.log"
        (folder / "lab.toml").write_text(FLEET.format(hub=hub, world=free_port()))
        with self.log.open("w") as sink:
            command = [sys.executable, "-m", "fullswarm", "up", "lab.toml"]
            environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), DEVELOP: str(package)}
            self.process = subprocess.Popen(command, cwd=folder, stderr=sink, env=environment)
        self.clock = MonotonicClock()
        self.runtime = Runtime(self.clock, Mailbox())
        self.bus = ZenohBus(self.runtime.mailbox, hub=f"tcp/127.0.0.1:{hub}")
        self.place: dict[str, tuple[float, float]] = {}
        self.bus.subscribe(Keys("swarm").state(), RobotStates, self._note)
        self.view = FleetView(self.bus, Keys("swarm"), self.runtime, ROBOTS)
        self.operator = Operator(self.bus, Keys("swarm"), self.runtime, "test")
        self.until(self.ready, "the swarm is ready", 60.0)

    def _note(self, states: RobotStates) -> None:
        self.place |= dict(zip(states.robots, zip(states.x_m, states.y_m, strict=True), strict=True))

    @property
    def places(self) -> Array:
        return np.array([self.place[robot] for robot in ROBOTS])

    def ready(self) -> bool:
        snapshot = self.view.snapshot()
        here = [row for row in snapshot.robots if row.age_s < 1.0 and row.health and row.health.lifecycle == "READY"]
        return len(here) == 3 and "core" in {node.node for node in snapshot.nodes if node.age_s < 1.0}

    def until(self, condition: Callable[[], bool], what: str, within_s: float) -> None:
        end_s = self.clock.now_s() + within_s

        def check() -> None:
            if condition() or self.clock.now_s() > end_s:
                timer.cancel()
                self.runtime.pause()

        timer = self.runtime.every(0.02, check)
        self.runtime.run()
        assert condition(), f"waited for: {what}\n{self.place}\n{self.log.read_text()[-3000:]}"

    def request(self, behaviour: str, parameters: dict[str, Value], robots: tuple[str, ...] = ()) -> PendingRequest:
        asked = self.operator.request(behaviour, robots, parameters)
        self.until(
            lambda: asked.status is not None and asked.status.phase in ("running", "ended"), f"{behaviour} runs", 15.0
        )
        return asked

    def close(self) -> None:
        self.operator.close()
        self.view.close()
        self.bus.close()
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(20.0) in (0, 130)


@pytest.fixture(scope="module")
def swarm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    live = Up(tmp_path_factory.mktemp("examples"))
    yield live
    live.close()


def test_an_auction_puts_one_robot_at_each_task(swarm: Up) -> None:
    swarm.request("auction_bc", {"tasks": TASKS})

    def served() -> bool:
        apart = np.linalg.norm(swarm.places[:, None] - TASKS, axis=2)
        return sorted(apart.argmin(axis=1).tolist()) == [0, 1, 2] and bool(apart.min(axis=1).max() < 0.2)

    swarm.until(served, "a robot is at each task", 40.0)


def test_the_mean_is_agreed_on_and_lined_up_at(swarm: Up) -> None:
    mean_m = swarm.places[:, 0].mean()
    swarm.request("average_bc", {"wait_s": 3.0})
    swarm.until(lambda: bool(np.abs(swarm.places[:, 0] - mean_m).max() < 0.2), "all are at the mean x", 40.0)


def test_the_leader_arrives_with_the_others_behind_it(swarm: Up) -> None:
    swarm.request("follow_the_leader_bc", {"leader_goal": [7.5, 8.0]})

    def behind() -> bool:
        gaps = np.linalg.norm(np.diff(swarm.places, axis=0), axis=1)
        return float(np.linalg.norm(swarm.places[0] - [7.5, 8.0])) < 0.2 and bool((np.abs(gaps - 0.8) < 0.25).all())

    swarm.until(behind, "the leader is at its goal, the others are in line", 60.0)


def test_pursuers_come_to_drive_around_one_circle(swarm: Up) -> None:
    swarm.request("pursue_next_bc", {"radius_m": 1.0})

    def circle() -> bool:
        radius = np.linalg.norm(swarm.places - swarm.places.mean(axis=0), axis=1)
        return bool((np.abs(radius - 1.0) < 0.25).all())

    swarm.until(circle, "all are on one circle", 60.0)


def test_waypoints_end_with_a_result(swarm: Up) -> None:
    x, y = swarm.places[0].tolist()
    asked = swarm.request("waypoints_bc", {"waypoints": [[x + 0.3, y + 0.5], [x, y]], "reach_m": 0.2}, ("r1",))
    swarm.until(lambda: asked.status is not None and asked.status.phase == "ended", "it has ended", 40.0)
    assert asked.status is not None
    assert [each.text for each in asked.status.results] == ["all 2 waypoints"]


def test_foragers_bring_their_loads(swarm: Up) -> None:
    given = {"food": [[8.0, 8.0], [2.0, 8.0]], "nest": [5.0, 5.0], "loads": 1.0, "sight_m": 9.0, "reach_m": 1.2}
    asked = swarm.request("forage_bc", given)  # type: ignore[arg-type]
    swarm.until(lambda: asked.status is not None and asked.status.phase == "ended", "all loads are in the nest", 90.0)


def test_all_of_them_run_in_an_experiment() -> None:
    command = [sys.executable, "-m", "fullswarm", "experiment", "run", str(EXAMPLES / "experiment.toml")]
    done = subprocess.run(
        [*command, "--small", "--json"], env=os.environ | {DEVELOP: str(EXAMPLES)}, capture_output=True, text=True,
        timeout=300.0,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert (document["trials_done"], document["trials_failed"]) == (6, 0)
    assert {cell["behaviour"] for cell in document["cells"]} == {
        f"{name}_bc" for name in ("auction", "average", "follow_the_leader", "forage", "pursue_next", "waypoints")
    }
    assert sum(cell["collisions"] for cell in document["cells"]) == 0
