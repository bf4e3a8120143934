"""Operators on a bus that loses: whose request wins, and stops that are given late or never."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from fullswarm.core.request_order import REMEMBERED, RequestOrder
from fullswarm.messages import BehaviourRequest, Message, RequestStatus, StopRequest
from fullswarm.operator.client import Operator
from fullswarm.operator.teleop import Teleop
from fullswarm.store import Store
from tests.unit.core_restart import restart_core
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


def send(swarm: Swarm, request_id: str, behaviour: str, *robots: str, **fields: Any) -> RequestStatus:
    """Have a request arrive at the core now, whenever it was asked; return what became of it."""
    request = BehaviourRequest(id=request_id, behaviour=behaviour, robots=robots, **{"source": "o", **fields})
    swarm.bus.publish(KEYS.behaviour_request, request)
    swarm.run(0.2)
    return swarm.status(request_id)


@pytest.mark.parametrize("later_s", [0.1, 6.0, 3600.0])
def test_an_older_request_of_the_same_operator_does_not_win_however_late_it_comes(later_s: float) -> None:
    swarm = Swarm()
    send(swarm, "new", "rendezvous", "r0", "r1", stamp_s=100.0)
    swarm.run(later_s)
    old = send(swarm, "old", "flocking", "r1", stamp_s=99.9)
    assert (old.phase, old.reason) == ("superseded", "r1: superseded by new, which came first")
    wide = send(swarm, "wide", "flocking", "r1", "r2", stamp_s=99.9)
    assert (wide.phase, wide.running) == ("running", ("r2",))
    assert "r1: superseded by new" in wide.reason
    assert swarm.behaviours() == ["rendezvous", "rendezvous", "flocking"]
    swarm.close()


def test_requests_of_one_operator_on_one_clock_are_ordered_whichever_process_sends_them() -> None:
    """A shell that was killed, and what it had sent comes when its successor has asked for something newer."""
    swarm = Swarm()
    ann = {"operator": "ann", "clock": "boot-1"}
    send(swarm, "new", "rendezvous", "r0", source="cli@lab:2", stamp_s=100.0, **ann)
    assert send(swarm, "old", "flocking", "r0", source="cli@lab:1", stamp_s=99.0, **ann).phase == "superseded"
    assert send(swarm, "newer", "flocking", "r0", source="cli@lab:1", stamp_s=101.0, **ann).phase == "running"
    swarm.close()


def test_an_order_of_another_operator_between_does_not_let_an_older_one_win() -> None:
    swarm = Swarm()
    send(swarm, "new", "rendezvous", "r0", operator="ann", clock="boot-1", stamp_s=100.0)
    send(swarm, "bobs", "voronoi_coverage", "r0", operator="bob", clock="boot-1", stamp_s=100.5)
    assert send(swarm, "old", "flocking", "r0", operator="ann", clock="boot-1", stamp_s=99.0).phase == "superseded"
    assert swarm.robots["r0"].behaviour == "voronoi_coverage"
    swarm.close()


@pytest.mark.parametrize(
    "fields",
    [
        {"operator": "bob", "clock": "boot-1"},  # another person's
        {"operator": "ann", "clock": "boot-2"},  # another computer's, or of this one before it was started again
        {"operator": "ann", "clock": "", "source": "p"},
    ],
)
def test_stamps_that_do_not_compare_count_as_they_arrive(fields: dict[str, str]) -> None:
    swarm = Swarm()
    send(swarm, "first", "rendezvous", "r0", operator="ann", clock="boot-1", stamp_s=100.0)
    assert send(swarm, "second", "flocking", "r0", stamp_s=1.0, **fields).phase == "running"
    swarm.close()


@pytest.mark.parametrize("dated_first", [False, True])
def test_a_stop_supersedes_what_others_on_its_clock_requested_before_it(*, dated_first: bool) -> None:
    swarm = Swarm()
    stops: list[Message] = [
        StopRequest(id="stop", robots=("r0", "r1"), source="cli@lab:9"),
        BehaviourRequest(
            id="stop", behaviour="stop", robots=("r0", "r1"), source="cli@lab:9", clock="boot-1", stamp_s=100.0
        ),
    ]
    for each in reversed(stops) if dated_first else stops:
        swarm.bus.publish(KEYS.stop if isinstance(each, StopRequest) else KEYS.behaviour_request, each)
    swarm.run(0.2)
    older = send(swarm, "older", "flocking", "r1", "r2", operator="bob", clock="boot-1", stamp_s=99.9)
    assert (older.phase, older.running) == ("running", ("r2",))
    assert older.reason.startswith("r1: superseded by stop")
    assert send(swarm, "elsewhere", "flocking", "r0", operator="bob", clock="boot-2", stamp_s=1.0).phase == "running"
    assert send(swarm, "newer", "flocking", "r1", operator="bob", clock="boot-1", stamp_s=100.1).phase == "running"
    swarm.close()


def test_a_stop_leaves_out_unknown_robots_and_is_refused_only_if_all_are() -> None:
    swarm = Swarm()
    send(swarm, "going", "flocking", "r0", "r1")
    assert send(swarm, "stop", "stop", "r0", "r77").phase != "refused"
    assert swarm.behaviours()[:2] == ["", "flocking"]
    assert send(swarm, "typo", "stop", "r77").phase == "refused"
    swarm.close()


def test_an_older_request_does_not_win_after_a_restart_of_the_core_either(tmp_path: Path) -> None:
    swarm = Swarm(store=Store(tmp_path / "core.db"))
    send(swarm, "new", "rendezvous", "r0", operator="ann", clock="boot-1", stamp_s=100.0)
    send(swarm, "bobs", "voronoi_coverage", "r0", operator="bob", clock="boot-9", stamp_s=7.0)
    restart_core(swarm, tmp_path / "core.db")
    swarm.run(10.0)
    assert send(swarm, "old", "flocking", "r0", operator="ann", clock="boot-1", stamp_s=99.0).phase == "superseded"
    assert swarm.robots["r0"].behaviour == "voronoi_coverage"
    assert send(swarm, "newer", "flocking", "r0", operator="ann", clock="boot-1", stamp_s=101.0).phase == "running"
    swarm.close()


def test_invented_operators_do_not_fill_the_memory() -> None:
    newest = RequestOrder()
    for number in range(1000):
        newest.note("r0", f"q{number}", (f"operator-{number}", "boot-1"), 1.0)
    assert newest.note("r0", "old", ("operator-999", "boot-1"), 0.5) == "q999"
    assert newest.note("r0", "forgotten", ("operator-1", "boot-1"), 0.5) == ""
    assert sum(len(each) for each in newest._requests.values()) == REMEMBERED
