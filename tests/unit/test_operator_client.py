from __future__ import annotations

import itertools

import pytest

from fullswarm.bus import LocalBus
from fullswarm.clock import SimClock
from fullswarm.keys import Keys
from fullswarm.messages import (
    BehaviourRequest,
    EStop,
    EStopReceipt,
    Message,
    ParamChanged,
    ParamEntry,
    ParamReply,
    ParamRequest,
    Phase,
    RequestStatus,
    StopRequest,
)
from fullswarm.operator.client import MockPublisher, Operator
from fullswarm.operator.estop import EStopOrder
from fullswarm.operator.params import ParamClient
from fullswarm.operator.teleop import Teleop
from fullswarm.runtime import Runtime


class Swarm:
    """A bus on a simulated clock, and what came over it with its time."""

    def __init__(self) -> None:
        self.runtime = Runtime(SimClock(100.0))
        self.bus = LocalBus(self.runtime.mailbox)
        self.keys = Keys("lab")
        ids = itertools.count(1)
        self.operator = Operator(self.bus, self.keys, self.runtime, "test", new_id=lambda: f"id{next(ids)}")
        self.heard: list[tuple[float, Message]] = []
        for key, kind in (
            (self.keys.behaviour_request, BehaviourRequest),
            (self.keys.stop, StopRequest),
            (self.keys.estop, EStop),
        ):
            self.bus.subscribe(key, kind, lambda message: self.heard.append((self.time_s, message)))

    @property
    def time_s(self) -> float:
        return round(self.runtime.now_s() - 100.0, 6)

    def times(self) -> list[float]:
        return [time_s for time_s, _ in self.heard]

    def answer(self, request_id: str, phase: Phase = "accepted") -> None:
        status = RequestStatus(request_id=request_id, behaviour="flocking", phase=phase)
        self.bus.publish(self.keys.behaviour_status, status)

    def robot(self, name: str, *, standing_after: int = 1, released: bool = True) -> None:
        """Add a robot that confirms each e-stop and stands from the given receipt on."""
        receipts = itertools.count(1)

        def on_estop(order: EStop) -> None:
            if order.robots and name not in order.robots:
                return
            engaged = order.engaged or not released
            standing = engaged and next(receipts) >= standing_after
            receipt = EStopReceipt(id=order.id, robot=name, engaged=engaged, standing=standing)
            self.bus.publish(self.keys.estop_receipt(name), receipt)

        self.bus.subscribe(self.keys.estop, EStop, on_estop)


@pytest.fixture
def swarm() -> Swarm:
    return Swarm()


def test_a_request_is_repeated_with_one_id_until_the_first_status(swarm: Swarm) -> None:
    got: list[RequestStatus] = []
    asked = swarm.operator.request("flocking", ["a", "b"], {"cohesion": 0.5}, got.append)
    swarm.operator.request("stop", ["c"])
    swarm.runtime.after(0.5, lambda: swarm.answer("id2"))  # another's status must not end it
    swarm.runtime.after(0.7, lambda: swarm.answer("id1"))
    swarm.runtime.run(2.0)
    sent = [(time, each) for time, each in swarm.heard if isinstance(each, BehaviourRequest) and each.id == "id1"]
    assert [time for time, _ in sent] == [0.0, 0.2, 0.4, 0.6]
    assert all(each == asked.request for _, each in sent)
    assert asked.request == BehaviourRequest(
        id="id1",
        behaviour="flocking",
        robots=("a", "b"),
        parameters={"cohesion": 0.5},
        source="test",
        operator="test",
        stamp_s=100.0,
    )
    assert [status.request_id for status in got] == ["id1"]
    assert asked.status == got[0]


def test_all_statuses_are_received_until_a_final_one(swarm: Swarm) -> None:
    got: list[str] = []
    swarm.operator.request("flocking", on_status=lambda status: got.append(status.phase))
    phases: list[Phase] = ["accepted", "accepted", "running", "superseded", "running"]
    for number, phase in enumerate(phases):
        swarm.runtime.after(0.1 * (number + 1), lambda phase=phase: swarm.answer("id1", phase))  # type: ignore[misc]
    swarm.runtime.run(2.0)
    assert got == ["accepted", "accepted", "running", "superseded"]
    assert len(swarm.heard) == 1


