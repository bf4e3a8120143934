"""Handing robots over from one operator to another: the offer, its end, and who drives meanwhile."""

from __future__ import annotations

from pathlib import Path

import pytest

from fullswarm.messages import LeaseRequest, StopRequest
from fullswarm.operator.console.handover import GONE, MOST_OF_ONE, OFFER_S
from fullswarm.operator.console.sessions import IN_STUDY, OBSERVER, OperatorSession
from fullswarm.operator.console.tokens import Role
from fullswarm.operator.view import LEASES_S
from tests.unit.console_bench import ConsoleBench, Page, health
from tests.unit.study_lab import StudyBench, plan


class Table(ConsoleBench):
    """A console with two operators; anna holds r1 and r2."""

    def __init__(self) -> None:
        super().__init__()
        self.report(*(health(robot) for robot in ("r1", "r2", "r3")))
        self.anna, self.giver = self.enter("anna")
        self.ben, self.taker = self.enter("ben")
        self.held(r1="anna", r2="anna")

    def enter(self, name: str, key: str = "session-1", role: Role = "operator") -> tuple[Page, OperatorSession]:
        page = Page()
        return page, self.gateway.join(key, name, page, named=True, role=role)

    def held(self, **holders: str) -> None:
        self.leases(**holders)
        self.run(0.15)

    def offer(self, *robots: str, to: str = "ben") -> str:
        """Offer robots; return the reason of a refusal."""
        reason: str = self.say(self.giver, self.anna, "handover", op="offer", to=to, robots=robots)["reason"]
        return reason

    def open(self) -> str:
        """Return the id of the only offer that ben sees."""
        (found,) = self.ben.last("offers")["offers"]
        return str(found["id"])

    def accept(self, offer: str) -> str:
        reason: str = self.say(self.taker, self.ben, "handover", op="accept", id=offer)["reason"]
        self.run(0.01)
        return reason

    def asked_leases(self) -> list[LeaseRequest]:
        return [each for each in self.sent if isinstance(each, LeaseRequest)]

    def keep(self, seconds: float, **holders: str) -> None:
        """Let the core report the same holders for a while."""
        for _ in range(round(seconds)):
            self.leases(**holders)
            self.run(1.0)


@pytest.fixture
def table() -> Table:
    return Table()


def test_until_it_is_accepted_nothing_changes(table: Table) -> None:
    table.change("wanted/r1", {"request_id": "a", "behaviour": "move_to_goal_bc"})
    table.run(0.01)
    assert table.offer("r1") == ""
    (seen,) = table.ben.last("offers")["offers"]
    assert (seen["from"], seen["robots"], seen["runs"], seen["mine"]) == ("anna", ["r1"], "Move to goal", False)
    assert table.anna.last("offers")["offers"][0]["mine"]
    table.keep(5.0, r1="anna", r2="anna")
    assert table.asked_leases() == []
    assert table.anna.log("lease")[-1] == "anna offers r1 to ben"


def test_accepted_the_lease_is_asked_for_of_the_giver_alone_and_the_behaviour_goes_on(table: Table) -> None:
    table.say(table.giver, table.anna, "lease", robots=["r1", "r2"], hold=True)
    table.run(0.01)
    table.held(r1="anna", r2="anna")
    table.offer("r1")
    assert table.accept(table.open()) == ""
    asked = table.asked_leases()[-1]
    assert (asked.operator, asked.robots, asked.hold, asked.take) == ("ben", ("r1",), True, True)
    assert asked.given_by == "anna", "not from a third operator who has taken it meanwhile"
    assert not [each for each in table.sent if isinstance(each, StopRequest)]
    table.held(r1="ben", r2="anna")
    assert table.anna.log("lease")[-1] == "ben holds r1, handed over by anna"
    assert table.anna.all("lost") == [], "what was given was not lost"
    count = len(table.asked_leases())
    table.run(1.5)
    renewals = {each.operator: each.robots for each in table.asked_leases()[count:]}
    assert renewals == {"anna": ("r2",), "ben": ("r1",)}
    assert table.ben.last("offers")["offers"] == []
    assert table.anna.last("handover")["outcome"] == "accepted"


def test_what_the_giver_drives_is_stopped_before_the_lease_moves(table: Table) -> None:
    for _ in range(3):
        table.say(table.giver, table.anna, "drive", behaviour="drive_bc", robots=["r1"], sticks={"linear": 1.0})
        table.run(0.05)
    table.offer("r1", "r2")
    table.accept(table.open())
    given = next(k for k, each in enumerate(table.sent) if isinstance(each, LeaseRequest) and each.given_by)
    assert any(isinstance(each, StopRequest) for each in table.sent[:given])
    stopped = next(each for each in table.sent if isinstance(each, StopRequest))
    assert stopped.robots == ("r1",), "r2 was not driven: it goes on"
    assert "r1 driven by hand: stopped" in table.ben.last("handover")["words"]
    again = table.say(table.giver, table.anna, "drive", behaviour="drive_bc", robots=["r1"], sticks={"linear": 1.0})
    assert "release the dead-man switch first" in again["reason"]


def test_another_page_of_the_giver_is_released_too(table: Table) -> None:
    page, session = table.enter("anna", "session-9")
    table.say(session, page, "drive", behaviour="drive_bc", robots=["r1"], sticks={"linear": 1.0})
    table.run(0.05)
    table.offer("r1")
    table.accept(table.open())
    assert not session.driven()


