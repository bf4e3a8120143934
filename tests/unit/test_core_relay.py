"""A cut link between two robots: the core relays their states, with their age, and only while a link is cut."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import count

import numpy as np
import pytest

from fullswarm.agent.neighbours.estimates import Assumed, Neighbours
from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.core.node import CoreNode
from fullswarm.core.relay import RELAY_S, StateRelay
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import Reception, RelayedStates, RobotStates
from fullswarm.operator.client import Operator
from fullswarm.runtime import Mailbox, Runtime

KEYS = Keys()
CUT = "partition=r0|r1"
BLIND = {"bodies": False}  # or the robots would see each other
CREATE = {"speed_limit_m_s": 0.5, "turn_limit_rad_s": 4.25, "accel_limit_m_s2": 2.0}
PAPER = {"speed_limit_m_s": 4.0, "turn_limit_rad_s": 0.785, "accel_limit_m_s2": 8.0}


class Meeting:
    """Robots r0 and r1 that drive to each other's place, each with an agent of its own."""

    def __init__(self, conditions: str, limits: dict[str, float], apart_m: float) -> None:
        places = [(10.0 - apart_m / 2, 10.0, 0.0), (10.0 + apart_m / 2, 10.0, math.pi)]
        self.lockstep = Lockstep(
            SwarmConfig.model_validate(
                {
                    "world": {"engine": "kinematic", "bounds_m": [0, 0, 20, 20], "sight": BLIND, **limits},
                    "robot": [{"id": f"r{row}", "pose": place} for row, place in enumerate(places)],
                    "network": {"conditions": conditions},
                }
            )
        )
        numbers = count()
        self.operator = Operator(
            self.lockstep.bus_of("operator"), KEYS, self.lockstep.runtime, "op", new_id=lambda: f"q{next(numbers)}"
        )
        self.goals = np.array([place[:2] for place in reversed(places)])
        self.touched = 0
        self.lockstep.world.watchers.append(self._watch)

    def _watch(self) -> None:
        self.touched += len(self.lockstep.world.pairs)

    def swap(self, limit_s: float) -> bool:
        """Have them swap places; return whether both arrive."""
        self.lockstep.run(1.0)
        for row, goal in enumerate(self.goals.tolist()):
            self.operator.request("move_to_goal_bc", (f"r{row}",), {"goal": goal, "arrive_radius_m": 0.2})
        while self.lockstep.runtime.now_s() < limit_s:
            self.lockstep.run(0.5)
            if (np.hypot(*(self.lockstep.world.pose[:, :2] - self.goals).T) < 0.3).all():
                return True
        return False

    @property
    def core(self) -> CoreNode:
        return next(node for node in self.lockstep._nodes if isinstance(node, CoreNode))


@contextmanager
def meeting(conditions: str = CUT, limits: dict[str, float] = CREATE, apart_m: float = 4.0) -> Iterator[Meeting]:
    made = Meeting(conditions, limits, apart_m)
    try:
        yield made
    finally:
        made.operator.close()
        made.lockstep.close()


@pytest.mark.parametrize(
    ("conditions", "limits", "apart_m"),
    [(CUT, CREATE, 4.0), ("loss=20%,partition=r0|r1@2s-60s", CREATE, 4.0), (CUT, PAPER, 10.0),
     ("partition=r0|r1@1.5s-60s", PAPER, 10.0)],
)  # fmt: skip
def test_robots_that_do_not_receive_each_other_pass_without_contact(
    conditions: str, limits: dict[str, float], apart_m: float
) -> None:
    with meeting(conditions, limits, apart_m) as made:
        assert made.swap(40.0)
        assert made.touched == 0
        assert made.core.relay.relayed > 0


def test_without_the_relay_they_touch() -> None:
    with meeting() as made:
        made.core.relay.close()
        made.swap(15.0)
        assert made.touched > 0


def test_nothing_is_relayed_while_no_link_is_cut() -> None:
    with meeting("loss=10%,delay=20ms") as made:
        made.lockstep.run(1.0)
        relayed: list[RelayedStates] = []
        made.lockstep.bus.subscribe(KEYS.relay(), RelayedStates, relayed.append)
        reports: list[Reception] = []
        made.lockstep.bus.subscribe(KEYS.reception(), Reception, reports.append)
        made.lockstep.run(10.0)
        # Five losses in a row are seldom, and what they cost is one relayed state each 0.1 s.
        assert len(relayed) < 5
        assert len(reports) <= 2 * 10 * 3