def test_a_forgotten_request_is_neither_sent_nor_reported(swarm: Swarm) -> None:
    got: list[RequestStatus] = []
    asked = swarm.operator.request("flocking", on_status=got.append)
    swarm.runtime.after(0.3, lambda: swarm.operator.forget(asked))
    swarm.runtime.after(0.5, lambda: swarm.answer("id1"))
    swarm.runtime.run(1.0)
    assert swarm.times() == [0.0, 0.2]
    assert got == []


def test_a_stop_is_sent_five_times_with_one_id(swarm: Swarm) -> None:
    done: list[float] = []
    burst = swarm.operator.stop(["a"], lambda: done.append(swarm.time_s))
    swarm.runtime.run(2.0)
    stop = StopRequest(id="id1", robots=("a",), source="test", stamp_s=100.0)
    dated = BehaviourRequest(id="id1", behaviour="stop", robots=("a",), source="test", operator="test", stamp_s=100.0)
    assert swarm.heard == [(time_s, each) for time_s in (0.0, 0.1, 0.2, 0.3, 0.4) for each in (stop, dated)]
    assert done == [0.4]
    assert burst.done


def estop(swarm: Swarm, engaged: bool = True, robots: tuple[str, ...] = (), known: tuple[str, ...] = ()) -> EStopOrder:
    ended: list[float] = []
    order = swarm.operator.estop(
        engaged, robots, "test", known=lambda: known, deadline_s=2.0, on_done=lambda _: ended.append(swarm.time_s)
    )
    swarm.runtime.run(5.0)
    assert len(ended) == 1
    assert order.done
    assert swarm.times()[-1] <= ended[0]
    return order


def test_an_estop_names_the_robot_that_does_not_answer(swarm: Swarm) -> None:
    swarm.robot("a")
    swarm.robot("b")
    order = estop(swarm, known=("a", "b", "deaf"))
    assert order.unconfirmed() == ("deaf",)
    assert sorted(order.receipts) == ["a", "b"]
    assert swarm.times() == pytest.approx([0.1 * k for k in range(20)])  # every 0.1 s up to the deadline


def test_an_estop_ends_when_all_stand_but_not_before_every_robot_can_be_known(swarm: Swarm) -> None:
    swarm.robot("a")
    swarm.robot("unknown")
    order = estop(swarm, known=("a",))
    assert order.concerned() == ("a", "unknown")
    assert order.unconfirmed() == ()
    assert 0.5 < swarm.times()[-1] < 0.7


def test_an_estop_of_named_robots_ends_with_their_receipts(swarm: Swarm) -> None:
    swarm.robot("a")
    swarm.robot("b")
    order = estop(swarm, robots=("a",), known=("a", "b"))
    assert (order.concerned(), order.unconfirmed(), order.sent) == (("a",), (), 1)


def test_a_robot_that_still_rolls_has_not_confirmed(swarm: Swarm) -> None:
    swarm.robot("a", standing_after=10)
    order = estop(swarm, robots=("a",))
    assert order.unconfirmed() == ()
    assert order.sent == 10
    swarm.robot("b", standing_after=1000)
    assert estop(swarm, robots=("b",)).unconfirmed() == ("b",)


def test_a_release_is_confirmed_by_robots_that_are_released(swarm: Swarm) -> None:
    swarm.robot("a")
    assert estop(swarm, engaged=False, robots=("a",)).unconfirmed() == ()
    swarm.robot("stuck", released=False)
    assert estop(swarm, engaged=False, robots=("a", "stuck")).unconfirmed() == ("stuck",)


def test_an_estop_that_no_robot_receives_concerns_none(swarm: Swarm) -> None:
    order = estop(swarm)
    assert (order.concerned(), order.sent) == ((), 20)


def test_a_closed_operator_is_silent(swarm: Swarm) -> None:
    got: list[RequestStatus] = []
    swarm.operator.estop(True)
    swarm.operator.request("flocking", on_status=got.append)
    swarm.operator.close()
    swarm.runtime.after(0.5, lambda: swarm.answer("id1"))
    swarm.runtime.run(1.0)
    assert swarm.times() == [0.0, 0.0]
    assert got == []