def test_it_can_be_declined_withdrawn_and_expires(table: Table) -> None:
    table.offer("r1")
    table.say(table.taker, table.ben, "handover", op="decline", id=table.open())
    assert table.anna.last("handover")["words"] == "ben declines r1: you still hold it"
    table.offer("r1")
    table.say(table.giver, table.anna, "handover", op="withdraw", id=table.open())
    assert table.ben.last("handover")["outcome"] == "withdrawn"
    table.offer("r1")
    offer = table.open()
    table.keep(OFFER_S - 1.0, r1="anna", r2="anna")
    assert table.open() == offer
    table.keep(2.0, r1="anna", r2="anna")
    assert table.anna.last("handover")["outcome"] == "expired"
    assert table.accept(offer) == GONE
    assert table.asked_leases() == []


def test_a_page_that_dies_ends_the_offer(table: Table) -> None:
    for page, session in ((table.anna, table.giver), (table.ben, table.taker)):
        table.offer("r1")
        offer = table.open()
        table.gateway.leave(session, page)
        table.run(0.15)
        other = table.ben if page is table.anna else table.anna
        assert "has left" in other.last("handover")["words"]
        session.listeners.append(page)  # a reload
        assert table.accept(offer) == GONE
    assert table.asked_leases() == []


def test_one_of_two_pages_of_the_taker_may_close(table: Table) -> None:
    page, session = table.enter("ben", "session-9")
    table.offer("r1")
    table.gateway.leave(session, page)
    table.run(0.15)
    assert table.accept(table.open()) == ""


@pytest.mark.parametrize("holders", [{"r1": "cleo", "r2": "anna"}, {"r2": "anna"}])
def test_robots_that_the_giver_no_longer_holds_are_not_handed_over(table: Table, holders: dict[str, str]) -> None:
    table.offer("r1", "r2")
    offer = table.open()
    table.leases(**holders)
    table.run(0.001)
    assert table.accept(offer) == GONE
    assert table.asked_leases() == []


def test_a_silent_core_ends_the_offer(table: Table) -> None:
    table.offer("r1")
    offer = table.open()
    table.run(LEASES_S + 0.2)
    assert table.accept(offer) == GONE


def test_what_cannot_be_offered_is_refused_with_the_reason(table: Table) -> None:
    table.enter("wall", role="observer")
    assert table.offer() == "a hand-over needs robots: select some that you hold"
    assert table.offer("r1", "r3") == "you do not hold r3: only what you hold can be handed over"
    assert "observer" in table.offer("r1", to="wall")
    assert "no operator 'bne' has this console open (did you mean 'ben'?)" in table.offer("r1", to="bne")
    assert table.offer("r1", to="anna") == "these robots are yours already"
    assert table.offer("r1") == ""
    assert table.offer("r1", "r2") == "r1 offered already: withdraw that offer first"


def test_only_the_two_act_on_an_offer(table: Table) -> None:
    page, session = table.enter("cleo")
    table.offer("r1")
    offer = table.open()
    assert page.last("offers")["offers"] == []
    for op in ("accept", "decline", "withdraw"):
        assert table.say(session, page, "handover", op=op, id=offer)["reason"] == GONE
    assert table.say(table.giver, table.anna, "handover", op="accept", id=offer)["reason"] == GONE
    assert table.say(table.taker, table.ben, "handover", op="withdraw", id=offer)["reason"] == GONE
    assert table.open() == offer


def test_a_driver_may_give_and_take_what_is_given_but_an_observer_nothing(table: Table) -> None:
    page, session = table.enter("dora", role="driver")
    table.offer("r1", to="dora")
    offer = page.last("offers")["offers"][0]["id"]
    assert table.say(session, page, "handover", op="accept", id=offer)["ok"]
    page, session = table.enter("wall", role="observer")
    assert table.say(session, page, "handover", op="accept", id=offer)["reason"] == OBSERVER


def test_offers_are_bounded(table: Table) -> None:
    robots = [f"r{number}" for number in range(1, 20)]
    table.held(**dict.fromkeys(robots, "anna"))
    reasons = [table.offer(robot) for robot in robots]
    assert reasons[:MOST_OF_ONE] == [""] * MOST_OF_ONE
    assert all("too many offers" in each for each in reasons[MOST_OF_ONE:])
    assert len(table.ben.last("offers")["offers"]) == MOST_OF_ONE


@pytest.mark.parametrize(
    "fields",
    [{"op": "steal"}, {"op": "offer", "robots": ["@x"]}, {"op": "offer", "to": "x" * 129}, {"op": "accept", "id": 3}],
)
def test_malformed_frames_are_answered(table: Table, fields: dict[str, object]) -> None:
    assert not table.say(table.giver, table.anna, "handover", **fields)["ok"]


def test_in_a_study_others_are_not_shown_and_nothing_is_handed_over(tmp_path: Path) -> None:
    bench = StudyBench(tmp_path, plan())
    page, session = bench.join()
    bench.run(0.5)
    assert page.all("presence") == []
    assert bench.say(session, page, "handover", op="offer", to="ben", robots=["r1"])["reason"] == IN_STUDY
