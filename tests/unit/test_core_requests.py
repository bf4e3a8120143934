"""What operators may send: odd requests, bad records, too many robots and none."""

from __future__ import annotations

import math
from typing import Any

import pytest
from structlog.testing import capture_logs

from fullswarm.core.request_status import WHOLE_S
from fullswarm.messages import BehaviourRequest, EStop, ParamReply, ParamRequest, StopRequest
from tests.unit.core_swarm import KEYS, Robot, Swarm


def set_param(swarm: Swarm, key: str, value: Any) -> ParamReply:
    replies: list[ParamReply] = []
    subscription = swarm.bus.subscribe(KEYS.param_reply("core"), ParamReply, replies.append)
    request = ParamRequest(id=f"p{len(swarm.messages)}", op="set", key=key, value=value)
    swarm.bus.publish(KEYS.param_request("core"), request)
    swarm.run(0.01)
    subscription.close()
    return replies[-1]


def test_odd_requests_are_answered_and_harm_nobody() -> None:
    swarm = Swarm()
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    odd: list[tuple[str, dict[str, Any]]] = [
        ("\u2603/**", {}), ("", {}), ("flocking\n", {}), ("x" * 100_000, {}),
        ("move_to_goal", {"goal": [math.nan, 1.0]}), ("move_to_goal", {"goal": [math.inf, 1.0]}),
        ("move_to_goal", {"goal": []}), ("move_to_goal", {"goal": [[1.0, 2.0]]}), ("move_to_goal", {"goal": "x"}),
        ("move_to_goal", {"goal": [1.0, 2.0], "gain": -math.inf}),
        ("move_to_goal", {"goal": [1.0, 2.0], "gain": 10**300}),
        ("move_to_goal", {"goal": [10**400, 2.0]}), ("formation", {"targets": [[1.0, 1.0]] * 5_000}),
        ("formation", {"targets": [1.0, [2.0, 3.0]]}), ("flocking", {"\u2603" * 1000: 1.0}),
        ("drive", {"linear": True}), ("drive", {"linear": 10**18}),
    ]  # fmt: skip
    for number, (behaviour, parameters) in enumerate(odd):
        request = BehaviourRequest(id=f"\u2603 {number}/*", behaviour=behaviour, parameters=parameters)
        swarm.bus.publish(KEYS.behaviour_request, request)
        swarm.run(0.02)
        status = swarm.status(f"\u2603 {number}/*")
        assert (status.phase, status.reason != "") == ("refused", True), (behaviour[:20], parameters)
    assert swarm.behaviours() == ["flocking"] * 3
    swarm.ask("b", "rendezvous", "r1", "r1", "r0", "r1")
    swarm.run(0.2)
    assert swarm.status("b").robots == ("r1", "r0")
    assert swarm.status("b").running == ("r1", "r0")
    swarm.close()


def test_an_empty_swarm_refuses_and_a_stranger_is_served() -> None:
    swarm = Swarm(count=0)
    swarm.ask("a", "flocking")
    swarm.bus.publish(KEYS.stop, StopRequest(id="s"))
    swarm.bus.publish(KEYS.estop, EStop(id="e", engaged=True))
    swarm.run(0.1)
    assert swarm.status("a").phase == "refused"
    assert swarm.status("s").phase == swarm.status("e").phase == "ended"
    stranger = Robot(swarm.bus, swarm.runtime, "x1").start()
    swarm.run(0.1)
    swarm.ask("b", "flocking")
    swarm.run(0.1)
    assert stranger.behaviour == "flocking"
    swarm.close()


def test_a_stop_without_an_id_counts_each_time() -> None:
    swarm = Swarm()
    for number in range(2):
        swarm.ask(f"a{number}", "flocking")
        swarm.run(0.2)
        assert swarm.behaviours() == ["flocking"] * 3
        swarm.bus.publish(KEYS.stop, StopRequest(id=""))
        for robot in swarm.robots.values():
            robot.stops.clear()
        swarm.run(1.0)
        assert swarm.behaviours() == ["", "", ""]
        assert all(swarm.core.handler.order_of(f"r{k}").behaviour == "stop" for k in range(3))  # type: ignore[union-attr]
    swarm.close()


