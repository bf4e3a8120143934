"""The whole chain, operator to wheels, over a bus that loses, doubles and delays, with processes that die."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from fullswarm.messages import ControlAck, ControlRequest, HealthReport, RequestStatus, StopRequest, Value
from fullswarm.operator.teleop import Teleop
from tests.unit.whole_swarm import TICK_S, Whole

GOAL: dict[str, Value] = {"goal": [80.0, 80.0]}
LINE: dict[str, Value] = {"shape": "line", "centre": [60.0, 60.0], "spacing_m": 2.0}
SILENCE_S = 1.0
TTL_S = 0.3


@pytest.fixture
def whole(tmp_path: Path) -> Iterator[Whole]:
    made = Whole(path=tmp_path / "core.db")
    yield made
    made.close()


def going(whole: Whole, behaviour: str = "move_to_goal", parameters: dict[str, Value] = GOAL) -> str:
    """Have all robots run a behaviour and return the request's id."""
    asked = whole.operator.request(behaviour, (), parameters)
    whole.run(1.0)
    assert sorted(whole.driven()) == sorted(whole.agents)
    return asked.request.id


def zero_after_s(whole: Whole, limit_s: float) -> float:
    began_s = whole.runtime.now_s()
    while whole.driven():
        assert whole.runtime.now_s() - began_s <= limit_s + TICK_S, f"{whole.driven()} drive on"
        whole.run(TICK_S)
    return whole.runtime.now_s() - began_s


# ------------------------------------------------------------------ deaths
def test_the_core_dies_and_its_successor_takes_over(whole: Whole) -> None:
    asked = going(whole)
    whole.kill_core()
    assert zero_after_s(whole, SILENCE_S + TICK_S) > 0.5
    whole.run(2.0)
    whole.start_core()
    whole.run(1.0)
    assert sorted(whole.driven()) == sorted(whole.agents)
    assert whole.statuses[asked].running == ("r0", "r1", "r2")


@pytest.mark.parametrize("behaviour", ["formation_assigned", "teleop_centroid"])
@pytest.mark.parametrize("victim", ["core", "centralised", "both"])
def test_a_centralised_behaviour_stops_within_its_ttl_and_comes_back(whole: Whole, behaviour: str, victim: str) -> None:
    lasting = behaviour == "formation_assigned"
    if lasting:
        going(whole, behaviour, LINE)
    else:
        for _ in range(20):
            whole.operator.request(behaviour, (), {"vx": 1.0}, resend=False)
            whole.run(0.05)
        assert len(whole.driven()) == 3
    if victim != "centralised":
        whole.kill_core()
    if victim != "core":
        whole.centralised.close()
    zero_after_s(whole, TTL_S + TICK_S)
    whole.run(3.0)
    if victim != "centralised":
        whole.start_core()
    if victim != "core":
        whole.start_centralised()
    assert bool(whole.drives_within(5.0)) == lasting
    assert len(whole.driven()) == (3 if lasting else 0)


def test_the_hub_dies_and_comes_back(whole: Whole) -> None:
    going(whole)
    whole.bus.hub = False
    zero_after_s(whole, 2 * TICK_S)
    asked = whole.operator.request("flocking")
    whole.run(2.0)
    whole.bus.hub = True
    whole.run(1.0)
    assert [whole.running(robot) for robot in whole.agents] == [asked.request.id] * 3
    obeyed = {(each.robot, each.sequence) for each in whole.bus.answers if each.request_id == asked.request.id}
    assert len(obeyed) == 6, "one disable and one enable each"


def test_an_agent_that_dies_between_its_answer_and_its_report(whole: Whole) -> None:
    asked = going(whole)
    whole.kill_agent("r1")
    whole.start_agent("r1")
    whole.run(1.0)
    assert whole.running("r1") == asked
    assert "r1" in whole.driven()


