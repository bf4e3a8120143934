"""What the log shows of requests, without the ids that only programs read."""

from __future__ import annotations

from fullswarm.messages import BehaviourRequest, RequestStatus
from fullswarm.operator.console.log import Entry, EventLog, RequestLog
from fullswarm.reasons import ADVICE, TEXTS, Code, Reason, given, joined, reason, worded


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
    assert lines(reason(Code.SUPERSEDED, by="c3"))[-1] == "flocking_bc ended by the e-stop of carl"


def test_a_request_that_was_not_received_is_shown_without_its_id() -> None:
    assert lines(reason(Code.SUPERSEDED, by="d4"))[-1] == "flocking_bc replaced by another request"
    assert lines(given("it has stopped by itself"))[-1] == "flocking_bc superseded: it has stopped by itself"


def test_the_same_refusal_is_one_line_with_a_count() -> None:
    shown: list[Entry] = []
    journal = EventLog(lambda: 0.0, shown.append)
    for text in ("a refused: x", "b refused: y", "a refused: x", "a refused: x"):
        journal.add(0.0, "refused", text, ("r1",), by="anna")
    assert [(each.text, each.count) for each in journal.entries] == [("b refused: y", 1), ("a refused: x", 3)]
    assert shown[3].number == shown[0].number != shown[1].number
    journal.add(0.0, "refused", "a refused: x", ("r2",), by="anna")
    journal.add(0.0, "refused", "a refused: x", ("r1",), by="bert")
    journal.add(0.0, "request", "a refused: x", ("r1",), by="anna")
    assert [each.count for each in journal.entries] == [1, 3, 1, 1, 1], "of others it is another line"


def test_the_advice_of_a_reason_follows_its_code_and_its_reader() -> None:
    latched = reason(Code.ESTOP_LATCHED)
    assert "`fullswarm estop --clear`" in latched.text
    assert worded(latched, "page", ("r1", "r2")).startswith("r1, r2: its e-stop is latched; clear it with the button")
    several = joined({"r1": latched, "r2": reason(Code.BATTERY)})
    assert "`" in several.text
    page = worded(several, "page")
    assert "`" not in page
    assert page.startswith("r1: its e-stop is latched; clear it with the button")
    assert "r2: battery low" in page
    plain = joined({"r1": reason(Code.BATTERY), "r2": reason(Code.POSE)})
    assert worded(plain, "page") == plain.text
    assert worded(Reason("one of a newer version", "its text"), "page", ("r1",)) == "its text"
    assert worded(Reason(Code.VERSION, "with other parameters"), "page") == "with other parameters"


def test_no_advice_for_the_page_names_a_command() -> None:
    for advice in ADVICE.values():
        assert "`" in advice.shell
        assert "`" not in advice.page
    for text in TEXTS.values():
        assert "`fullswarm" not in text
