"""The judge of a live rehearsal sees each thing that must not be, and nothing where all is well."""

from __future__ import annotations

import math

import pytest

from fullswarm.bus.network_faults import parse_network
from fullswarm.rehearse.live.judge import Ask, Doing, Down, Published, Ran, Record
from fullswarm.rehearse.live.plan import DECK, DISK_FULL, conditions, plan


def ran(t: float, request_id: str, sequence: int, agent: str = "r1-a", core: str = "c", **fields: bool) -> Ran:
    return Ran(t, "r1", request_id, agent, core, sequence, **fields)


def good() -> Record:
    """One robot, two requests one after the other, each accepted and executed, and a body that moves for them."""
    record = Record(end_s=60.0, doing={"r1": Doing("flocking", "b")})
    for t, name in ((10.0, "a"), (20.0, "b")):
        record.asks[name] = Ask(t, "ann", name, "flocking", ("r1",))
        record.published.append(Published(t + 0.1, name, "accepted", ("r1",)))
        record.ran.append(ran(t + 0.2, name, int(t)))
    record.moved = [(10.0 + 0.1 * k, "r1") for k in range(3, 400)]
    return record


def stopped(record: Record, at_s: float) -> None:
    record.asks["s"] = Ask(at_s, "bob", "s", "", ("r1",))
    record.published.append(Published(at_s + 0.1, "s", "running", ("r1",), ("r1",)))
    record.standing.append((at_s + 0.1, "r1", "s"))


def test_a_run_in_which_all_is_well() -> None:
    assert good().judge().clean


def test_a_motion_after_a_stop_or_without_an_agent_or_before_anything_was_asked() -> None:
    record = good()
    stopped(record, 30.0)
    assert "no request since s" in record.judge().uncommanded[0]
    record.moved = [(5.0, "r1")]
    assert "no request before" in record.judge().uncommanded[0]
    for down in (Down("r1", 24.0), Down("hub", 24.0), Down("core", 24.0), Down("e-stop of r1", 24.0)):
        record = good()
        record.downs = [down]
        assert len(record.judge().uncommanded) == 1
        record.downs = [Down(down.name, 24.0, 25.0)]
        assert record.judge().clean, "it takes a moment to notice"
    record = good()
    record.downs = [Down(DISK_FULL, 24.0)]
    assert record.judge().clean, "the core lives"


def test_the_time_in_which_the_world_stood_still_does_not_count() -> None:
    record = good()
    record.downs = [Down("link of r1", 24.0, 30.0)]
    record.moved = [(at_s, "r1") for at_s in (23.9, 28.0)]
    assert len(record.judge().uncommanded) == 1
    record.stood = [(10.0, 12.0), (24.5, 27.9)]
    assert record.judge().clean, "it has run for 0.6 s"
    record.moved.append((29.95, "r1"))
    assert not record.judge().uncommanded, "2.55 s, but the link is back at once"
    record.downs = [Down("link of r1", 24.0, 40.0)]
    assert record.judge().uncommanded == ["r1 moved at 29.95 (1 samples) although link of r1 was down since 24.00"]
    stopped(record := good(), 30.0)
    record.moved = [(at_s, "r1") for at_s in (29.0, 33.0)]
    assert len(record.judge().uncommanded) == 1
    record.stood = [(30.2, 32.9)]
    assert not record.judge().uncommanded


@pytest.mark.parametrize(("stopped_s", "wrong"), [(24.0, 0), (30.0, 1)])
@pytest.mark.parametrize("operator", ["ann", "bob"])
def test_a_late_request_moves_no_robot_that_anybody_stopped_after_it_was_sent(
    operator: str, stopped_s: float, wrong: int
) -> None:
    record = good()
    record.moved = [(35.0, "r1")]
    stopped(record, stopped_s)
    record.asks["late"] = Ask(25.0, operator, "late", "rendezvous", ("r1",))
    record.late["late"] = 32.0
    assert len(record.judge().uncommanded) == wrong


def test_a_request_that_is_executed_twice() -> None:
    record = good()
    record.ran.append(ran(20.4, "b", 20))
    assert record.judge().clean, "the same answer once more"
    record.ran.append(ran(21.0, "b", 21, agent="r1-b"))
    assert record.judge().clean, "the agent was started again"
    record.ran.append(ran(22.0, "b", 22, agent="r1-b"))
    assert len(record.judge().doubled) == 1
    record = good()
    record.ran = [ran(20.1, "b", 1, centralised=True), ran(30.0, "b", 2, core="d", centralised=True)]
    assert record.judge().doubled == [], "a new core's commands bear its own numbers"


def test_an_older_request_after_a_newer_one_of_the_same_operator() -> None:
    record = good()
    record.asks["late"] = Ask(15.0, "ann", "late", "rendezvous", ("r1",))
    record.ran.append(ran(27.0, "late", 27))
    assert len(record.judge().older) == 1
    record.asks["late"] = Ask(15.0, "bob", "late", "rendezvous", ("r1",))
    assert record.judge().older == [], "of two people the last request received counts"


def test_a_request_that_is_never_executed() -> None:
    record = good()
    record.ran.pop(0)
    record.downs = [Down("core", 12.0, 14.0)]
    assert record.judge().lost == [], "its core was down, and the next request came soon"
    record.downs = []
    record.asks["b"] = Ask(21.0, "ann", "b", "flocking", ("r1",))
    record.published[1] = Published(21.0, "b", "accepted", ("r1",))
    assert len(record.judge().lost) == 1
    record.published.insert(0, Published(10.05, "a", "refused", ("r1",), refused_by=("r1",)))
    assert record.judge().lost == [], "it was refused"
    record = good()
    record.asks["c"] = Ask(30.0, "ann", "c", "flocking", ("r1",))
    assert len(record.judge().lost) == 1, "no status"
    record.killed["c"] = 30.1
    assert record.judge().lost == [], "who asked was killed"


def test_a_robot_that_does_something_else_at_the_end() -> None:
    for doing in (
        Doing("", ""), Doing("flocking", "a"), Doing("flocking", "b", fresh=False), Doing("flocking", "b", estop=True),
    ):  # fmt: skip
        record = good()
        record.doing["r1"] = doing
        assert len(record.judge().wrong) == 1
    record = good()
    record.moved = []
    stopped(record, 30.0)
    assert len(record.judge().wrong) == 1
    record.doing["r1"] = Doing("", "")
    assert record.judge().clean


def test_a_plan_of_faults_is_the_same_for_a_seed_and_holds_every_kind() -> None:
    robots = tuple(f"r{k}" for k in range(16))
    faults = plan(robots, 300.0, 5.0, 7)
    assert faults == plan(robots, 300.0, 5.0, 7) != plan(robots, 300.0, 5.0, 8)
    assert len(faults) == 60
    assert {each.kind for each in faults} == set(DECK)
    network = parse_network(conditions(faults, 0.01))
    assert math.isclose(network.loss, 0.01)
    assert len(network.partitions) == sum(each.kind == "robots cut off" for each in faults)