# ------------------------------------------------------------------ stops
@pytest.mark.parametrize("how", ["stop", "estop"])
@pytest.mark.parametrize("agents_too", [False, True])
@pytest.mark.parametrize("remembers", [False, True])
def test_a_stop_holds_when_the_core_that_missed_it_comes_back(
    tmp_path: Path, how: str, agents_too: bool, remembers: bool
) -> None:
    whole = Whole(path=tmp_path / "core.db" if remembers else None)
    going(whole)
    whole.kill_core()
    whole.run(0.3)
    if agents_too:
        for robot in list(whole.agents):
            whole.kill_agent(robot)
            whole.start_agent(robot)
        whole.run(0.1)
    if how == "stop":
        whole.operator.stop()
    else:
        whole.operator.estop(True)
    zero_after_s(whole, 2 * TICK_S)
    whole.run(2.0)
    if how == "estop":
        whole.operator.estop(False)
        whole.run(1.0)
    whole.start_core()
    assert whole.drives_within(4.0) == []
    going(whole)
    whole.close()


def test_a_stop_that_the_core_did_not_hear_is_not_undone(whole: Whole) -> None:
    asked = going(whole)
    for agent in whole.agents.values():  # to the robots alone
        agent.inbox._on_stop(StopRequest(id="s", source="button"))
    assert whole.drives_within(3.0) == []
    assert whole.statuses[asked].phase == "ended"
    assert "stopped by button" in whole.statuses[asked].reason
    going(whole)


def test_a_late_enable_of_the_core_does_not_outlive_a_stop(whole: Whole) -> None:
    whole.bus.shaking, whole.bus.delay_s, whole.bus.shaken = 0.5, 0.3, (ControlRequest, ControlAck, HealthReport)
    whole.operator.request("move_to_goal", (), GOAL)
    whole.run(0.02)
    whole.operator.stop()
    whole.bus.shaking = 0.0
    whole.run(1.0)
    assert whole.drives_within(3.0) == []


def test_an_e_stopped_robot_stays_so_through_its_own_restart(whole: Whole) -> None:
    going(whole)
    whole.operator.estop(True, ("r1",))
    whole.run(0.5)
    whole.kill_agent("r1")
    whole.start_agent("r1")
    whole.run(0.2)
    asked = whole.operator.request("flocking")
    whole.run(1.0)
    assert "r1" not in whole.driven()
    assert whole.statuses[asked.request.id].refused_by == ("r1",)
    assert "estop --clear" in whole.statuses[asked.request.id].reason
    whole.operator.estop(False, ("r1",))
    assert "r1" not in whole.drives_within(2.0)
    going(whole)


def test_a_released_e_stop_is_not_engaged_again_by_a_core_that_missed_the_release(whole: Whole) -> None:
    whole.operator.estop(True)
    whole.run(1.0)
    whole.kill_core()
    whole.operator.estop(False)
    whole.run(1.0)
    whole.start_core()
    whole.run(1.0)
    assert not any(agent.controller.estop[0] for agent in whole.agents.values())
    going(whole)


# ------------------------------------------------------------------ teleoperation
@pytest.mark.parametrize("seed", range(6))
def test_a_stick_whose_operator_died_moves_nobody_whatever_the_bus_does(seed: int) -> None:
    whole = Whole(seed, count=2)
    whole.bus.shaking = 0.3
    teleop = Teleop(whole.operator, whole.runtime)
    teleop.hold("drive", {"linear": 1.0, "angular": 0.0})
    whole.run(2.0)
    assert whole.driven()
    assert teleop._timer is not None
    teleop._timer.cancel()
    # The last frame may be on its way twice: to the core, and from there to the robot.
    whole.run(TTL_S + 2 * whole.bus.delay_s + 2 * TICK_S)
    assert whole.drives_within(2.0) == []
    whole.kill_core()
    whole.start_core()
    assert whole.drives_within(2.0) == []
    whole.close()


