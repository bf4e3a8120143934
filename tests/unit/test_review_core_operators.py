"""Operators on a bus that loses: whose request wins, and stops that are given late or never."""

from __future__ import annotations

import pytest

from fullswarm.messages import BehaviourRequest, Message, RequestStatus, StopRequest
from fullswarm.operator.client import Operator
from fullswarm.operator.teleop import Teleop
from tests.unit.core_swarm import KEYS, Swarm


class Line:
    """An operator on a swarm's bus."""

    def __init__(self, swarm: Swarm, name: str = "o") -> None:
        self.swarm = swarm
        self.told: dict[str, list[RequestStatus]] = {}
        self.operator = Operator(swarm.bus, KEYS, swarm.runtime, name)

    def ask(self, behaviour: str, *robots: str) -> str:
        statuses: list[RequestStatus] = []
        asked = self.operator.request(behaviour, robots, {}, statuses.append)
        self.told[asked.request.id] = statuses
        return asked.request.id


def lose_first(swarm: Swarm, behaviour: str) -> None:
    lost: list[Message] = []

    def drop(_key: str, message: Message) -> bool:
        lose = isinstance(message, BehaviourRequest) and message.behaviour == behaviour and not lost
        lost.extend([message] if lose else [])
        return lose

    swarm.bus.drop = drop


def test_a_lost_request_is_not_repeated_after_a_newer_one_was_answered() -> None:
    swarm = Swarm()
    line = Line(swarm)
    lose_first(swarm, "flocking")
    old = line.ask("flocking")
    swarm.run(0.1)
    line.ask("rendezvous")
    swarm.run(1.0)
    assert swarm.behaviours() == ["rendezvous"] * 3, "the newest wins"
    assert [each.phase for each in line.told[old]] == ["superseded"], "and the lost one is not lost silently"
    swarm.close()


def test_a_lost_request_for_other_robots_is_still_repeated() -> None:
    swarm = Swarm()
    line = Line(swarm)
    lose_first(swarm, "flocking")
    line.ask("flocking", "r0")
    line.ask("rendezvous", "r1")
    swarm.run(1.0)
    assert swarm.behaviours() == ["flocking", "rendezvous", ""]
    swarm.close()


@pytest.mark.parametrize("how", ["stop", "estop"])
def test_a_lost_request_is_not_repeated_after_a_stop(how: str) -> None:
    swarm = Swarm()
    line = Line(swarm)
    lose_first(swarm, "flocking")
    old = line.ask("flocking")
    swarm.run(0.1)
    if how == "stop":
        line.operator.stop(("r0",))
    else:
        line.operator.estop(True, deadline_s=1.0)
    swarm.run(2.0)
    assert swarm.behaviours() == ["", "", ""]
    assert line.told[old][-1].phase == "superseded"
    swarm.close()


def test_a_stop_given_while_the_hub_is_away_is_given_when_it_is_back() -> None:
    swarm = Swarm()
    line = Line(swarm)
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.bus.drop = lambda _key, message: isinstance(message, StopRequest)
    swarm.bus.connected = lambda: False  # type: ignore[method-assign]  # the hub is away
    done: list[bool] = []
    burst = line.operator.stop(on_done=lambda: done.append(burst.done))
    swarm.run(1.5)
    assert not done
    swarm.bus.connected = lambda: True  # type: ignore[method-assign]
    swarm.run(0.6)  # the robots come back a little later than this operator
    swarm.bus.drop = lambda _key, _message: False
    swarm.run(3.0)
    assert swarm.behaviours() == ["", "", ""]
    assert done == [True]
    swarm.close()


def test_a_stop_that_cannot_be_given_says_so() -> None:
    swarm = Swarm()
    line = Line(swarm)
    swarm.bus.connected = lambda: False  # type: ignore[method-assign]  # and it stays away
    done: list[bool] = []
    burst = line.operator.stop(on_done=lambda: done.append(burst.done))
    swarm.run(30.0)
    assert done == [False]
    swarm.close()


def test_an_operator_who_dies_while_driving_and_one_who_asks_meanwhile() -> None:
    swarm = Swarm()
    line = Line(swarm)
    teleop = Teleop(line.operator, swarm.runtime)
    teleop.hold("drive", {"linear": 1.0, "angular": 0.0})
    swarm.run(0.5)
    swarm.bus.drop = lambda _key, message: isinstance(message, BehaviourRequest) and message.source == "o"  # SIGKILL
    other = Line(swarm, "p")
    asked = other.ask("flocking")
    swarm.run(2.0)
    assert swarm.behaviours() == ["flocking"] * 3
    assert other.told[asked][-1].phase == "running"
    swarm.close()


def test_an_older_request_of_the_same_operator_that_comes_later_does_not_win() -> None:
    swarm = Swarm()
    swarm.run(10.0)
    new = BehaviourRequest(id="new", behaviour="rendezvous", robots=("r0", "r1"), source="o", stamp_s=100.0)
    swarm.bus.publish(KEYS.behaviour_request, new)
    swarm.run(0.1)
    for name, robots in (("old", ("r1",)), ("wide", ("r1", "r2"))):
        old = BehaviourRequest(id=name, behaviour="flocking", robots=robots, source="o", stamp_s=99.9)
        swarm.bus.publish(KEYS.behaviour_request, old)
        swarm.run(0.2)
    assert swarm.behaviours() == ["rendezvous", "rendezvous", "flocking"]
    assert (swarm.status("old").phase, swarm.status("old").reason) == (
        "superseded", "r1: superseded by new, which came first"
    )  # fmt: skip
    assert (swarm.status("wide").phase, swarm.status("wide").running) == ("running", ("r2",))
    assert "r1: superseded by new" in swarm.status("wide").reason
    other = BehaviourRequest(id="other", behaviour="flocking", robots=("r1",), source="p", stamp_s=1.0)
    swarm.bus.publish(KEYS.behaviour_request, other)
    swarm.run(0.2)
    assert swarm.behaviours() == ["rendezvous", "flocking", "flocking"], "another operator's clock tells nothing"
    swarm.run(5.0)
    for number in range(2):  # the operator's machine was started again: its clock begins anew
        again = BehaviourRequest(id=f"n{number}", behaviour="rendezvous", source="o", stamp_s=2.0 + number)
        swarm.bus.publish(KEYS.behaviour_request, again)
        swarm.run(0.2)
        assert swarm.status(f"n{number}").phase == "running"
    swarm.close()
