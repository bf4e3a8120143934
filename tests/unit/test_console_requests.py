"""What the log says of requests, without the ids that only programs read."""

from __future__ import annotations

from fullswarm.messages import BehaviourRequest, RequestStatus
from fullswarm.operator.console.history import Journal
from fullswarm.operator.console.requests import RequestBook


def lines(reason: str) -> list[str]:
    journal = Journal(lambda: 0.0, lambda _: None)
    book = RequestBook(journal, lambda _: False)
    book.asked(BehaviourRequest(id="a1", behaviour="flocking_bc", operator="anna"), 0.0)
    book.asked(BehaviourRequest(id="b2", behaviour="rendezvous_bc", operator="bob"), 0.1)
    book.stopped("c3", "the e-stop", "carl")
    book.said(RequestStatus(request_id="a1", behaviour="flocking_bc", phase="superseded", reason=reason), 0.2)
    return [entry.text for entry in journal.entries]


def test_what_beat_a_request_is_named() -> None:
    assert lines("superseded by b2")[-1] == "flocking_bc superseded by rendezvous_bc of bob"
    assert lines("superseded by c3")[-1] == "flocking_bc superseded by the e-stop of carl"


def test_what_was_never_heard_keeps_its_id() -> None:
    assert lines("superseded by d4")[-1] == "flocking_bc superseded by d4"
    assert lines("the robot has stopped by itself")[-1] == "flocking_bc superseded: the robot has stopped by itself"
