"""A mission in real processes whose core is killed in every step. What robots did is taken from their own answers."""

from __future__ import annotations

import itertools
import math
import random
from collections import defaultdict
from collections.abc import Iterator
from typing import Any

import pytest

from fullswarm.clock import clock_id
from fullswarm.config.mission_file import parse_mission
from fullswarm.keys import Keys
from fullswarm.messages import ControlAck, MissionReply, MissionStatus, RobotStates
from fullswarm.operator.missions import MissionClient
from tests.system.live import LiveSwarm

WEST, EAST = ("r1", "r2"), ("r3",)
MISSION = """
name = "five"

[tracks.west]
robots = ["r1", "r2"]
[[tracks.west.steps]]
name = "out"
behaviour = "navigate_each_bc"
parameters = { shape = "line", centre = [6.0, 4.0], spacing_m = 1.5 }
done = { arrived = "all" }
[[tracks.west.steps]]
name = "look"
behaviour = "flocking_bc"
done = { time_s = 1.5 }
[[tracks.west.steps]]
name = "home"
behaviour = "navigate_each_bc"
parameters = { shape = "line", centre = [3.0, 4.0], spacing_m = 1.5 }
done = { arrived = "all" }

[tracks.east]
robots = ["r3"]
[[tracks.east.steps]]
name = "wait"
done = { time_s = 1.5 }
[[tracks.east.steps]]
name = "follow"
behaviour = "move_to_goal_bc"
parameters = { goal = [X_M, 12.0] }
after = ["west/out"]
done = { arrived = "all" }
"""
STEPS = ("west/out", "east/wait", "west/look", "east/follow", "west/home")
ORDER = {"r1": ["west.1.1", "west.2.1", "west.3.1"], "r2": ["west.1.1", "west.2.1", "west.3.1"], "r3": ["east.2.1"]}
NEAR_M = 1.2
"""Half the line's spacing, the radius of arrival, and what a robot may drive between two of its reports."""


class Fleet:
    """A live swarm with a client of missions, and what its robots answered and where they were then."""

    def __init__(self) -> None:
        poses = ((3.0, 3.0, 0.0), (3.0, 5.0, 0.0), (3.0, 12.0, 0.0))
        self.live = LiveSwarm(
            {
                "world": {"engine": "kinematic", "walls": False},
                "robot": [{"id": robot, "pose": pose} for robot, pose in zip((*WEST, *EAST), poses, strict=True)],
            },
            watch=False,
        )
        self.mission = ""
        self.centres: dict[str, tuple[float, float]] = {}  # where each step that is to arrive leads
        self.places: dict[str, tuple[float, float]] = {}
        self.began: dict[str, list[tuple[str, tuple[float, float]]]] = defaultdict(list)
        self._answered: set[tuple[str, str, int]] = set()
        bus, keys = self.live.bus, Keys(self.live.config.swarm)
        bus.subscribe(keys.ack(), ControlAck, self._acknowledged)
        bus.subscribe(keys.state(), RobotStates, self._moved)
        self.client = MissionClient(bus, keys, self.live.runtime, "test", name="anna", clock=clock_id())
        self.live.until(lambda: len(self.places) == len(ORDER), 10.0, "all states are received")

    @property
    def status(self) -> MissionStatus | None:
        return self.client.missions.get(self.mission)

    def _moved(self, states: RobotStates) -> None:
        self.places.update(zip(states.robots, zip(states.x_m, states.y_m, strict=True), strict=True))

    def _acknowledged(self, ack: ControlAck) -> None:
        """Note each control request that a robot has carried out by starting it; its answer may come several times."""
        if not (ack.accepted and ack.enabled) or (ack.robot, ack.core, ack.sequence) in self._answered:
            return
        self._answered.add((ack.robot, ack.core, ack.sequence))
        self.began[ack.robot].append((ack.request_id.partition(".")[2], self.places[ack.robot]))

    def ask(self, op: Any, **more: Any) -> MissionReply:
        pending = self.client.ask(op, **more)
        self.live.until(lambda: pending.reply is not None, 20.0, f"{op} is answered")
        assert pending.reply is not None
        return pending.reply

    def phase(self, path: str) -> str:
        assert self.status is not None
        track, _, name = path.partition("/")
        steps = next(each.steps for each in self.status.tracks if each.name == track)
        return next(each.phase for each in steps if each.name == name)

    def reason(self) -> str:
        assert self.status is not None
        return self.status.reason

    def begin(self) -> None:
        """Start the mission; r3, which does not come home in it, goes to its goal and back in turn."""
        x_m = 6.0 if self.places["r3"][0] < 4.5 else 3.0
        self.centres = {"west.1.1": (6.0, 4.0), "west.3.1": (3.0, 4.0), "east.2.1": (x_m, 12.0)}
        self.began.clear()
        reply = self.ask("start", plan=parse_mission(MISSION.replace("X_M", str(x_m)), "five.toml", "five").plan)
        assert reply.ok, reply
        self.mission = reply.mission
        self.live.until(lambda: self.status is not None, 5.0, "its status")

    def restart_core(self, away_s: float) -> None:
        self.live.supervisor.kill("core")
        self.live.rest(away_s)
        self.live.supervisor.revive("core")

    def until_begun(self, path: str) -> None:
        self.live.until(lambda: self.phase(path) != "waiting", 60.0, f"{path} begins")

    def until_phase(self, phase: str) -> None:
        self.live.until(lambda: self.status is not None and self.status.phase == phase, 90.0, f"it is {phase}")

    def moved_m(self, seconds: float) -> float:
        """Return how far the robots get within a time, the farthest of them."""
        before = dict(self.places)
        self.live.rest(seconds)
        return max(math.dist(before[robot], self.places[robot]) for robot in before)


