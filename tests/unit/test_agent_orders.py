"""Interleavings that an agent must survive: late, repeated and contradicting orders, stops above all."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import pytest

from fullswarm.agent.message_delay import MessageDelay
from fullswarm.agent.orders.tasks import Task, Tasks, check, read_records_again
from fullswarm.drivers.base import Hazard
from fullswarm.errors import ConfigError
from fullswarm.messages import ControlRequest, EStopReceipt, Halt, RobotHealth
from tests.unit.agent_bench import TICK_S, Bench

GOAL = {"goal": [15.0, 5.0], "gain": 1.0, "arrive_radius_m": 0.2}
STICK = {"linear": 1.0, "angular": 0.0, "speed_m_s": 0.5, "turn_rad_s": 1.0}


@pytest.fixture
def bench() -> Bench:
    return Bench([(5.0, 5.0, 0.0)])


def drive(bench: Bench, request_id: str, **fields: Any) -> bool:
    """Ask for `request_id` and tell whether the robot drives a second later."""
    bench.enable("move_to_goal", GOAL, request_id=request_id, **fields)
    bench.run(1.0)
    return bool(bench.commanded.any())


def health(bench: Bench) -> RobotHealth:
    return bench.agent.health(0.0).robots[0]


# ------------------------------------------------------------------ e-stop
def test_repeated_releases_of_one_operator_do_not_undo_the_newer_e_stop_of_another(bench: Bench) -> None:
    bench.estop(True, "a1")
    bench.estop(False, "a2")
    bench.estop(True, "b1")  # somebody else presses while a2 is still repeated for a robot that does not answer
    for _ in range(5):
        bench.estop(False, "a2")
        bench.run(0.1)
        assert bench.agent.controller.estop[0]
    assert not drive(bench, "q")
    bench.estop(False, "b2")
    assert drive(bench, "q2")


def test_a_late_copy_of_an_e_stop_does_not_engage_it_again(bench: Bench) -> None:
    bench.estop(True, "a1")
    bench.run(0.2)
    bench.estop(False, "a2")
    assert drive(bench, "q")
    bench.receipts.clear()
    bench.estop(True, "a1")
    bench.run(0.2)
    assert bench.commanded.any()
    assert bench.receipts == [], "a1 is over: nobody may be told that it holds"


def test_two_operators_who_press_at_once_both_hear_that_it_stands(bench: Bench) -> None:
    assert drive(bench, "q")
    for _ in range(8):
        bench.estop(True, "a1")
        bench.run(TICK_S)
        bench.estop(True, "b1")
        bench.run(TICK_S)
    bench.run(0.5)
    standing = {receipt.id for receipt in bench.receipts if receipt.standing}
    assert standing == {"a1", "b1"}
    bench.receipts.clear()
    for order in ("a1", "b1"):
        bench.estop(True, order)
    assert [(each.id, each.standing) for each in bench.receipts] == [("a1", True), ("b1", True)]


def test_releasing_a_robot_that_is_not_latched_stops_nobody(bench: Bench) -> None:
    assert drive(bench, "q")
    bench.estop(False, "r1")
    bench.run(0.2)
    assert bench.commanded.any()
    assert bench.receipts[-1] == EStopReceipt(id="r1", robot="r1", engaged=False)


def test_orders_without_an_id_are_carried_out_each_time(bench: Bench) -> None:
    for number in range(2):
        bench.estop(True, "")
        assert bench.agent.controller.estop[0]
        bench.estop(False, "")
        assert not bench.agent.controller.estop[0]
        assert drive(bench, f"q{number}")
        bench.stop("")
        bench.run(0.1)
        assert not bench.commanded.any()


# ------------------------------------------------------------------ stops and reconciliation
@pytest.mark.parametrize("how", ["stop", "estop"])
def test_a_core_that_comes_back_cannot_undo_a_stop_it_did_not_hear(bench: Bench, how: str) -> None:
    assert drive(bench, "q")
    bench.beating = False
    bench.run(2.0)  # the core is dead, the robot stands but still holds its task
    if how == "stop":
        bench.stop("s")
    else:
        bench.estop(True, "e1")
        bench.run(1.0)
        bench.estop(False, "e2")
    bench.beating = True
    assert not drive(bench, "q", core="d", sequence=1)
    assert not bench.acks[-1].accepted
    assert "ask for it again" in bench.acks[-1].reason
    assert how.replace("estop", "e-stop") in bench.acks[-1].reason
    assert not drive(bench, "q", core="e", sequence=1), "nor a third one"
    assert drive(bench, "new", core="e", sequence=2)


def test_the_newest_stop_is_reported_until_something_is_started(bench: Bench) -> None:
    assert health(bench).halt is None
    bench.stop("a")  # to an agent that runs nothing
    at_s = bench.runtime.now_s()
    bench.run(0.5)
    assert health(bench).halt == Halt(id="a", source="test", stamp_s=at_s)
    assert drive(bench, "q")
    assert health(bench).halt is None
    bench.stop("b")
    bench.estop(True, "e")
    assert not drive(bench, "r")
    bench.estop(False, "f")
    bench.run(0.5)
    halt = health(bench).halt
    assert halt is not None
    assert (halt.id, halt.estop) == ("e", True), "a release starts nothing"
    assert drive(bench, "s")
    assert health(bench).halt is None


def test_a_request_that_crossed_a_stop_is_ignored_until_the_core_knows_the_stop(bench: Bench) -> None:
    assert drive(bench, "p", sequence=1, halts=())
    bench.stop("s")
    answers = len(bench.acks)
    assert not drive(bench, "q", sequence=2, halts=("r",))
    assert len(bench.acks) == answers, "it is neither accepted nor refused: it may have been made after the stop"
    halt = health(bench).halt
    assert halt is not None
    assert halt.id == "s"
    assert drive(bench, "q", sequence=2, halts=("r", "s")), "the same again, by a core that knows the stop"


def test_several_spent_requests_are_remembered(bench: Bench) -> None:
    for name in ("a", "b", "c"):
        assert drive(bench, name)
        bench.stop(f"stop-{name}")
        bench.run(0.1)
    for number, name in enumerate(("a", "b", "c")):
        assert not drive(bench, name, core=f"late-{number}", sequence=1)


@pytest.mark.parametrize(
    ("hazard", "words"),
    [(Hazard.WHEEL_DROP, "a wheel hangs"), (Hazard.ESTOP_BUTTON | Hazard.MOTORS_OFF, "its safety switch")],
)
def test_a_request_during_a_hazard_is_refused_and_does_not_start_when_the_hazard_ends(
    bench: Bench, hazard: Hazard, words: str
) -> None:
    bench.simulated.hazards[0] = int(hazard)
    bench.run(0.1)
    assert not drive(bench, "q")
    assert bench.acks[-1].reason.startswith(words)
    bench.simulated.hazards[0] = 0
    bench.run(1.0)
    assert not bench.commanded.any(), "it would drive off out of the hands that put it down"
    assert drive(bench, "q2")


# ------------------------------------------------------------------ old cores
def test_late_messages_of_an_old_core_are_refused_and_change_nothing(bench: Bench) -> None:
    assert drive(bench, "old", core="c1", sequence=40)
    assert drive(bench, "new", core="c2", sequence=1)
    bench.enable("stop", request_id="late", core="c1", sequence=41)
    bench.run(0.2)
    assert health(bench).request_id == "new"
    assert (bench.acks[-1].core, bench.acks[-1].accepted) == ("c1", False)
    assert "another core" in bench.acks[-1].reason
    bench.enable("move_to_goal", GOAL, request_id="old", core="c1", sequence=40)
    bench.run(0.2)
    assert health(bench).request_id == "new"
    assert drive(bench, "newer", core="c2", sequence=2)


def test_a_late_command_of_an_old_core_neither_steers_nor_silences_the_new_one(bench: Bench) -> None:
    bench.enable("central", centralised=True, core="c1", sequence=1)
    bench.command(0.4, 5_000)
    bench.enable("central", centralised=True, core="c2", sequence=10_000)
    bench.run(0.4)
    assert not bench.commanded.any()
    bench.command(0.4, 5_001)  # was on the way when its core died
    bench.run(TICK_S)
    assert not bench.commanded.any()
    bench.command(0.4, 10_001)
    bench.run(TICK_S)
    assert bench.commanded.any()


# ------------------------------------------------------------------ intents
def test_an_intent_that_waited_in_a_queue_has_lapsed_when_it_comes(bench: Bench) -> None:
    for number in range(5):
        bench.enable("drive", STICK, request_id=f"i{number}", expires_s=0.3, stamp_s=bench.runtime.now_s())
        bench.run(0.05)
    assert bench.commanded.any()
    bench.run(2.0)
    assert not bench.commanded.any()
    # Its operator has long let go, or is dead.
    bench.enable("drive", STICK, request_id="late", expires_s=0.3, stamp_s=bench.runtime.now_s() - 1.5)
    for _ in range(10):
        bench.run(TICK_S)
        assert not bench.commanded.any()


def test_a_sender_whose_clock_begins_at_zero_is_not_late() -> None:
    freshness = MessageDelay()
    assert freshness.delay_s("c", 0.0, 0.0) == 0.0
    assert freshness.delay_s("c", 0.1, 0.1) == 0.0
    assert freshness.delay_s("d", 900.0, 0.2) == 0.0
    assert freshness.delay_s("d", 900.1, 0.8) == pytest.approx(0.5)


# ------------------------------------------------------------------ parameters
def request(robot: str, law: str, **fields: Any) -> ControlRequest:
    return ControlRequest(**{"request_id": "q", "robot": robot, "behaviour": law, "law": law, "enable": True, **fields})


@pytest.mark.parametrize(
    "parameters",
    [{"goal": [[1.0, 2.0], 3.0]}, {"__class__": 1.0}, {"goal": [1.0, 2.0], "": 1.0, "\u2603": 2.0, "update": 1.0}],
)
def test_parameters_that_no_law_can_take_end_in_an_answer_not_in_the_agent(
    bench: Bench, parameters: dict[str, Any]
) -> None:
    bench.enable("move_to_goal", parameters)
    bench.run(0.2)
    assert len(bench.acks) == 1
    assert not bench.commanded.any()
    assert drive(bench, "sane")


@pytest.fixture
def odd_records(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Two laws have parameters that the records of no behaviour of ours name."""

    @functools.cache
    def tables() -> dict[str, dict[str, Any]]:
        ways = {f"way_{kind}": {"law": "rendezvous", "parameters": {"way": {"type": kind}, "gain": {"type": "number"}}}
                for kind in ("word", "number")}  # fmt: skip
        kinds = {f"spots_{kind}": {"law": "move_to_goal", "parameters": {"spots": {"type": kind}}}
                 for kind in ("point", "points")}  # fmt: skip
        return ways | kinds

    monkeypatch.setattr("fullswarm.agent.orders.tasks._tables", tables)
    read_records_again()
    yield
    monkeypatch.undo()
    read_records_again()


