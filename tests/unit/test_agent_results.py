"""Behaviours that end themselves: the robot stands, and everybody learns the result, whatever is lost or restarted."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fullswarm.cli.request import status_lines
from fullswarm.config import SwarmConfig
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.launch.network import with_network
from fullswarm.messages import HealthReport, RequestStatus, Result, RobotHealth
from fullswarm.operator.client import Operator
from fullswarm.operator.outcome import all_arrived, ended, settled
from fullswarm.operator.params import ParamClient
from fullswarm.operator.robot_state import advise, row_state
from fullswarm.operator.view import RobotRow
from fullswarm.reasons import Code
from fullswarm.store import Store
from tests.unit.agent_bench import TICK_S, Bench
from tests.unit.core_swarm import Swarm as CoreSwarm
from tests.unit.laws import install
from tests.unit.mission_lab import MissionLab


def hop(view: Any, params: Any) -> Array:
    """Drive east until the goal's x is reached, which fails beyond x = 8."""
    gap_m = params.goal[:, 0] - view.position[:, 0]
    there = gap_m <= 0.0
    view.finish(there & (params.goal[:, 0] < 8.0), "arrived")
    view.finish(there & (params.goal[:, 0] >= 8.0), "failed", "nothing to be found here")
    return np.stack([np.full(len(gap_m), 0.4), 0.0 * gap_m], axis=1)


STEPS = """
[[steps]]
robots = ["r0", "r1"]
behaviour = "flocking"
done = { arrived = "all" }
[[steps]]
robots = ["r0"]
behaviour = "rendezvous"
done = { arrived = "all" }
on_failed = "abort"
"""
RECORD: dict[str, object] = {"summary": "", "law": "hop", "parameters": {"goal": {"type": "point", "required": True}}}


class Swarm:
    """Three robots abreast and an operator, in lockstep."""

    def __init__(self, network: str | None = None) -> None:
        robots = [{"id": f"r{k}", "pose": (1.0, 2.0 * k, 0.0)} for k in (1, 2, 3)]
        world = {"engine": "kinematic", "bounds_m": (0.0, 0.0, 12.0, 9.0)}
        config = SwarmConfig.model_validate({"world": world, "robot": robots})
        self.lockstep = Lockstep(with_network(config, network) if network else config)
        bus, runtime = self.lockstep.bus, self.lockstep.runtime
        self.operator, self.statuses = Operator(bus, Keys(), runtime, "op"), list[RequestStatus]()
        self.health: dict[str, RobotHealth] = {}
        bus.subscribe(Keys().health(), HealthReport, self._report)
        client = ParamClient(bus, Keys(), runtime, "op")
        client.ask("set", "behaviour/hop", lambda _: None, RECORD)
        self.lockstep.run(1.0)

    def _report(self, report: HealthReport) -> None:
        self.health |= {each.robot: each for each in report.robots}

    def ask(self, goal: tuple[float, float], robots: tuple[str, ...], run_s: float) -> RequestStatus:
        self.operator.request("hop", robots, {"goal": list(goal)}, self.statuses.append)
        self.lockstep.run(run_s)
        return self.statuses[-1]