class Bench:
    """A relay, and hosts that are what the test publishes."""

    def __init__(self, cell_m: float = 0.0) -> None:
        self.mailbox = Mailbox()
        self.runtime = Runtime(SimClock(), self.mailbox)
        self.bus = LocalBus(self.mailbox)
        self.cell_m = cell_m
        self.relay = StateRelay(self.bus, KEYS, self.runtime, 3.0, cell_m)
        self.sent: list[RelayedStates] = []
        self.bus.subscribe(KEYS.relay(), RelayedStates, self.sent.append)
        self.sequence = 0

    def report(self, host: str, x_m: float, *received: str) -> None:
        self.bus.publish(
            KEYS.reception(host), Reception(host=host, robots=(host,), x_m=(x_m,), y_m=(0.0,), received=received)
        )

    def state(self, host: str, x_m: float, cell: str = "all") -> None:
        self.sequence += 1
        self.bus.publish(KEYS.state(cell, host), states(host, x_m, self.sequence))


def states(host: str, x_m: float, sequence: int) -> RobotStates:
    return RobotStates(
        host=host, sequence=sequence, stamp_s=0.05 * sequence, robots=(host,), x_m=(x_m,), y_m=(0.0,),
        heading_rad=(0.0,), speed_m_s=(0.0,), turn_rad_s=(0.0,), radius_m=(0.17,),
    )  # fmt: skip


def test_what_is_missed_is_sent_to_the_one_that_misses_it_with_its_age() -> None:
    bench = Bench()
    bench.report("a", 0.0, "b")
    bench.report("b", 1.0, "a")
    bench.report("c", 2.0, "a", "b")
    bench.runtime.run(0.01)
    assert (bench.relay.missing("a"), bench.relay.missing("b"), bench.relay.missing("c")) == ((), (), ())
    bench.report("a", 0.0, "b")
    bench.runtime.run(0.01)
    bench.report("b", 1.0, "a", "c")
    bench.report("a", 0.0, "b")
    bench.runtime.run(0.01)
    assert bench.relay.missing("a") == ("c",)
    bench.state("c", 2.0)
    bench.runtime.run(0.05)
    bench.state("b", 1.0)
    bench.runtime.run(4 * RELAY_S)
    assert {each.host for each in bench.sent} == {"a"}
    assert {one.states.host for each in bench.sent for one in each.relayed} == {"c"}
    ages = [one.age_s for each in bench.sent for one in each.relayed]
    assert ages == sorted(ages)
    assert ages[0] < RELAY_S + 1e-6 < ages[1] < 2 * RELAY_S + 1e-6


def test_a_silent_robot_is_not_relayed_for_ever() -> None:
    bench = Bench()
    for _ in range(2):
        bench.report("c", 2.0, "a")
        bench.report("a", 0.0)
        bench.runtime.run(0.01)
    bench.state("c", 2.0)
    for _ in range(10):
        bench.report("a", 0.0)
        bench.runtime.run(0.5)
    assert all(one.age_s <= 1.0 for each in bench.sent for one in each.relayed)
    assert bench.relay.missing("a") == ()


def test_only_states_of_subscribed_cells_are_missed() -> None:
    bench = Bench(cell_m=3.0)
    for _ in range(2):
        for host, x_m in (("a", 0.0), ("near", 4.0), ("far", 7.0)):
            bench.report(host, x_m)
        bench.runtime.run(0.01)
    assert set(bench.relay.missing("a")) == {"near"}
    assert set(bench.relay.missing("near")) == {"a", "far"}
    bench.state("near", 4.0, cell="1_0")
    bench.runtime.run(RELAY_S)
    assert [each.host for each in bench.sent for _ in each.relayed] == ["a", "far"]


def test_a_core_that_is_started_again_goes_on() -> None:
    with meeting() as made:
        made.lockstep.run(2.0)
        first = made.core.relay
        first.close()
        again = StateRelay(
            made.lockstep.bus_of("core"), KEYS, made.lockstep.runtime, 3.0, made.lockstep.config.state_cell_m
        )
        made.lockstep.run(0.8)
        assert again.missing("r0") == ("r1",)
        assert made.swap(40.0)
        assert made.touched == 0
        again.close()


def test_a_relayed_state_counts_from_when_it_was_measured_and_never_replaces_a_newer_one() -> None:
    table = Neighbours(("me",), 1.0, Assumed(2.0, 0.5, 4.25, 1.3))
    table.receive_relayed(states("other", 3.0, 5), 0.4, 10.0)
    assert table.arrival_s[0] == pytest.approx(9.6)
    table.receive(states("other", 4.0, 7), 10.1)
    table.receive_relayed(states("other", 3.5, 6), 0.1, 10.2)
    table.receive_relayed(states("other", 4.0, 7), 0.0, 10.2)
    assert (table.states[0, 0], table.arrival_s[0]) == (4.0, 10.1)
    table.receive_relayed(states("other", 4.5, 8), 0.1, 10.3)
    assert (table.states[0, 0], table.arrival_s[0]) == pytest.approx((4.5, 10.2))
