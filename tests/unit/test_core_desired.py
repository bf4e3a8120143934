"""What the request handler concludes from acknowledgements and reports that arrive late or in another order."""

from __future__ import annotations

import itertools

from fullswarm.core.desired import Desired, Order
from fullswarm.messages import ControlAck, ControlRequest, RobotHealth


def health(behaviour: str = "", request_id: str = "", sequence: int = 0) -> RobotHealth:
    return RobotHealth(
        robot="r1", driver="sim://r1", make="sim", model="", firmware="", lifecycle="READY", behaviour=behaviour,
        request_id=request_id, core="core-1" if behaviour else "", sequence=sequence, moving=False, estop=False,
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