def test_the_mock_publisher_sends_separate_requests_at_its_rate(swarm: Swarm) -> None:
    answered: list[float] = []
    swarm.bus.subscribe(
        swarm.keys.behaviour_request,
        BehaviourRequest,
        lambda request: swarm.answer(request.id, "refused" if request.id == "id2" else "running"),
    )
    publisher = MockPublisher(
        swarm.operator,
        swarm.runtime,
        "flocking",
        rate_hz=4.0,
        count=3,
        on_answered=lambda: answered.append(swarm.time_s),
    )
    publisher.start()
    swarm.runtime.run(3.0)
    assert [(time, each.id) for time, each in swarm.heard if isinstance(each, BehaviourRequest)] == [
        (0.0, "id1"),
        (0.25, "id2"),
        (0.5, "id3"),
    ]
    assert (publisher.sent, publisher.answered, [each.request_id for each in publisher.refused]) == (3, 3, ["id2"])
    assert answered == [0.5]


def test_an_endless_mock_publisher_ends_when_stopped(swarm: Swarm) -> None:
    publisher = MockPublisher(swarm.operator, swarm.runtime, "flocking", rate_hz=1.0, count=0)
    publisher.start()
    swarm.runtime.after(2.5, publisher.stop)
    swarm.runtime.run(10.0)
    assert publisher.sent == 3
    assert swarm.times()[-1] < 2.5  # unanswered ones are not repeated any more either


def test_teleop_streams_at_20_hz_and_ends_with_zeros(swarm: Swarm) -> None:
    teleop = Teleop(swarm.operator, swarm.runtime, ["a"])
    done: list[float] = []
    teleop.hold("drive", {"linear": 0.5, "angular": -0.25})
    swarm.runtime.after(0.52, lambda: teleop.release(lambda: done.append(swarm.time_s)))
    swarm.runtime.run(3.0)
    frames = [(time, each) for time, each in swarm.heard if isinstance(each, BehaviourRequest)]
    assert [time for time, _ in frames] == pytest.approx([0.05 * k for k in range(11)] + [0.52, 0.57, 0.62])
    assert {each.behaviour for _, each in frames} == {"drive"}
    assert len({each.id for _, each in frames}) == len(frames)
    assert [each.parameters for _, each in frames[:11]] == [{"linear": 0.5, "angular": -0.25}] * 11
    assert [each.parameters for _, each in frames[11:]] == [{"linear": 0.0, "angular": 0.0}] * 3
    assert done == [0.62]


def test_teleop_gets_a_refusal_and_keeps_only_recent_frames(swarm: Swarm) -> None:
    got: list[str] = []
    teleop = Teleop(swarm.operator, swarm.runtime, on_status=lambda status: got.append(status.request_id))
    teleop.hold("drive", {"linear": 1.0, "angular": 0.0})
    for request_id in ("id1", "id40"):
        swarm.runtime.after(2.01, lambda name=request_id: swarm.answer(name, "refused"))  # type: ignore[misc]
    swarm.runtime.run(2.02)
    assert got == ["id40"]


def test_a_question_is_repeated_until_answered_once(swarm: Swarm) -> None:
    asked: list[float] = []
    replies: list[ParamReply] = []

    def on_question(question: ParamRequest) -> None:
        asked.append(swarm.time_s)
        assert (question.op, question.key, question.author) == ("get", "agent/*", "me")
        if len(asked) >= 3:  # twice, as when a repeated question crosses its answer
            for _ in range(2):
                swarm.bus.publish(swarm.keys.param_reply("core", question.id), ParamReply(id=question.id, ok=True))

    swarm.bus.subscribe(swarm.keys.param_request("core"), ParamRequest, on_question)
    client = ParamClient(swarm.bus, swarm.keys, swarm.runtime, "me")
    client.ask("get", "agent/*", replies.append)
    swarm.runtime.run(2.0)
    assert asked[:1] == [0.0]
    assert 0.2 <= asked[1] <= 0.25
    assert 0.4 <= asked[2] - asked[1] <= 0.5
    assert [reply.ok for reply in replies] == [True]


@pytest.mark.parametrize(("pattern", "wanted"), [("a/x", ["a/x"]), ("a/*", ["a/x", "a/y"]), ("*", ["a/x", "a/y", "b"])])
def test_watching_is_by_key_or_beginning(swarm: Swarm, pattern: str, wanted: list[str]) -> None:
    changes: list[str] = []
    client = ParamClient(swarm.bus, swarm.keys, swarm.runtime, "me")
    watching = client.watch(pattern, lambda entry: changes.append(entry.key))
    for key in ("a/x", "a/y", "b"):
        entry = ParamEntry(key=key, value=1, author="x", changed=0.0)
        swarm.bus.publish(swarm.keys.param_changed("core"), ParamChanged(layer="core", entry=entry))
    swarm.runtime.run(0.1)
    watching.close()
    assert changes == wanted