# ------------------------------------------------------------------ everything at once
class Chaos:
    """Random acts of operators and of fate, by seed."""

    def __init__(self, whole: Whole, seed: int) -> None:
        self.whole, self.chance = whole, random.Random(seed)
        self.told: dict[str, list[RequestStatus]] = {}
        self.newest: dict[str, str] = {}
        acts: list[tuple[int, Callable[[], None]]] = [
            (10, self.ask), (2, self.stop), (1, self.estop), (2, self.restart_agent), (1, self.restart_core),
            (1, self.restart_centralised), (1, self.lose_hub),
        ]  # fmt: skip
        self.acts = [act for weight, act in acts for _ in range(weight)]

    def ask(self) -> None:
        names = sorted(self.whole.worlds)
        robots = self.chance.sample(names, self.chance.randint(1, len(names)))
        # Each has a world of its own: without the filter they would meet in one place, which bars motion.
        behaviour, parameters = self.chance.choice(
            [("flocking_bc", {}), ("rendezvous_bc", {}), ("move_to_goal_bc", GOAL), ("formation_assigned", LINE)]
        )
        told: list[RequestStatus] = []
        asked = self.whole.operator.request(behaviour, robots, parameters, told.append)
        self.told[asked.request.id] = told
        self.newest.update(dict.fromkeys(robots, asked.request.id))

    def stop(self) -> None:
        self.whole.operator.stop()
        self.newest.clear()

    def estop(self) -> None:
        self.whole.operator.estop(True, deadline_s=1.5)
        self.whole.run(2.0)
        assert self.whole.driven() == []
        self.whole.operator.estop(False, deadline_s=1.5)
        self.whole.run(2.0)
        self.newest.clear()

    def restart_agent(self) -> None:
        robot = self.chance.choice(sorted(self.whole.agents))
        self.whole.kill_agent(robot)
        self.whole.run(self.chance.choice([0.0, 0.3, 2.0]))
        self.whole.start_agent(robot)

    def restart_core(self) -> None:
        self.whole.kill_core()
        self.whole.run(self.chance.choice([0.0, 0.3, 1.5]))
        self.whole.start_core()

    def restart_centralised(self) -> None:
        self.whole.centralised.close()
        self.whole.run(self.chance.choice([0.0, 0.5]))
        self.whole.start_centralised()

    def lose_hub(self) -> None:
        self.whole.bus.hub = False
        self.whole.run(self.chance.uniform(0.05, 1.5))
        self.whole.bus.hub = True

    def go_on(self, acts: int) -> None:
        for _ in range(acts):
            self.chance.choice(self.acts)()
            self.whole.run(self.chance.choice([0.02, 0.1, 0.4, 1.0]))


def orders_kept(answers: list[ControlAck]) -> None:
    """Check what a robot obeyed, in its own order: no switch without a disable, no return to what was superseded."""
    seen: set[tuple[str, int]] = set()
    over: set[str] = set()
    running: ControlAck | None = None
    for ack in answers:
        if not ack.accepted or (ack.core and (ack.core, ack.sequence) in seen):
            continue
        seen.add((ack.core, ack.sequence))
        if ack.enabled:
            assert ack.request_id not in over, "a superseded request came back"
            if running is not None and running.request_id != ack.request_id:
                assert running.behaviour == ack.behaviour, "switched without a disable"
                over.add(running.request_id)
            running = ack
        elif ack.core:
            over |= {running.request_id} if running is not None and running.request_id != ack.request_id else set()
            running = None
        else:
            running = None


@pytest.mark.parametrize("seed", range(9))
def test_after_any_chaos_everybody_runs_the_newest_and_a_stop_stops_all(tmp_path: Path, seed: int) -> None:
    whole = Whole(seed, path=tmp_path / "core.db")
    chaos = Chaos(whole, seed)
    whole.bus.shaking = (0.0, 0.1, 0.3)[seed % 3]
    chaos.go_on(25)
    whole.bus.shaking = 0.0
    whole.run(4.0)
    for robot in whole.agents:
        refused = whole.core.handler._robots[robot].refused
        assert whole.running(robot) == ("" if refused else whole.order_of(robot)), robot
        if whole.running(robot):
            assert whole.running(robot) == chaos.newest.get(robot), robot
            assert robot in whole.status(whole.running(robot)).running
        orders_kept([each for each in whole.bus.answers if each.robot == robot])
    for request_id, told in chaos.told.items():
        assert told, f"{request_id} was lost silently"
    whole.operator.stop()
    whole.run(0.6)
    whole.kill_core()
    whole.start_core()
    assert whole.drives_within(3.0) == []
    chaos.ask()
    whole.run(2.0)
    for robot, request_id in chaos.newest.items():
        if request_id in chaos.told and request_id == list(chaos.told)[-1]:
            assert whole.running(robot) == request_id
    whole.close()