@pytest.fixture(params=[None, "loss=30%,delay=50ms±30"], ids=["one agent", "bad network"])
def swarm(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[Swarm]:
    install(monkeypatch, hop=hop)
    made = Swarm(request.param)
    yield made
    made.operator.close()
    made.lockstep.close()


def test_a_request_ends_with_the_results_of_its_robots(swarm: Swarm) -> None:
    status = swarm.ask((2.0, 0.0), (), 2.0)
    assert (status.phase, status.results) == ("running", ())
    swarm.lockstep.run(4.0)
    status = swarm.statuses[-1]
    assert (status.phase, status.code) == ("ended", Code.ARRIVED)
    assert {(each.robot, each.outcome) for each in status.results} == {(f"r{k}", "arrived") for k in (1, 2, 3)}
    assert all_arrived(status)
    assert status_lines(status)[-1].endswith(": arrived")
    swarm.lockstep.run(1.0)
    assert (np.abs(swarm.lockstep.world.pose[:, 0] - 2.0) < 0.1).all()
    assert {each.behaviour for each in swarm.health.values()} == {""}
    row = RobotRow("r1", 0.1, 0.0, 0.0, 0.0, 0.0, swarm.health["r1"])
    assert (row_state(row).word, row_state(row).attention, advise(row)) == ("arrived", False, "")


def test_a_failure_is_reported_with_its_text_while_others_go_on(swarm: Swarm) -> None:
    swarm.lockstep.run(0.5)
    swarm.operator.request("hop", ("r2",), {"goal": [2.0, 0.0]})
    failing = swarm.ask((9.0, 0.0), ("r1", "r3"), 22.0)
    assert (failing.phase, failing.code) == ("ended", Code.FAILED)
    assert {each.text for each in failing.results} == {"nothing to be found here"}
    assert not all_arrived(failing)
    assert ended(failing)
    assert settled(failing)
    row = RobotRow("r1", 0.1, 0.0, 0.0, 0.0, 0.0, swarm.health["r1"])
    assert row_state(row).attention
    assert "nothing to be found" in row_state(row).why
    assert swarm.health["r2"].stop_code == Code.ARRIVED
    # The next request starts afresh: the old result is not taken for its own.
    status = swarm.ask((11.0, 0.0), ("r1",), 2.0)
    assert (status.phase, status.running, status.results) == ("running", ("r1",), ())


def test_robots_of_one_request_may_end_at_different_times(swarm: Swarm) -> None:
    swarm.ask((4.0, 0.0), ("r1", "r2"), 9.0)
    status = swarm.ask((5.0, 0.0), (), 8.0)  # r1 and r2 need 2.5 s, r3 10 s; results are repeated at 1 Hz
    assert status.phase == "running"
    assert {each.robot for each in status.results} == {"r1", "r2"}
    assert status.running == ("r3",)
    swarm.lockstep.run(8.0)
    assert all_arrived(swarm.statuses[-1])


def test_a_core_that_was_away_learns_the_result_and_starts_nothing_again(tmp_path: Path) -> None:
    swarm = CoreSwarm(store=Store(tmp_path / "core.db"))
    try:
        swarm.ask("a", "flocking")
        swarm.run(0.2)
        swarm.robots["r0"].finish()
        swarm.run(0.1)
        assert [each.robot for each in swarm.status("a").results] == ["r0"]
        swarm.core.close()
        swarm.store.close()
        swarm.robots["r1"].finish(arrived=False)
        swarm.robots["r2"].finish()
        swarm.run(0.4)
        swarm.start_core(Store(tmp_path / "core.db"))
        swarm.run(3.0)
        status = swarm.status("a")
        assert status.phase == "ended"
        assert {each.robot: each.outcome for each in status.results} == {"r1": "failed", "r2": "arrived"}
        assert [robot.log.count(("on", "flocking", "a")) for robot in swarm.robots.values()] == [1, 1, 1]
        assert not swarm.store.list("wanted/")
    finally:
        swarm.close()


def test_a_result_of_another_request_ends_nothing() -> None:
    swarm = CoreSwarm()
    try:
        swarm.ask("a", "flocking")
        swarm.run(0.2)
        for robot in swarm.robots.values():
            robot.result = Result(request_id="before", robot=robot.robot, outcome="arrived")
            robot.report()
        swarm.run(1.0)
        assert swarm.status("a").phase == "running"
    finally:
        swarm.close()


def test_a_mission_goes_on_when_its_behaviour_has_ended_itself(tmp_path: Path) -> None:
    lab = MissionLab(tmp_path / "core.db")
    try:
        assert lab.ask("start", STEPS).ok
        lab.run(0.5)
        assert lab.swarm.behaviours() == ["flocking", "flocking", ""]
        lab.swarm.robots["r0"].finish()
        lab.run(0.5)
        lab.kill_core()
        lab.run(0.5)
        lab.swarm.robots["r1"].finish()
        lab.run(0.5)
        assert lab.swarm.behaviours() == ["rendezvous", "", ""]
        lab.swarm.robots["r0"].finish(arrived=False)
        lab.run(0.5)
        assert lab.status is not None
        assert lab.status.phase == "failed"
        assert "rendezvous has failed" in lab.status.reason
        started = [each for robot in lab.swarm.robots.values() for each in robot.log if each[:2] == ("on", "flocking")]
        assert len(started) == 2  # none a second time
    finally:
        lab.close()


def test_the_robot_stands_in_the_tick_in_which_its_law_ends_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    install(monkeypatch, hop=hop)
    bench = Bench([(1.0, 2.0, 0.0), (1.0, 4.0, 0.0)])
    bench.enable("hop", {"goal": [1.3, 0.0]}, robot="r1")
    bench.enable("hop", {"goal": [5.0, 0.0]}, robot="r2")
    while bench.agent.tasks.active[0]:
        bench.run(TICK_S)
        assert bench.runtime.now_s() < 3.0
    assert bench.simulated.pose[0, 0] < 1.3 + 0.4 * 2 * TICK_S
    assert (bench.commanded[0] == 0.0).all()
    assert bench.commanded[1, 0] > 0.0
    bench.enable("hop", {"goal": [1.3, 0.0]}, robot="r1")  # the same request, sent again by a core that does not know
    assert not bench.acks[-1].accepted
    bench.enable("hop", {"goal": [3.0, 0.0]}, robot="r1", request_id="q2")
    assert bench.acks[-1].accepted


def test_an_outcome_that_there_is_not_stops_the_robot_with_that_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def lost(view: Any, params: Any) -> Array:
        view.finish([0], "lost")
        return np.zeros((len(view.position), 2))

    install(monkeypatch, lost=lost)
    bench = Bench([(1.0, 2.0, 0.0)])
    bench.enable("lost")
    bench.run(0.1)
    assert "'arrived' or 'failed'" in bench.agent.desired.law_error[0].text
    assert bench.agent.tasks.active[0]