@pytest.mark.usefixtures("odd_records")
def test_robots_with_different_words_or_reach_are_not_thrown_together() -> None:
    tasks = make_tasks(3)
    for row, (word, reach) in enumerate([("left", 5.0), ("right", 5.0), ("left", 30.0)]):
        asked = request(f"r{row}", "rendezvous", parameters={"way": word, "hearing_m": reach, "gain": 1.0 + row})
        tasks.enable(row, Task(asked, 0.0))
    found: dict[tuple[int, ...], Any] = {
        tuple(group.rows.tolist()): (group.params.way, group.hearing_m) for group in tasks.groups()
    }
    assert found == {(0,): ("left", 5.0), (1,): ("right", 5.0), (2,): ("left", 30.0)}


@pytest.mark.usefixtures("odd_records")
def test_one_robot_may_have_a_word_where_another_has_a_number() -> None:
    tasks = make_tasks(2)
    tasks.enable(0, Task(request("r0", "rendezvous", parameters={"way": 1.0}), 0.0))
    tasks.enable(1, Task(request("r1", "rendezvous", parameters={"way": "much"}), 0.0))
    assert sorted(group.rows.tolist() for group in tasks.groups()) == [[0], [1]]


@pytest.mark.usefixtures("odd_records")
def test_an_update_whose_value_has_another_shape_is_taken_or_refused() -> None:
    tasks = make_tasks(1)
    tasks.enable(0, Task(request("r0", "move_to_goal", parameters={"spots": [1.0, 2.0]}), 0.0))
    tasks.groups()
    tasks.enable(0, Task(request("r0", "move_to_goal", parameters={"spots": [[1.0, 2.0], [3.0, 4.0]]}), 0.0))
    assert tasks.groups()[0].params.spots == [[1.0, 2.0], [3.0, 4.0]]


