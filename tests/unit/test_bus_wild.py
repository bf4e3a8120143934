"""Whatever decodes, of any type, on any key: no node raises, and the robots still obey."""

from __future__ import annotations

import json
import random
from typing import Any

import numpy as np
import pytest

from fullswarm.agent.node import AgentNode
from fullswarm.agent.state import Identity
from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.launch import nodes
from fullswarm.messages import EStop, Message
from fullswarm.operator.client import Operator
from fullswarm.operator.console.gateway import Gateway
from fullswarm.operator.console.gateway import Identity as Console
from fullswarm.operator.view import FleetView
from fullswarm.runtime import Mailbox, Runtime
from fullswarm.simulation.fleet import SimFleet
from fullswarm.simulation.world import World
from tests.unit.wild import Wild

KEYS = Keys()
ROBOTS = ("r1", "r2", "r3")
WORDS = (
    *ROBOTS, "@team", "somebody", "core", "centralised", "move_to_goal", "move_to_goal_bc", "flocking_bc",
    "navigate_bc", "formation", "formation_assigned_bc", "teleop_centroid", "drive", "drive_bc", "stop", "work",
    "collisions", "coverage", "robots", "truth", "goal", "gain", "targets", "shape", "hearing_m", "safety_margin_m",
    "map", "x_m", "y_m", "heading_rad", "deviation_m", "ticks", "arrived_s", "agent/safety_margin_m",
    "schedule_interval_s", "performance/coverage_at_least", "group/team", "q1", "q2",
)  # fmt: skip


class Listening(LocalBus):
    """Knows who listens to what."""

    def addresses(self) -> list[tuple[str, type[Message]]]:
        return [(each.expression, each.kind) for each in self._subscriptions if each.kind is not Message]


class Page:
    """A browser that reads all that it is sent as JSON."""

    def put(self, kind: str, text: str) -> None:
        assert json.loads(text)["t"] == kind


class Swarm:
    """Core with statistics, centralised node, an agent for each of three robots, an operator's view and a console."""

    def __init__(self) -> None:
        self.runtime = Runtime(SimClock(50.0), Mailbox())
        self.bus = Listening(self.runtime.mailbox)
        poses = [(4.0 + 4.0 * k, 10.0, 0.0) for k in range(len(ROBOTS))]
        self.config = SwarmConfig.model_validate(
            {
                "robot": [{"id": robot, "pose": pose} for robot, pose in zip(ROBOTS, poses, strict=True)],
                "world": {"engine": "kinematic", "boxes": [(10.0, 4.0, 1.0, 1.0, 0.0)]},
                "groups": {"team": ["r1", "r2"]},
            }
        )
        self.core = nodes.core(self.bus, self.runtime, self.config, "core-0", lambda: 1.7e9)
        self.centralised = nodes.centralised(self.bus, self.runtime, self.config, "centralised-0")
        self.agents: dict[str, AgentNode] = {}
        for robot, pose in zip(ROBOTS, poses, strict=True):
            world = World(self.config.world_or_default, (robot,), np.array([pose]))
            self.runtime.every(0.02, world.step)
            fleet = SimFleet(world, self.runtime.now_s)
            identity = Identity(robot, f"{robot}-0")
            self.agents[robot] = nodes.agent(self.bus, self.runtime, self.config, fleet, identity, self.runtime.stats)
        self.view = FleetView(self.bus, KEYS, self.runtime, ROBOTS)
        self.gateway = Gateway(
            self.bus, KEYS, self.runtime, Console("base", "console@base:1", "9.9", False), lambda: 1.7e9
        )
        self.gateway.join("session-1", "anna", Page())
        self.operator = Operator(self.bus, KEYS, self.runtime, "op")
        self.runtime.run(1.0)


@pytest.mark.parametrize("seed", range(3))
def test_no_message_ends_a_node_and_the_robots_still_obey(seed: int) -> None:
    swarm, wild, chance = Swarm(), Wild(seed, WORDS), random.Random(seed)
    for _ in range(600):
        expression, kind = chance.choice(swarm.bus.addresses())
        key = "/".join(chance.choice(WORDS[:5]) if part in ("*", "**") else part for part in expression.split("/"))
        message = wild.message(kind)
        try:
            swarm.bus.publish(key, message)
            swarm.runtime.run(chance.choice((0.0, 0.0, 0.0, 0.02)))
            swarm.view.snapshot()
        except Exception as error:
            raise AssertionError(f"{key}: {message}") from error
    assert_obeys(swarm)


def assert_obeys(swarm: Swarm) -> None:
    """After some quiet, and the release of any e-stop, every robot drives where it is told."""
    for agent in swarm.agents.values():
        assert agent.tasks.margin_m[0] >= 0.0
    swarm.runtime.run(5.0)
    swarm.bus.publish(KEYS.estop, EStop(id="release", engaged=False, source="op"))
    swarm.runtime.run(0.5)
    began = {robot: agent.pose[0].copy() for robot, agent in swarm.agents.items()}
    goal: Any = [10.0, 16.0]
    swarm.operator.request("move_to_goal", ROBOTS, {"goal": goal}, take=True)
    swarm.runtime.run(5.0)
    for robot, agent in swarm.agents.items():
        before = float(np.hypot(*(began[robot][:2] - goal)))
        now = float(np.hypot(*(agent.pose[0, :2] - goal)))
        assert now < before - 0.5 or now < 0.3, (robot, before, now, agent.tasks.of[0], agent.inbox.ended)
