"""The real core, centralised node and a real agent per robot, on a bus that misbehaves and a simulated clock."""

from __future__ import annotations

import random
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from fullswarm.agent.node import AgentNode
from fullswarm.agent.orders.estops import LatchFolder
from fullswarm.agent.state import Identity
from fullswarm.bus.local import LocalBus
from fullswarm.clock import Clock, SimClock
from fullswarm.config import SwarmConfig
from fullswarm.core.centralised.node import CentralisedNode
from fullswarm.core.node import CoreNode
from fullswarm.keys import Keys
from fullswarm.messages import (
    BehaviourRequest,
    CentralisedCommands,
    CentralisedRequest,
    Command,
    ControlAck,
    ControlRequest,
    EStop,
    EStopReceipt,
    HealthReport,
    Heartbeat,
    Message,
    RequestStatus,
    StopRequest,
)
from fullswarm.operator.client import Operator
from fullswarm.runtime import Mailbox, Runtime
from fullswarm.simulation.fleet import SimFleet
from fullswarm.simulation.world import World
from fullswarm.store import Store

KEYS = Keys()
TICK_S = 0.02
SHAKEN = (
    BehaviourRequest, RequestStatus, ControlRequest, ControlAck, HealthReport, StopRequest, EStop, EStopReceipt,
    CentralisedRequest, CentralisedCommands, Command, Heartbeat,
)  # fmt: skip


class ShakyBus(LocalBus):
    """Loses, doubles and delays messages, so that they also overtake each other; `hub` False: it loses all."""

    def __init__(self, runtime: Runtime, seed: int) -> None:
        super().__init__(runtime.mailbox)
        self.runtime, self.chance = runtime, random.Random(seed)
        self.shaking, self.hub = 0.0, True
        self.delay_s = 0.12
        self.shaken: tuple[type[Message], ...] = SHAKEN
        self.answers: list[ControlAck] = []  # before anything happens to them

    def publish(self, key: str, message: Message, *, sender: str = "") -> None:
        if isinstance(message, ControlAck):
            self.answers.append(message)
        if not self.hub:
            return
        if not self.shaking or not isinstance(message, self.shaken):
            super().publish(key, message, sender=sender)
            return
        lost, late, again = (self.chance.random() < self.shaking for _ in range(3))
        if lost:
            return
        # What an operator sends comes in his order, though copies of it may come later.
        late = late and not isinstance(message, BehaviourRequest | StopRequest | EStop)
        for is_late in (late, True) if again else (late,):
            if is_late:
                self.runtime.after(self.chance.uniform(0.0, self.delay_s), lambda: self._late(key, message))
            else:
                super().publish(key, message, sender=sender)

    def _late(self, key: str, message: Message) -> None:
        if self.hub:
            super().publish(key, message)

    def connected(self) -> bool:
        return self.hub and super().connected()


@dataclass
class Whole:
    """`count` robots r0, r1, … each with its own agent and its own world."""

    seed: int = 0
    count: int = 3
    path: Path | None = None
    latches: Path | None = None  # of the agents, if they keep any
    clock: Clock = field(default_factory=SimClock)
    statuses: dict[str, RequestStatus] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.runtime = Runtime(self.clock, Mailbox())
        self.bus = ShakyBus(self.runtime, self.seed)
        robots = [{"id": f"r{k}", "pose": (4.0 + 3.0 * k, 10.0, 0.0)} for k in range(self.count)]
        world = {"engine": "kinematic", "walls": False, "bounds_m": (-50.0, -50.0, 90.0, 90.0)}
        self.config = SwarmConfig.model_validate({"robot": robots, "world": world})
        self.starts = self.cores = 0
        self.worlds = {
            f"r{k}": World(self.config.world_or_default, (f"r{k}",), np.array([robots[k]["pose"]], float))
            for k in range(self.count)
        }
        for each in self.worlds.values():
            self.runtime.every(TICK_S, each.step)
        self.agents: dict[str, AgentNode] = {}
        self.stops: set[tuple[str, str]] = set()
        self.bus.subscribe("**", StopRequest, self._ended)
        self.bus.subscribe("**", EStop, self._ended)
        self.start_core()
        self.start_centralised()
        for robot in self.worlds:
            self.start_agent(robot)
        self.operator = Operator(self.bus, KEYS, self.runtime, "op")
        self.bus.subscribe(KEYS.behaviour_status, RequestStatus, self._told)
        self.run(0.2)

    def _told(self, status: RequestStatus) -> None:
        self.statuses[status.request_id] = status

    def _ended(self, order: StopRequest | EStop) -> None:
        """Note that what ran has ended, without a word to the core."""
        for robot in order.robots or tuple(self.worlds):
            if (robot, order.id) not in self.stops:
                self.stops.add((robot, order.id))
                self._note_end(robot)

    def _note_end(self, robot: str) -> None:
        self.bus.answers.append(ControlAck(request_id="", robot=robot, behaviour="", enabled=False, accepted=True))

    def start_core(self, store: Store | None = None) -> None:
        self.cores += 1
        self.store = store or Store(self.path)
        self.core = CoreNode(self.bus, self.runtime, self.config, self.store, f"core-{self.cores}")

    def kill_core(self) -> None:
        self.core.close()
        self.store.close()

    def start_centralised(self) -> None:
        self.starts += 1
        self.centralised = CentralisedNode(self.bus, self.runtime, self.config, f"n-{self.starts}")

    def start_agent(self, robot: str) -> None:
        self.starts += 1
        world = self.worlds[robot]
        identity = Identity(robot, f"{robot}-{self.starts}")
        fleet = SimFleet(world, self.runtime.now_s)
        self.agents[robot] = AgentNode(
            self.bus, self.runtime, self.config, fleet, identity, world.pose.copy(), self.runtime.stats
        )
        if self.latches is not None:
            self.agents[robot].inbox.remember_latches(LatchFolder(self.latches, "lab"))

    def kill_agent(self, robot: str) -> None:
        self._note_end(robot)
        self.stops = {each for each in self.stops if each[0] != robot}  # the next process has heard of none
        self.agents.pop(robot).close()

    def run(self, seconds: float) -> None:
        self.runtime.run(seconds)

    def status(self, request_id: str) -> RequestStatus:
        """Return the core's newest word on a request, asked for by repeating it."""
        self.statuses.pop(request_id, None)
        self.bus.publish(KEYS.behaviour_request, BehaviourRequest(id=request_id, behaviour="copy"))
        self.run(0.01)
        return self.statuses[request_id]

    def running(self, robot: str) -> str:
        """Return the id of the request that a robot's agent runs; empty: none."""
        task = self.agents[robot].tasks.of[0]
        return task.request.request_id if task else ""

    def order_of(self, robot: str) -> str:
        """Return the id of the request that the core wants it to run; empty: none."""
        order = self.core.handler.order_of(robot)
        return "" if order is None or order.enables_nothing else order.request_id

    def driven(self) -> list[str]:
        """Return the robots whose wheels are told to turn."""
        return [robot for robot, agent in self.agents.items() if agent.setpoints.any()]

    def drives_within(self, seconds: float) -> list[str]:
        """Run and return the robots that were driven at any tick."""
        found: dict[str, None] = {}
        end_s = self.runtime.now_s() + seconds
        while self.runtime.now_s() < end_s - 1e-9:
            self.run(TICK_S)
            found.update(dict.fromkeys(self.driven()))
        return list(found)

    def close(self) -> None:
        for robot in list(self.agents):
            self.kill_agent(robot)
        self.centralised.close()
        self.kill_core()
        self.bus.close()
