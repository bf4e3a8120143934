"""What the request handler concludes from acknowledgements and reports that arrive late or in another order."""

from __future__ import annotations

import itertools

import pytest

from fullswarm.core.desired import UNSEEN_S, Desired, Order
from fullswarm.messages import ControlAck, ControlRequest, RobotHealth
from fullswarm.reasons import Code


def health(behaviour: str = "", request_id: str = "", sequence: int = 0) -> RobotHealth:
    return RobotHealth(
        robot="r1", driver="sim://r1", make="sim", model="", firmware="", lifecycle="READY", behaviour=behaviour,
        request_id=request_id, core="core-1" if sequence else "", sequence=sequence, moving=False, estop=False,
        stop_reason="", fault="", battery=-1.0, contacts=0, collisions=0,
    )  # fmt: skip


def acknowledge(state: Desired, request: ControlRequest, now_s: float) -> None:
    ack = ControlAck(
        request_id=request.request_id, robot="r1", behaviour=request.behaviour, enabled=request.enable, accepted=True,
        core="core-1", sequence=request.sequence,
    )  # fmt: skip
    state.acknowledge(ack, now_s)


def test_reports_from_before_an_enable_do_not_end_the_disable_that_follows_it() -> None:
    """The order changes while an enable is unacknowledged; the robot's reports of before arrive meanwhile.

    Taken for the newest they would enable the new behaviour, disable the old one again and enable the new one twice.
    """
    numbers = itertools.count(1)
    state = Desired("r1", "core-1", present=True)
    sequence = lambda: next(numbers)  # noqa: E731
    state.set_order(Order(request_id="old", behaviour="flocking", law="flocking"), 10.0)
    enable = state.next(sequence)
    assert enable is not None
    state.sent(10.0)
    state.set_order(Order(request_id="new", behaviour="rendezvous", law="rendezvous"), 10.05)
    disable = state.next(sequence)
    assert disable is not None
    assert (disable.enable, disable.behaviour) == (False, "flocking")
    for report in (health(), health("flocking", "old", enable.sequence), health()):
        assert not state.compare(report, False, 10.06)
        assert state.next(sequence) is None
    acknowledge(state, enable, 10.07)
    assert state.next(sequence) is None
    acknowledge(state, disable, 10.08)
    sent = state.next(sequence)
    assert sent is not None
    assert (sent.enable, sent.behaviour, sent.sequence) == (True, "rendezvous", 3)
    assert not state.compare(health("flocking", "old", enable.sequence), False, 10.09)
    assert state.next(sequence) is None
    acknowledge(state, sent, 10.1)
    assert state.settled


def running(behaviour: str = "flocking") -> tuple[Desired, ControlRequest]:
    """Return a robot's state after it has acknowledged, at 10 s, an update of the behaviour that it ran before."""
    numbers = itertools.count(1)
    state = Desired("r1", "core-1", present=True)
    requests: list[ControlRequest] = []
    for request_id in ("old", "new"):
        state.set_order(Order(request_id=request_id, behaviour=behaviour, law=behaviour), 9.0)
        request = state.next(lambda: next(numbers))
        assert request is not None
        acknowledge(state, request, 10.0)
        requests.append(request)
    assert state.settled
    return state, requests[-1]


@pytest.mark.parametrize("late_s", [0.1, 0.6, 9.0])
def test_a_report_that_is_later_than_the_acknowledgement_after_it_gives_no_request_twice(late_s: float) -> None:
    """On a loaded computer reports wait for seconds while acknowledgements pass them."""
    state, request = running()
    late = health("flocking", "old", request.sequence - 1)
    assert not state.compare(late, False, 10.0 + late_s)
    assert state.next(lambda: 99) is None
    assert state.settled


@pytest.mark.parametrize("late_s", [0.1, 0.6, 9.0])
def test_an_idle_robot_s_late_report_does_not_end_what_it_has_acknowledged_since(late_s: float) -> None:
    state, request = running()
    assert not state.compare(health(sequence=request.sequence - 1), False, 10.0 + late_s)
    assert state.settled


def test_a_robot_that_has_stopped_by_itself_is_believed_at_once() -> None:
    state, request = running()
    assert state.compare(health(sequence=request.sequence), False, 10.01).code == Code.DRIVER_STOPPED


def test_a_report_from_before_the_first_request_is_not_believed_for_a_while() -> None:
    state, _ = running()
    assert not state.compare(health(), False, 10.0 + UNSEEN_S - 0.1)
    assert state.compare(health(), False, 10.0 + UNSEEN_S + 0.1).code == Code.DRIVER_STOPPED
