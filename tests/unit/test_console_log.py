"""What the log shows of requests, without the ids that only programs read."""

from __future__ import annotations

from fullswarm.messages import BehaviourRequest, RequestStatus
from fullswarm.operator.console.log import EventLog, RequestLog
from fullswarm.reasons import Code, Reason, given, reason


def lines(why: Reason) -> list[str]:
    journal = EventLog(lambda: 0.0, lambda _: None)
    book = RequestLog(journal, lambda _: False)
    book.add_request(BehaviourRequest(id="a1", behaviour="flocking_bc", operator="anna"), 0.0)
    book.add_request(BehaviourRequest(id="b2", behaviour="rendezvous_bc", operator="bob"), 0.1)
    book.add_stop("c3", "the e-stop", "carl")
    status = RequestStatus(
        request_id="a1", behaviour="flocking_bc", phase="superseded", reason=why.text, code=why.code,
        parameters=dict(why.parameters),
    )  # fmt: skip
    book.add_status(status, 0.2)
    return [entry.text for entry in journal.entries]


def test_what_beat_a_request_is_named() -> None:
    assert lines(reason(Code.SUPERSEDED, by="b2"))[-1] == "flocking_bc replaced by rendezvous_bc of bob"
    assert lines(reason(Code.SUPERSEDED, by="c3"))[-1] == "flocking_bc replaced by the e-stop of carl"


def test_a_request_that_was_not_received_is_shown_without_its_id() -> None:
    assert lines(reason(Code.SUPERSEDED, by="d4"))[-1] == "flocking_bc replaced by another request"
    assert lines(given("it has stopped by itself"))[-1] == "flocking_bc superseded: it has stopped by itself"
