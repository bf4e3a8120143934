"""Driving from a page: never a twist without the dead-man, zero whatever happens to page, line or operator."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.messages import EStop
from fullswarm.operator.console.sessions import DEAD_MAN_S, OperatorSession
from tests.unit.console_bench import KEYS, ConsoleBench, Page, health


@pytest.fixture
def bench() -> ConsoleBench:
    bench = ConsoleBench()
    bench.report(health("r1"), health("r2"))
    bench.run(0.05)
    return bench


def drive(
    bench: ConsoleBench, session: OperatorSession, page: Page, robots: list[str], linear: float = 0.5
) -> dict[str, Any]:
    return bench.say(session, page, "drive", behaviour="drive_bc", robots=robots, sticks={"linear": linear})


def hold(bench: ConsoleBench, session: OperatorSession, page: Page, seconds: float) -> None:
    for _ in range(round(seconds / 0.1)):
        assert drive(bench, session, page, ["r1"])["ok"]
        bench.run(0.1)


def zeros_only(bench: ConsoleBench) -> bool:
    return all(each.parameters == {"linear": 0.0} for each in bench.requests())


def test_a_held_stick_is_a_stream_of_20_hz_that_ends_in_zeros(bench: ConsoleBench) -> None:
    page, session = bench.join()
    hold(bench, session, page, 1.0)
    assert 18 <= len(bench.requests()) <= 24
    assert {each.robots for each in bench.requests()} == {("r1",)}
    bench.sent.clear()
    assert bench.say(session, page, "release")["ok"]
    bench.run(1.0)
    assert len(bench.requests()) == 3
    assert zeros_only(bench)


def test_a_page_that_falls_silent_lets_go(bench: ConsoleBench) -> None:
    page, session = bench.join()
    hold(bench, session, page, 0.5)
    bench.run(DEAD_MAN_S + 0.1)
    bench.sent.clear()
    bench.run(1.0)
    assert zeros_only(bench)
    assert len(bench.requests()) <= 2


def test_a_line_that_breaks_lets_go_at_once(bench: ConsoleBench) -> None:
    page, session = bench.join()
    hold(bench, session, page, 0.5)
    bench.sent.clear()
    bench.gateway.leave(session, page)
    bench.run(0.01)
    assert bench.requests()[0].parameters == {"linear": 0.0}


def test_another_window_of_the_same_operator_does_not_end_the_driving(bench: ConsoleBench) -> None:
    page, session = bench.join()
    other, same = bench.join()
    assert same is session
    hold(bench, session, page, 0.3)
    assert "another window" in drive(bench, session, other, ["r1"])["reason"]
    bench.gateway.leave(session, other)
    hold(bench, session, page, 0.3)
    assert not zeros_only(bench)


def test_a_robot_that_is_no_longer_driven_gets_zero(bench: ConsoleBench) -> None:
    page, session = bench.join()
    hold(bench, session, page, 0.3)
    bench.sent.clear()
    for _ in range(5):
        assert drive(bench, session, page, ["r2"])["ok"]
        bench.run(0.1)
    left = [each.parameters for each in bench.requests() if each.robots == ("r1",)]
    assert left == [{"linear": 0.0}] * 3
    assert [each.parameters for each in bench.requests() if each.robots == ("r2",)][-1] == {"linear": 0.5}


def test_a_robot_of_another_operator_is_not_driven(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.leases(r1="bert@lab")
    bench.run(0.05)
    assert drive(bench, session, page, ["r1"])["reason"] == "r1 is held by bert@lab"
    assert drive(bench, session, page, [])["reason"] == "r1 is held by bert@lab"
    assert drive(bench, session, page, ["r2"])["ok"]


def test_losing_a_robot_ends_the_driving(bench: ConsoleBench) -> None:
    page, session = bench.join()
    hold(bench, session, page, 0.2)
    bench.leases(r1=session.name)
    hold(bench, session, page, 0.2)
    bench.leases(r1="bert@lab")
    bench.run(0.2)
    bench.sent.clear()
    assert not drive(bench, session, page, ["r1"])["ok"]
    bench.run(1.0)
    assert zeros_only(bench)


def test_a_stop_blocks_the_stick_until_it_is_released(bench: ConsoleBench) -> None:
    page, session = bench.join()
    hold(bench, session, page, 0.3)
    assert bench.say(session, page, "stop", robots=["r2"])["ok"]
    hold(bench, session, page, 0.3)
    assert bench.say(session, page, "stop", robots=["@scouts"])["ok"]
    bench.run(0.2)
    bench.sent.clear()
    for _ in range(20):
        assert "release the dead-man switch" in drive(bench, session, page, ["r1"])["reason"]
        bench.run(0.1)
    assert bench.requests() == []
    bench.run(2.0)  # a page that stutters has let nothing go
    assert not drive(bench, session, page, ["r1"])["ok"]
    assert bench.say(session, page, "release")["ok"]
    assert drive(bench, session, page, ["r1"])["ok"]


@pytest.mark.parametrize("addressed", [(), ("r1",)])
def test_a_release_of_the_e_stop_does_not_start_robots_whose_stick_is_held(
    bench: ConsoleBench, addressed: tuple[str, ...]
) -> None:
    page, session = bench.join()
    hold(bench, session, page, 0.3)
    bench.bus.publish(KEYS.estop, EStop(id="e1", engaged=False, robots=addressed, source="ben"))
    bench.run(0.2)
    bench.sent.clear()
    assert "release the dead-man switch" in drive(bench, session, page, ["r1"])["reason"]
    bench.run(0.2)
    assert bench.requests() == []
    assert bench.say(session, page, "release")["ok"]
    assert drive(bench, session, page, ["r1"])["ok"]


def test_what_the_core_refuses_is_not_asked_for_again_and_again(bench: ConsoleBench) -> None:
    page, session = bench.join()
    hold(bench, session, page, 0.2)
    bench.status(bench.requests()[-1].id, "refused", behaviour="drive_bc", reason="its battery is low")
    bench.run(0.2)
    bench.sent.clear()
    assert drive(bench, session, page, ["r1"])["reason"] == "its battery is low: release the dead-man switch first"
    bench.run(0.2)
    assert bench.requests() == []


def test_only_what_lapses_by_itself_can_be_driven(bench: ConsoleBench) -> None:
    page, session = bench.join()
    answer = bench.say(session, page, "drive", behaviour="move_to_goal_bc", robots=["r1"], sticks={"gain": 1.0})
    assert "does not end by itself" in answer["reason"]
    bench.run(1.0)
    assert bench.requests() == []


def test_driving_is_refused_before_the_core_has_answered() -> None:
    bench = ConsoleBench(core=False)
    page, session = bench.join()
    assert "core" in drive(bench, session, page, ["r1"])["reason"]


def test_a_stream_is_one_line_of_the_log_and_a_refusal_one_frame(bench: ConsoleBench) -> None:
    page, session = bench.join()
    hold(bench, session, page, 1.0)
    for each in bench.requests():
        bench.status(each.id, "refused", behaviour="drive_bc", reason="r1 is held by bert")
    bench.run(0.1)
    assert page.log("request") == [f"{session.name}: Drive for r1"]
    assert page.log("refused") == ["Drive refused: r1 is held by bert"]
    assert len(page.all("request")) == 1


acts = st.lists(
    st.one_of(
        st.tuples(st.just("drive"), st.sampled_from([["r1"], ["r2"], ["@scouts"], []]), st.floats(-1.0, 1.0)),
        st.tuples(st.sampled_from(["release", "stop", "estop", "clear", "leave", "join"]), st.just([]), st.just(0.0)),
        st.tuples(st.just("wait"), st.just([]), st.floats(0.0, 0.6)),
    ),
    max_size=30,
)


@settings(max_examples=20, deadline=None)
@given(acts)
def test_whatever_happens_it_ends_in_zero(story: list[tuple[str, list[str], float]]) -> None:
    bench = ConsoleBench()
    bench.report(health("r1"), health("r2"))
    bench.run(0.05)
    page, session = bench.join()
    for act, robots, number in story:
        if act == "drive":
            drive(bench, session, page, robots, number)
        elif act == "wait":
            bench.run(number)
        elif act == "leave":
            bench.gateway.leave(session, page)
        elif act == "join":
            page, session = bench.join()
        else:
            bench.say(session, page, act)
    bench.run(DEAD_MAN_S + 0.25)
    last = {each.robots: each.parameters for each in bench.requests()}
    assert all(parameters == {"linear": 0.0} for parameters in last.values())
    bench.sent.clear()
    bench.run(2.0)
    assert bench.requests() == []
