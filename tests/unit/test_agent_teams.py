"""Whom a law counts as neighbours: the robots of its own request, unless its record says the swarm."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import pytest

from fullswarm.agent.neighbours import estimates
from fullswarm.agent.neighbours.estimates import Neighbours
from fullswarm.bus.base import OPERATOR, NamedBus
from fullswarm.config import SwarmConfig
from fullswarm.core.behaviours import load_records, make_record
from fullswarm.errors import ConfigError
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.launch.network import with_network
from fullswarm.messages import RequestStatus, Value
from fullswarm.operator.client import Operator
from fullswarm.operator.params import ParamClient
from tests.unit.agent_bench import Bench
from tests.unit.test_agent_sensing import states

# Two groups of three, side by side, all within the reach of all.
STARTS = [(2.0, 2.0), (2.0, 5.0), (4.5, 3.5), (9.0, 2.0), (9.0, 5.0), (6.5, 3.5)]
ONE, OTHER = ("r1", "r2", "r3"), ("r4", "r5", "r6")
GROUPS = {"one": ONE, "other": OTHER, "pair": ("r1", "r4")}
MET_M = 0.9
"""Three discs of 0.17 m that keep apart are within this of their middle."""


class Swarm:
    """Six robots and an operator in lockstep: one agent for all, or on a network one for each, as on board."""

    def __init__(self, network: str | None) -> None:
        robots = [{"id": f"r{row + 1}", "pose": (*place, 0.3 * row)} for row, place in enumerate(STARTS)]
        world = {"engine": "kinematic", "bounds_m": (0.0, 0.0, 11.0, 7.0)}
        config = SwarmConfig.model_validate({"world": world, "robot": robots, "groups": GROUPS})
        self.lockstep = Lockstep(with_network(config, network) if network else config)
        self.bus = NamedBus(self.lockstep.bus, OPERATOR)
        self.operator = Operator(self.bus, Keys(), self.lockstep.runtime, "op")
        self.touched = 0
        self.lockstep.runtime.every(0.02, self._look)
        self.lockstep.run(1.0)

    def _look(self) -> None:
        self.touched += int(self.lockstep.world.contacts.sum())

    def ask(
        self, behaviour: str, robots: tuple[str, ...], parameters: dict[str, Value] | None = None, team: str = ""
    ) -> RequestStatus:
        answers: list[RequestStatus] = []
        self.operator.request(behaviour, robots, parameters or {}, answers.append, team=team)
        wanted = tuple(robot for each in robots for robot in GROUPS.get(each[1:], (each,)))
        for _ in range(8):  # on a bad network an answer may take some tries
            self.lockstep.run(0.5)
            if answers and answers[-1].phase == "refused":
                return answers[-1]
            if answers and answers[-1].running == wanted:
                break
        assert answers[-1].running == wanted
        return answers[-1]

    def store(self, name: str, record: dict[str, Any]) -> None:
        client = ParamClient(self.bus, Keys(), self.lockstep.runtime, "op")
        client.ask("set", f"behaviour/{name}", lambda _: None, record)
        self.lockstep.run(0.2)

    def meet(self, robots: tuple[str, ...]) -> None:
        """Let robots meet where they are; on a bad network it takes its time."""
        for _ in range(10):
            self.lockstep.run(5.0)
            if has_met(self.places(robots), middle(robots)):
                return
        raise AssertionError(f"they have not met: {self.places(robots).tolist()}")

    def places(self, robots: tuple[str, ...]) -> np.ndarray:
        rows = [int(robot[1:]) - 1 for robot in robots]
        places: np.ndarray = self.lockstep.world.pose[rows, :2]
        return places


def middle(robots: tuple[str, ...]) -> np.ndarray:
    places: np.ndarray = np.array(STARTS)[[int(robot[1:]) - 1 for robot in robots]]
    return np.array([places[:, 0].mean(), places[:, 1].mean()])


def has_met(places: np.ndarray, near: np.ndarray) -> bool:
    """Tell whether robots stand together, not far from `near`: filter and turning move their middle a little."""
    centre = places.mean(axis=0)
    together = float(np.linalg.norm(places - centre, axis=1).max()) < MET_M
    return together and float(np.linalg.norm(centre - near)) < 1.2


@pytest.fixture(params=[None, "loss=0%", "loss=20%,delay=50ms±30"], ids=["one agent", "an agent each", "bad network"])
def swarm(request: pytest.FixtureRequest) -> Iterator[Swarm]:
    made = Swarm(request.param)
    yield made
    made.operator.close()
    made.lockstep.close()


def test_robots_that_nobody_asked_do_not_draw_a_rendezvous(swarm: Swarm) -> None:
    swarm.ask("rendezvous_bc", ONE)
    swarm.meet(ONE)
    assert np.abs(swarm.places(OTHER) - [STARTS[row] for row in (3, 4, 5)]).max() < 0.05
    assert swarm.touched == 0


def test_two_rendezvous_meet_at_two_places(swarm: Swarm) -> None:
    swarm.ask("rendezvous_bc", ONE)
    swarm.ask("rendezvous_bc", OTHER)
    swarm.meet(ONE)
    swarm.meet(OTHER)
    assert swarm.touched == 0


def test_a_robot_that_is_asked_for_something_else_is_no_neighbour_any_more(swarm: Swarm) -> None:
    swarm.ask("rendezvous_bc", (*ONE, *OTHER))
    swarm.ask("stop", OTHER)
    swarm.meet(ONE)
    assert swarm.touched == 0


def test_a_record_may_make_neighbours_of_the_whole_swarm(swarm: Swarm) -> None:
    swarm.store("gather_bc", {"like": "rendezvous_bc", "team": "swarm"})
    swarm.ask("gather_bc", ONE)
    swarm.lockstep.run(20.0)
    assert not has_met(swarm.places(ONE), middle(ONE))
    assert swarm.places(ONE)[:, 0].mean() > middle(ONE)[0] + 1.5
    assert swarm.touched == 0


@pytest.fixture(params=[None, "loss=0%"], ids=["one agent", "an agent each"])
def tidy(request: pytest.FixtureRequest) -> Iterator[Swarm]:
    made = Swarm(request.param)
    yield made
    made.operator.close()
    made.lockstep.close()


def test_a_request_may_make_neighbours_of_its_group_whatever_it_runs(tidy: Swarm) -> None:
    tidy.ask("rendezvous_bc", ("r1", "r2"), team="group")  # `one` is the only group that holds both
    tidy.ask("move_to_goal_bc", ("r6",), {"goal": [6.4, 3.5]})
    tidy.lockstep.run(12.0)
    gaps = np.linalg.norm(tidy.places(("r1", "r2")) - tidy.places(("r3",)), axis=1)
    assert (gaps < MET_M).all()  # r3 runs nothing, and r6 is as near, but of another group
    assert np.abs(tidy.places(("r3",)) - STARTS[2]).max() < 0.05
    assert tidy.touched == 0


def test_requests_for_one_group_are_one_team(tidy: Swarm) -> None:
    tidy.ask("rendezvous_bc", ("@one",), team="group")
    tidy.ask("rendezvous_bc", ("r4",), team="@one")
    agents = tidy.lockstep.agents
    teams = {robot: int(agent.tasks.team[row]) for agent in agents for row, robot in enumerate(agent.fleet.ids)}
    assert len({teams[robot] for robot in (*ONE, "r4")}) == 1
    assert teams["r1"] != 0 == teams["r5"]
    tidy.lockstep.run(12.0)
    assert has_met(tidy.places((*ONE, "r4")), middle(ONE))  # r4 comes; the others do not wait for it
    tidy.ask("stop", (*ONE, "r4"))
    assert not any(agent.tasks.team.any() for agent in agents)


def test_a_request_may_say_another_team_than_its_record(tidy: Swarm) -> None:
    tidy.ask("rendezvous_bc", ONE, team="swarm")
    tidy.lockstep.run(12.0)
    assert tidy.places(ONE)[:, 0].mean() > middle(ONE)[0] + 1.5
    tidy.store("gather_bc", {"like": "rendezvous_bc", "team": "swarm"})
    tidy.ask("gather_bc", ONE, team="request")
    tidy.lockstep.run(8.0)
    assert has_met(tidy.places(ONE), tidy.places(ONE).mean(axis=0))


def test_a_team_that_is_not_clear_is_refused() -> None:
    swarm = Swarm(None)
    try:
        for robots, team, why in (
            (("r1",), "group", "several groups hold all its robots: @one, @pair"),
            (("r1", "r5"), "group", "no group holds all its robots"),
            (ONE, "everybody", "there is no team 'everybody' (request, group, swarm or @NAME)"),
            (ONE, "@west", "unknown group '@west'"),
        ):
            status = swarm.ask("rendezvous_bc", robots, team=team)
            assert status.phase == "refused"
            assert why in status.reason
        status = swarm.ask("drive", ONE, team="group")
        assert "is for sticks" in status.reason
        targets: dict[str, Value] = {"targets": [[2.0, 2.0], [3.0, 3.0], [4.0, 4.0]]}
        status = swarm.ask("formation_assigned_bc", ONE, targets, team="swarm")
        assert "always has the robots of its request as neighbours" in status.reason
    finally:
        swarm.operator.close()
        swarm.lockstep.close()


def test_the_filter_keeps_clear_of_another_team() -> None:
    swarm = Swarm("loss=0%")
    try:
        swarm.ask("move_to_goal_bc", ("r1",), {"goal": [9.0, 2.0]})  # where r4 stands
        swarm.lockstep.run(20.0)
        gap_m = float(np.linalg.norm(swarm.places(("r1",)) - swarm.places(("r4",)))) - 2 * 0.17
        assert 0.0 < gap_m < 0.5
        assert swarm.touched == 0
    finally:
        swarm.operator.close()
        swarm.lockstep.close()


def test_all_frames_of_a_stick_are_of_one_team_and_two_operators_are_two() -> None:
    swarm = Swarm(None)
    second = Operator(swarm.lockstep.bus, Keys(), swarm.lockstep.runtime, "op2")
    try:
        swarm.store("herd", {"summary": "", "law": "rendezvous", "expires_s": 0.3,
                             "static": {"gain": 1.0, "hearing_m": 30.0}})  # fmt: skip
        teams = set()
        for _ in range(20):
            swarm.operator.request("herd", ONE, {}, resend=False)
            second.request("herd", OTHER, {}, resend=False)
            swarm.lockstep.run(0.05)
            teams.add(tuple(swarm.lockstep.agent.tasks.team.tolist()))
        (team,) = teams
        assert team[0] == team[1] == team[2] != 0
        assert team[3] == team[4] == team[5] not in (0, team[0])
    finally:
        second.close()
        swarm.operator.close()
        swarm.lockstep.close()


# ------------------------------------------------------------------ parts
def test_states_carry_the_team_and_the_table_keeps_it() -> None:
    bench = Bench([(2.0, 2.0, 0.0)])
    heard: list[tuple[int, ...]] = []
    bench.bus.subscribe(bench.keys.state(), type(states("a", 1, 0.0)), lambda each: heard.append(each.teams))
    bench.enable("stop", team=77)
    bench.run(0.1)
    assert heard[-1] == (77,)
    bench.stop("s1")
    bench.run(0.1)
    assert heard[-1] == (0,)


def test_the_table_tells_teams_apart() -> None:
    table = Neighbours(("me",), timeout_s=1.0)
    table.receive(msgspec.structs.replace(states("a", 1, 0.0, a=(1.0, 0.0)), teams=(5,)), 0.0)
    table.receive(msgspec.structs.replace(states("b", 1, 0.0, b=(2.0, 0.0), c=(2.5, 0.0)), teams=(5, 6)), 0.0)
    table.receive(states("d", 1, 0.0, d=(1.5, 0.0)), 0.0)
    table.receive(msgspec.structs.replace(states("e", 1, 0.0, e=(1.7, 0.0)), teams=(5, 5)), 0.0)  # does not fit
    here = np.zeros((1, 2))

    def found(team: int) -> set[str]:
        start, other = table.within(here, 3.0, np.array([team]))
        return {table.names[row] for row in other[: start[-1]]}

    table.set_time(0.0)
    assert found(5) == {"a", "b"}
    assert found(6) == {"c"}
    assert found(7) == set()
    assert found(0) == {"a", "b", "c", "d"}
    start = table.around(here, 3.0).start
    assert start.tolist() == [0, 4]
    peers = {7: frozenset({"a", "d"}), 8: frozenset({"b"})}
    start, other = table.within(here, 3.0, np.array([7]), peers)
    assert {table.names[row] for row in other[: start[-1]]} == {"a", "d"}
    start, other = table.within(here, 3.0, np.array([5]), peers)
    assert {table.names[row] for row in other[: start[-1]]} == {"a", "b"}
    table.receive(states("a", 2, 0.1, a=(1.0, 0.0)), 0.1)  # it has ended what it ran
    table.set_time(0.1)
    assert found(5) == {"b"}


@pytest.mark.parametrize("compiled", [False, True])
def test_the_edge_list_keeps_its_order(compiled: bool) -> None:
    rng = np.random.default_rng(3)
    own, others = 40, 60
    count = rng.integers(0, 8, own)
    start = np.concatenate([[0], np.cumsum(count)]).astype(np.int64)
    other = rng.integers(0, others, start[-1]).astype(np.int64)
    own_team, teams = rng.integers(0, 4, own), rng.integers(0, 4, others)
    wanted = [[j for j in other[start[i] : start[i + 1]].tolist() if own_team[i] in (0, teams[j])] for i in range(own)]
    if compiled:
        pytest.importorskip("numba")
        estimates.keep_team.compile()
        estimates.keep_listed.compile()
    listed, place = rng.random((3, others)) < 0.5, rng.integers(-1, 3, own)
    both = start.copy(), other.copy()
    estimates.keep_team.run(start, other, own_team, teams)
    assert [other[start[i] : start[i + 1]].tolist() for i in range(own)] == wanted
    kept = [[j for j in both[1][a:b].tolist() if place[i] < 0 or listed[place[i], j]]
            for i, (a, b) in enumerate(zip(both[0][:-1].tolist(), both[0][1:].tolist(), strict=True))]  # fmt: skip
    estimates.keep_listed.run(*both, place, listed)
    assert [both[1][both[0][i] : both[0][i + 1]].tolist() for i in range(own)] == kept


def test_a_record_names_a_team_that_there_is() -> None:
    tables = load_records()
    assert {make_record(name, tables).team for name in tables} == {"request"}
    tables["near"] = {"like": "rendezvous", "team": "everybody"}
    with pytest.raises(ConfigError, match="team: Input should be 'request', 'group' or 'swarm'"):
        make_record("near", tables)
    tables["near"] = {"like": "drive", "team": "group"}
    with pytest.raises(ConfigError, match="not for an intent"):
        make_record("near", tables)
