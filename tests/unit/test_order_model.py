"""Requests, leases, stops, e-stops and restarts in any order: the real core and agents do what a small model says."""

from __future__ import annotations

import tempfile
from pathlib import Path

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from fullswarm.messages import RequestStatus, Value
from fullswarm.operator.client import Operator
from fullswarm.operator.leases import LeaseHolder
from fullswarm.store import Store
from tests.unit.whole_swarm import KEYS, Whole

ROBOTS = ("r0", "r1", "r2")
OPERATORS = ("anna", "bob")
SETTLE_S = 1.3
"""After each step: two health reports, and the time after which a released latch is believed."""

some_robots = st.lists(st.sampled_from(ROBOTS), min_size=1, unique=True).map(lambda names: tuple(sorted(names)))
operators = st.sampled_from(OPERATORS)


class Orders(RuleBasedStateMachine):
    """The model: what each robot runs, whether it is latched, and who holds it."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        path = Path(self.folder.name)
        self.whole = Whole(path=path / "core.db", latches=path / "latches")
        self.operators = {
            name: Operator(self.whole.bus, KEYS, self.whole.runtime, name, clock="lab") for name in OPERATORS
        }
        self.holders = {name: LeaseHolder(self.whole.bus, KEYS, self.whole.runtime, name) for name in OPERATORS}
        self.runs = dict.fromkeys(ROBOTS, "")
        self.latched = dict.fromkeys(ROBOTS, False)
        self.held_by: dict[str, str] = {}
        self.statuses: dict[str, RequestStatus] = {}

    def teardown(self) -> None:
        for name in OPERATORS:
            self.operators[name].close()
            self.holders[name].close()
        self.whole.close()
        self.folder.cleanup()

    @initialize()
    def settle(self) -> None:
        self.whole.run(SETTLE_S)

    # ---------------------------------------------------------------- what operators do
    @rule(name=operators, robots=some_robots, take=st.booleans(), left=st.booleans())
    def request(self, name: str, robots: tuple[str, ...], take: bool, left: bool) -> None:
        goal: dict[str, Value] = {"goal": [-45.0 if left else 85.0, 10.0]}
        pending = self.operators[name].request("move_to_goal_bc", robots, goal, self._heard, take=take)
        self.settle()
        status = self.statuses[pending.request.id]
        if not take and any(self.held_by.get(robot, name) != name for robot in robots):
            assert status.phase == "refused"
            return
        for robot in robots:
            if robot in self.held_by:
                self.held_by[robot] = name
            if not self.latched[robot]:
                self.runs[robot] = pending.request.id
        refused = {robot for robot in robots if self.latched[robot]}
        assert set(status.refused_by) == refused
        assert set(status.running) == set(robots) - refused

    def _heard(self, status: RequestStatus) -> None:
        self.statuses[status.request_id] = status

    @rule(name=operators, robots=some_robots, take=st.booleans())
    def hold(self, name: str, robots: tuple[str, ...], take: bool) -> None:
        self.holders[name].hold(robots, take=take)
        self.settle()
        self.settle()  # a claim in vain is dropped after 1.5 s
        for robot in robots:
            if take or robot not in self.held_by:
                self.held_by[robot] = name

    @rule(name=operators)
    def give_back(self, name: str) -> None:
        self.holders[name].release()
        self.settle()
        self.held_by = {robot: holder for robot, holder in self.held_by.items() if holder != name}

    @rule(name=operators, robots=some_robots)
    def stop(self, name: str, robots: tuple[str, ...]) -> None:
        self.operators[name].stop(robots)
        self.settle()
        self.runs.update(dict.fromkeys(robots, ""))

    @rule(name=operators, robots=some_robots)
    def estop(self, name: str, robots: tuple[str, ...]) -> None:
        self.operators[name].estop(True, robots, known=lambda: robots)
        self.settle()
        self.runs.update(dict.fromkeys(robots, ""))
        self.latched.update(dict.fromkeys(robots, True))

    @precondition(lambda self: any(self.latched.values()))
    @rule(name=operators, robots=some_robots)
    def clear(self, name: str, robots: tuple[str, ...]) -> None:
        self.operators[name].estop(False, robots, known=lambda: robots)
        self.settle()
        self.latched.update(dict.fromkeys(robots, False))

    # ---------------------------------------------------------------- what dies
    @rule()
    def restart_core(self) -> None:
        self.whole.kill_core()
        self.whole.run(0.4)
        self.whole.start_core(Store(self.whole.path))
        self.settle()
        self.settle()  # the leases are renewed each second

    @rule(robot=st.sampled_from(ROBOTS))
    def restart_agent(self, robot: str) -> None:
        self.whole.kill_agent(robot)
        self.whole.run(0.2)
        self.whole.start_agent(robot)
        self.settle()

    @rule(robot=st.sampled_from(ROBOTS))
    def restart_both(self, robot: str) -> None:
        self.whole.kill_core()
        self.whole.kill_agent(robot)
        self.whole.run(0.2)
        self.whole.start_agent(robot)
        self.whole.start_core(Store(self.whole.path))
        self.settle()
        self.settle()

    # ---------------------------------------------------------------- what must hold
    @invariant()
    def robots_do_what_the_model_says(self) -> None:
        assert {robot: self.whole.running(robot) for robot in ROBOTS} == self.runs
        assert set(self.whole.driven()) == {robot for robot, request in self.runs.items() if request}

    @invariant()
    def latches_are_those_of_the_model(self) -> None:
        found = {robot: bool(self.whole.agents[robot].controller.estop[0]) for robot in ROBOTS}
        assert found == self.latched

    @invariant()
    def leases_are_those_of_the_model(self) -> None:
        for name, holder in self.holders.items():
            assert set(holder.held()) == {robot for robot, owner in self.held_by.items() if owner == name}


Orders.TestCase.settings = settings(max_examples=6, stateful_step_count=10, deadline=None)
test_orders = Orders.TestCase