@pytest.fixture(scope="module")
def fleet() -> Iterator[Fleet]:
    made = Fleet()
    yield made
    made.client.close()
    made.live.close()


@pytest.mark.parametrize("seed", [1, 2])
def test_a_mission_whose_core_is_killed_in_every_step_does_each_step_once(fleet: Fleet, seed: int) -> None:
    chance = random.Random(seed)
    fleet.begin()
    killed_in: set[str] = set()
    for path in STEPS:
        fleet.until_begun(path)
        fleet.live.rest(chance.uniform(0.0, 0.6))
        if fleet.phase(path) == "running":
            killed_in.update(each for each in STEPS if fleet.phase(each) == "running")
            fleet.restart_core(chance.uniform(0.0, 1.5))
    fleet.until_phase("done")
    assert killed_in == set(STEPS), "a step was over before its core could be killed"
    assert {robot: [name for name, _ in steps] for robot, steps in fleet.began.items()} == ORDER
    for robot, steps in fleet.began.items():
        for (before, _), (after, place) in itertools.pairwise(steps):
            if before in fleet.centres:
                assert math.dist(place, fleet.centres[before]) < NEAR_M, (
                    f"{robot} began {after} before {before} was done"
                )
        last = steps[-1][0]
        assert math.dist(fleet.places[robot], fleet.centres[last]) < NEAR_M
    assert fleet.moved_m(1.0) < 0.1


def test_a_stop_that_no_core_received_pauses_the_mission(fleet: Fleet) -> None:
    fleet.begin()
    fleet.live.until(lambda: len(fleet.began) == len(ORDER), 20.0, "its robots have begun")
    assert fleet.moved_m(0.5) > 0.05
    fleet.live.supervisor.kill("core")
    fleet.live.operator.stop()
    fleet.live.rest(1.0)
    fleet.live.supervisor.revive("core")
    fleet.until_phase("paused")
    assert fleet.reason() == "stopped by test"
    assert fleet.moved_m(2.0) < 0.05
    assert fleet.ask("resume").ok
    fleet.live.rest(1.0)
    assert fleet.moved_m(0.5) > 0.05
    assert fleet.ask("abort").ok
