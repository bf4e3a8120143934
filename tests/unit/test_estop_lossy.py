"""E-stops on a bus that loses a fifth and doubles a fifth of all messages: real agents, core and operators."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeVar

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fullswarm.agent.node import AgentNode
from fullswarm.agent.orders.estops import LatchFolder
from fullswarm.agent.state import Identity
from fullswarm.bus import Subscription
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.core.node import CoreNode
from fullswarm.keys import Keys
from fullswarm.messages import EStop, HealthReport, Message, Value
from fullswarm.operator.client import Operator
from fullswarm.operator.estop import EStopOrder
from fullswarm.runtime import Runtime
from fullswarm.simulation.fleet import SimFleet
from fullswarm.simulation.world import World
from fullswarm.store import Store
from fullswarm.testing.node import LoopbackBus

KEYS = Keys()
TICK_S = 0.02
LOSS = 0.2
M = TypeVar("M", bound=Message)
ROBOTS = ("r0", "r1", "r2")
FAR: dict[str, Value] = {"goal": [80.0, 10.0], "gain": 1.0}


class RoughBus(LoopbackBus):
    """Loses and doubles; a double may come late, so that it is overtaken. It can be cut per robot."""

    def __init__(self, runtime: Runtime, seed: int) -> None:
        super().__init__(runtime.mailbox, loss=LOSS, seed=seed)
        self.runtime, self.chance = runtime, random.Random(seed + 1)

    def publish(self, key: str, message: Message) -> None:
        super().publish(key, message)
        if self.chance.random() < LOSS:
            self.runtime.after(self.chance.uniform(0.0, 0.3), lambda: super(RoughBus, self).publish(key, message))


class Gate:
    """One robot's way to the bus, which may be cut."""

    def __init__(self, bus: RoughBus) -> None:
        self.bus, self.open = bus, True

    def publish(self, key: str, message: Message) -> None:
        if self.open:
            self.bus.publish(key, message)

    def subscribe(
        self, expression: str, kind: type[M], handler: Callable[[M], None], *, latest: bool = False
    ) -> Subscription:
        def pass_on(message: M) -> None:
            if self.open:
                handler(message)

        return self.bus.subscribe(expression, kind, pass_on, latest=latest)

    def connected(self) -> bool:
        return self.open

    def close(self) -> None:
        self.open = False


class Rig:
    """Three robots in one world each, their agents with a disk, a core with a database, two operators."""

    def __init__(self, seed: int, folder: Path) -> None:
        self.folder, self.starts = folder, 0
        self.runtime = Runtime(SimClock())
        self.bus = RoughBus(self.runtime, seed)
        robots = [{"id": robot, "pose": (2.0, 10.0 * row, 0.0)} for row, robot in enumerate(ROBOTS)]
        world = {"engine": "kinematic", "walls": False, "bounds_m": (-50.0, -50.0, 90.0, 90.0)}
        self.config = SwarmConfig.model_validate({"robot": robots, "world": world})
        self.worlds = {
            robot: World(self.config.world_or_default, (robot,), np.array([robots[row]["pose"]], float))
            for row, robot in enumerate(ROBOTS)
        }
        for each in self.worlds.values():
            self.runtime.every(TICK_S, each.step)
        self.core: CoreNode | None = None
        self.store: Store | None = None
        self.agents: dict[str, AgentNode] = {}
        self.gates: dict[str, Gate] = {}
        self.start_core()
        for robot in ROBOTS:
            self.start_agent(robot)
        self.operators = [Operator(self.bus, KEYS, self.runtime, name) for name in ("ann", "bob")]
        self.run(1.0)

    def run(self, seconds: float) -> None:
        self.runtime.run(seconds)

    def start_core(self) -> None:
        self.starts += 1
        self.store = Store(self.folder / "core.db")
        self.core = CoreNode(self.bus, self.runtime, self.config, self.store, f"core-{self.starts}")

    def kill_core(self) -> None:
        if self.core is not None and self.store is not None:
            self.core.close()
            self.store.close()
        self.core = self.store = None

    def start_agent(self, robot: str) -> None:
        self.starts += 1
        world = self.worlds[robot]
        self.gates[robot] = gate = Gate(self.bus)
        agent = AgentNode(
            gate, self.runtime, self.config, SimFleet(world, self.runtime.now_s),
            Identity(robot, f"{robot}-{self.starts}"), world.pose.copy(), self.runtime.stats,
        )  # fmt: skip
        agent.inbox.remember_latches(LatchFolder(self.folder / "latches"))
        self.agents[robot] = agent

    def kill_agent(self, robot: str) -> None:
        if robot in self.agents:
            self.agents.pop(robot).close()

    def restart(self, robot: str) -> None:
        self.kill_agent(robot)
        self.start_agent(robot)

    def press(self, who: int, *, engaged: bool, deadline_s: float = 10.0) -> EStopOrder:
        return self.operators[who].estop(engaged, known=lambda: ROBOTS, deadline_s=deadline_s)

    def request(self) -> None:
        self.operators[0].request("move_to_goal", (), FAR)

    def latched(self) -> list[bool]:
        return [bool(self.agents[robot].controller.estop[0]) for robot in ROBOTS if robot in self.agents]

    def driven(self) -> list[str]:
        return [robot for robot, agent in self.agents.items() if agent.setpoints.any()]

    def never_driven(self, seconds: float) -> None:
        end_s = self.runtime.now_s() + seconds
        while self.runtime.now_s() < end_s:
            self.run(TICK_S)
            assert self.driven() == []

    def close(self) -> None:
        for robot in ROBOTS:
            self.kill_agent(robot)
        self.kill_core()
        self.bus.close()