def test_a_law_that_becomes_centralised_leaves_the_robot_to_the_commands_alone() -> None:
    tasks = make_tasks(1)
    tasks.enable(0, Task(request("r0", "rendezvous", parameters={}), 0.0))
    assert len(tasks.groups()) == 1
    tasks.enable(0, Task(request("r0", "rendezvous", parameters={}, centralised=True), 0.0))
    assert tasks.groups() == []


def make_tasks(count: int) -> Tasks:
    import numpy as np

    return Tasks(count, 0.03, 2.0, np.full(count, 4.0))


@pytest.mark.parametrize(
    ("parameters", "why"),
    [
        ({"safety_margin_m": -5.0}, "safety_margin_m = -5"),
        ({"safety_margin_m": -5}, "safety_margin_m = -5"),
        ({"barrier_gain_per_s": 1e9}, "barrier_gain_per_s = 1e\\+09"),
        ({"speed_limit_m_s": 50.0}, "no behaviour .* has such a parameter"),
    ],
)
def test_a_robot_checks_the_parameters_itself(parameters: dict[str, Any], why: str) -> None:
    request = ControlRequest(
        request_id="q", robot="r1", behaviour="move_to_goal_bc", enable=True, law="move_to_goal", filtered=True,
        parameters={"goal": [1.0, 1.0], **parameters}, core="c", sequence=1,
    )  # fmt: skip
    with pytest.raises(ConfigError, match=why):
        check(request)