def test_a_thousand_robots_in_one_request() -> None:
    swarm = Swarm(count=1000, late=999)
    swarm.ask("a", "formation", shape="grid", centre=[0.0, 0.0])
    swarm.run(0.1)
    status = swarm.status("a")
    assert (len(status.robots), status.running, len(status.missing)) == (1000, ("r0",), 999)
    swarm.close()


@pytest.mark.parametrize(
    "record",
    [
        {"summary": "x", "like": []},
        {"summary": "x", "like": {"a": 1}},
        {"summary": "x", "law": "flocking", "static": {"way": [{"a": 1}]}},
        {"summary": "x", "law": "flocking", "static": {"way": [[["deep"]]]}},
        {"summary": "x", "law": "flocking", "static": {"n": 2**70}},
        {"summary": "x", "law": "flocking", "parameters": {"p": {"type": "number", "default": 1.0, "min": 5.0}}},
        {"summary": "x", "law": "flocking", "expires_s": -1.0},
        {"like": "tested"},
        7,
        "flocking",
    ],
)
def test_a_bad_record_is_refused_and_the_old_one_goes_on(record: Any) -> None:
    swarm = Swarm(count=1)
    good: dict[str, object] = {"summary": "x", "law": "flocking", "parameters": {"p": {"type": "number", "default": 1}}}
    assert set_param(swarm, "behaviour/tested", good).ok
    swarm.ask("a", "tested")
    swarm.run(0.2)
    reply = set_param(swarm, "behaviour/tested", record)
    assert not reply.ok
    assert reply.reason
    swarm.ask("b", "tested", p=2.0)
    swarm.run(0.2)
    task = swarm.robots["r0"].task
    assert task is not None
    assert task.parameters == {"p": 2.0}
    swarm.close()


def test_a_record_changed_or_taken_away_while_it_runs_leaves_what_runs_alone() -> None:
    swarm = Swarm(count=2)
    record: dict[str, object] = {"summary": "x", "law": "flocking"}
    assert set_param(swarm, "behaviour/mine", record).ok
    swarm.ask("a", "mine")
    swarm.run(0.2)
    assert set_param(swarm, "behaviour/mine", {**record, "expires_s": 0.3}).ok
    assert set_param(swarm, "behaviour/mine", None).ok
    swarm.run(2.0)
    assert swarm.behaviours() == ["mine", "mine"]
    swarm.robots["r1"].kill()
    swarm.robots["r1"].start()
    swarm.run(1.0)
    assert swarm.behaviours() == ["mine", "mine"]
    swarm.ask("b", "mine")
    swarm.ask("c", "stop")
    swarm.run(0.2)
    assert swarm.status("b").phase == "refused"
    assert swarm.behaviours() == ["", ""]
    swarm.close()


def test_a_request_that_has_ended_and_is_sent_again_starts_nothing_and_is_logged_once_a_second() -> None:
    swarm = Swarm()
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.bus.publish(KEYS.stop, StopRequest(id="s"))
    swarm.run(0.5)
    with capture_logs() as logs:
        swarm.ask("a", "flocking")  # a last copy of the operator's own
        swarm.run(3.0)
        assert logs == []
        for _ in range(15):
            swarm.ask("a", "flocking")
            swarm.run(0.1)
    assert [(each["event"], each["id"]) for each in logs] == [
        ("request ignored: it has ended, and is sent again", "a")
    ] * 2
    assert swarm.behaviours() == ["", "", ""]
    swarm.close()


def test_of_a_request_that_ended_long_ago_its_end_is_kept_and_no_list_of_robots() -> None:
    """A core that is asked for something every second for months must not grow by each of it."""
    swarm = Swarm()
    swarm.ask("a", "flocking")
    swarm.run(0.2)
    swarm.ask("b", "rendezvous")
    swarm.run(0.5)
    before = swarm.status("a")
    assert (before.phase, before.robots) == ("ended", ("r0", "r1", "r2"))
    swarm.run(WHOLE_S + 1.0)
    swarm.messages.clear()
    swarm.ask("a", "flocking")  # it is known all the same, and not executed again
    swarm.run(0.5)
    again = swarm.status("a")
    assert (again.phase, again.reason, again.robots) == ("ended", before.reason, ())
    assert swarm.behaviours() == ["rendezvous"] * 3
    assert swarm.status("b").robots == ("r0", "r1", "r2"), "one that runs is whole"
    swarm.close()