@contextmanager
def rig(seed: int) -> Iterator[Rig]:
    with TemporaryDirectory() as folder:
        made = Rig(seed, Path(folder))
        try:
            yield made
        finally:
            made.close()


ACTS = st.sampled_from(["request", "press", "press by bob", "clear", "agent", "core", "no core", "wait"])


@settings(max_examples=8, deadline=None, suppress_health_check=list(HealthCheck), derandomize=True)
@given(seed=st.integers(0, 10_000), acts=st.lists(ACTS, max_size=6))
def test_whatever_came_before_an_e_stop_holds_all_and_a_release_frees_all(seed: int, acts: list[str]) -> None:
    with rig(seed) as it:
        for act in acts:
            if act == "request":
                it.request()
            elif act.startswith("press"):
                it.press("bob" in act, engaged=True)
            elif act == "clear":
                it.press(1, engaged=False)
            elif act == "agent":
                it.restart("r1")
            elif act == "no core":
                it.kill_core()
            elif act == "core":
                it.kill_core()
                it.start_core()
            it.run(0.5)
        it.run(3.0)  # what somebody still repeats is answered

        order = it.press(0, engaged=True)
        it.run(2.0)
        assert (order.done, order.unconfirmed()) == (True, ())
        assert set(order.receipts) == set(ROBOTS)
        it.request()
        it.restart("r2")
        if it.core is None:
            it.start_core()
        it.never_driven(1.5)
        assert it.latched() == [True] * 3, "also the one whose agent is new"

        order = it.press(1, engaged=False)
        it.run(1.5)
        assert (order.unconfirmed(), order.overruled_by) == ((), "")
        it.never_driven(2.0)
        assert it.latched() == [False] * 3
        assert all(each.tasks.of[0] is None for each in it.agents.values())
        it.request()
        it.run(4.0)
        assert sorted(it.driven()) == list(ROBOTS)


@pytest.mark.parametrize("seed", range(4))
def test_one_who_was_away_is_latched_when_it_comes_although_nobody_presses_any_more(seed: int) -> None:
    with rig(seed) as it:
        it.kill_agent("r2")
        order = it.press(0, engaged=True, deadline_s=1.0)
        it.run(2.0)
        assert order.unconfirmed() == ("r2",)
        it.start_agent("r2")
        it.run(4.0)
        assert it.latched() == [True] * 3


@pytest.mark.parametrize("pressing", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_one_who_was_cut_off_while_it_drove_is_latched_when_it_hears_again(seed: int, pressing: bool) -> None:
    with rig(seed) as it:
        it.request()
        it.run(3.0)
        assert "r2" in it.driven()
        it.gates["r2"].open = False
        order = it.press(0, engaged=True, deadline_s=60.0 if pressing else 1.0)
        it.run(4.0)
        assert order.unconfirmed() == ("r2",)
        assert it.latched() == [True, True, False]
        it.gates["r2"].open = True
        it.run(1.0 if pressing else 4.0)
        assert it.latched() == [True] * 3
        assert order.unconfirmed() == (() if pressing else ("r2",))
        it.never_driven(2.0)


@pytest.mark.parametrize("seed", range(4))
def test_core_and_agents_start_anew_at_once(seed: int) -> None:
    with rig(seed) as it:
        it.press(0, engaged=True)
        it.run(2.0)
        it.kill_core()
        for robot in ROBOTS:
            it.restart(robot)
        assert it.latched() == [True] * 3, "before anybody has told them anything"
        it.start_core()
        it.request()
        it.never_driven(3.0)


def test_one_order_is_repeated_until_the_core_gets_through() -> None:
    """The core's own order to an agent that lost its latch may be lost too."""
    with rig(1) as it:
        it.press(0, engaged=True)
        it.run(2.0)
        (it.folder / "latches" / "r1.estop").unlink()
        deaf = it.bus._local.publish
        heard: list[str] = []

        def lose(key: str, message: Message, *, sender: str = "") -> None:
            if isinstance(message, EStop) and message.source.startswith("core"):
                heard.append(message.id)
                if len(heard) < 3:
                    return
            deaf(key, message, sender=sender)

        it.bus._local.publish = lose  # type: ignore[method-assign]  # a network that picks
        it.restart("r1")
        it.run(6.0)
        assert len(heard) >= 3
        assert it.latched() == [True] * 3


def test_two_operators_get_each_their_own_receipts() -> None:
    with rig(3) as it:
        it.request()
        it.run(1.0)
        orders = [it.press(0, engaged=True), it.press(1, engaged=True)]
        it.run(3.0)
        for order in orders:
            assert order.unconfirmed() == ()
            assert {each.id for each in order.receipts.values()} == {order.message.id}


def test_a_release_that_the_core_missed_is_learned_from_the_receipts() -> None:
    with rig(5) as it:
        it.press(0, engaged=True)
        it.run(2.0)
        assert it.core is not None
        publish = it.bus._local.publish

        def lose(key: str, message: Message, *, sender: str = "") -> None:
            if isinstance(message, HealthReport):
                return
            publish(key, message, sender=sender)

        it.bus._local.publish = lose  # type: ignore[method-assign]  # the core has the receipts alone
        it.bus._loss = 0.0
        for agent in it.agents.values():
            agent.inbox._on_estop(EStop(id="button", engaged=False, source="button"))
        it.run(0.5)
        it.bus._local.publish = publish  # type: ignore[method-assign]  # as it was
        for robot in ROBOTS:
            it.restart(robot)
        it.run(4.0)
        assert it.latched() == [False] * 3
