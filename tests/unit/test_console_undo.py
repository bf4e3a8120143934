"""Undo of an operator's newest request, and groups that consoles make."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest

from fullswarm.kept import MOST_KEPT
from fullswarm.messages import BehaviourRequest, StopRequest
from fullswarm.operator.console.sessions import OperatorSession
from fullswarm.operator.console.undo import Asked, Known, UndoPlan
from tests.unit.console_bench import ConsoleBench, Page


@pytest.fixture
def bench() -> ConsoleBench:
    return ConsoleBench()


def run_it(bench: ConsoleBench, session: OperatorSession, page: Page, behaviour: str, *robots: str, **more: Any) -> str:
    """Request a behaviour, and let the core accept it and write down its orders, as the real one does."""
    answer = bench.say(session, page, "request", behaviour=behaviour, robots=list(robots), **more)
    bench.run(0.01)
    request_id = str(answer["request_id"])
    bench.status(request_id, "running", behaviour=behaviour, robots=robots, running=robots)
    for robot in robots:
        bench.change(f"wanted/{robot}", {"request_id": request_id, "behaviour": behaviour, "parameters": {}})
    bench.run(0.2)
    return request_id


def test_it_says_what_it_would_do_and_asks_again_with_the_same_parameters(bench: ConsoleBench) -> None:
    page, session = bench.join()
    run_it(bench, session, page, "move_to_goal_bc", "r1", "r2", parameters={"goal": [1.0, 2.0]}, team="swarm")
    newest = run_it(bench, session, page, "flocking", "r1", "r2", "r3")
    frame = page.last("undo")
    assert frame["words"] == "Undo flocking: ask again for Move to goal for r1, r2; stop r3"
    count = len(bench.sent)
    assert bench.say(session, page, "undo", id=newest)["ok"]
    bench.run(0.05)
    sent = bench.sent[count:]
    again = next(each for each in sent if isinstance(each, BehaviourRequest) and each.behaviour == "move_to_goal_bc")
    assert (again.robots, again.parameters, again.team) == (("r1", "r2"), {"goal": [1.0, 2.0]}, "swarm")
    assert (again.operator, again.take) == (session.name, False), "leases count as for any request"
    assert [each.robots for each in sent if isinstance(each, StopRequest)][:1] == [("r3",)]
    assert page.last("undo")["words"] == ""
    assert not bench.say(session, page, "undo", id=newest)["ok"], "once"


def test_a_stop_of_its_robots_ends_it_and_one_of_others_does_not(bench: ConsoleBench) -> None:
    page, session = bench.join()
    other, bert = bench.join("session-2", "bert")
    newest = run_it(bench, session, page, "flocking", "r1")
    bench.say(bert, other, "stop", robots=["r9"])
    bench.run(0.2)
    assert page.last("undo")["id"] == newest
    bench.say(bert, other, "stop")
    bench.run(0.2)
    assert page.last("undo") == {"t": "undo", "id": "", "words": "", "refusal": ""}
    assert not bench.say(session, page, "undo", id=newest)["ok"]


def test_it_is_refused_when_another_request_came_since(bench: ConsoleBench) -> None:
    page, session = bench.join()
    newest = run_it(bench, session, page, "flocking", "r1", "r2")
    other, bert = bench.join("session-2", "bert")
    run_it(bench, bert, other, "move_to_goal_bc", "r2")
    assert page.last("undo")["refusal"] == "r2: another request came since"
    before = len(bench.requests())
    assert "another request" in bench.say(session, page, "undo", id=newest)["reason"]
    assert len(bench.requests()) == before


def test_a_request_that_was_refused_cannot_be_undone_and_a_reload_shows_the_same(bench: ConsoleBench) -> None:
    page, session = bench.join()
    newest = run_it(bench, session, page, "flocking", "r1")
    refused = bench.say(session, page, "request", behaviour="nonsense", robots=["r1"])["request_id"]
    bench.run(0.01)
    bench.status(refused, "refused", behaviour="nonsense", reason="unknown")
    bench.run(0.2)
    assert page.last("undo")["id"] == newest
    again, _ = bench.join()
    assert again.last("undo")["id"] == newest


def known(asked: Mapping[str, Asked], orders: Mapping[str, Mapping[str, Any]], formation: str = "each") -> Known:
    return Known(asked.get, lambda: orders, lambda _: {"formation": formation}, str)


def formation() -> dict[str, Asked]:
    places: list[float | list[float]] = [[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]]
    request = BehaviourRequest(id="a", behaviour="form", parameters={"targets": places}, robots=("@all",))
    return {"a": Asked(request, ("r1", "r2", "r3"))}


def test_some_robots_of_a_formation_get_their_own_places_back() -> None:
    orders: dict[str, dict[str, Any]] = {
        robot: {"request_id": "a", "behaviour": "form"} for robot in ("r1", "r2", "r3")
    }
    plan = UndoPlan(known(formation(), orders))
    plan.sent("b")
    plan.accepted("b", "go", ("r3", "r1"))
    (step,), refusal = plan.steps()
    assert refusal == ""
    assert (step.robots, step.parameters) == (("r1", "r3"), {"targets": [[0.0, 0.0], [2.0, 0.0]]})
    shared = UndoPlan(known(formation(), orders, "assigned"))
    shared.sent("b")
    shared.accepted("b", "go", ("r3", "r1"))
    assert shared.steps()[0] == []
    assert "start it again for all" in shared.steps()[1]
    shared.sent("c")
    shared.accepted("c", "go", ("r1", "r2", "r3"))
    (step,), _ = shared.steps()
    assert step.robots == ("@all",), "to all of them it goes as it went before"


def test_what_this_console_has_not_received_is_not_made_up() -> None:
    plan = UndoPlan(
        known({}, {"r1": {"request_id": "old", "behaviour": "x"}, "r2": {"request_id": "s", "behaviour": "stop"}})
    )
    plan.sent("b")
    plan.accepted("b", "go", ("r1",))
    assert "older than this console knows" in plan.steps()[1]
    plan.sent("c")
    plan.accepted("c", "go", ("r2",))
    (step,), _ = plan.steps()
    assert (step.behaviour, step.robots) == ("", ("r2",)), "it was stopped: it is stopped again"


# ------------------------------------------------------------------ groups
def test_a_group_goes_to_the_core_and_only_own_ones_can_be_changed(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.run(0.1)
    assert bench.say(session, page, "group", op="save", name="pair", robots=["r1", "r2"])["ok"]
    bench.run(0.05)
    (question,) = [each for each in bench.asked if each.op == "set"]
    assert (question.key, question.value, question.author) == ("group/pair", {"robots": ["r1", "r2"]}, session.name)
    bench.change("group/pair", {"robots": ["r1", "r2"]})
    bench.run(0.2)
    assert page.last("world")["own_groups"] == ["pair"]
    assert any("makes the group pair: r1, r2" in text for text in page.log("request"))
    fixed = bench.say(session, page, "group", op="save", name="scouts", robots=["r1"])
    assert "fleet file" in fixed["reason"]
    assert "fleet file" in bench.say(session, page, "group", op="delete", name="scouts")["reason"]
    assert bench.say(session, page, "group", op="delete", name="pair")["ok"]
    bench.run(0.05)
    assert [each.value for each in bench.asked if each.op == "set"][-1] is None
    assert not bench.say(session, page, "group", op="save", name="none", robots=[])["ok"]
    assert not bench.say(session, page, "group", op="save", name="two words", robots=["r1"])["ok"]


def test_places_and_requests_are_kept_by_the_core_and_shown_to_all(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.run(0.1)
    dock = {"kind": "point", "points": [[1.0, 2.0]]}
    sweep = {"behaviour": "area_sweep_bc", "parameters": {"lane_m": 0.5}, "robots": ["r1"]}
    assert bench.say(session, page, "keep", op="save", what="place", name="dock", value=dock)["ok"]
    assert bench.say(session, page, "keep", op="save", what="saved", name="sweep", value=sweep)["ok"]
    bench.run(0.05)
    asked = {each.key: (each.value, each.author) for each in bench.asked if each.op == "set"}
    assert asked == {"place/dock": (dock, session.name), "saved/sweep": (sweep, session.name)}
    bench.change("place/dock", dock)
    bench.change("saved/sweep", sweep)
    bench.run(0.2)
    assert page.last("world")["places"] == {"dock": dock}
    assert page.last("world")["saved"] == {"sweep": sweep}
    assert any("keeps the place dock" in text for text in page.log("request"))
    for what, value, words in (
        ("place", {"kind": "area", "points": [[0.0, 0.0]]}, "corners"),
        ("place", {"kind": "point", "points": [[0.0, 1e9]]}, "points"),
        ("place", None, "nothing"),
        ("saved", {"behaviour": ""}, "behaviour"),
    ):
        frame = {"op": "save", "what": what, "name": "x"} | ({} if value is None else {"value": value})
        assert words in bench.say(session, page, "keep", **frame)["reason"]
    assert "there is no x" in bench.say(session, page, "keep", op="delete", what="place", name="x")["reason"]
    assert not bench.say(session, page, "keep", op="save", what="place", name="a/b", value=dock)["ok"]
    assert bench.say(session, page, "keep", op="delete", what="place", name="dock")["ok"]
    for number in range(MOST_KEPT):
        bench.change(f"place/p{number}", dock)
    bench.change("place/dock", None)
    bench.run(0.1)
    full = bench.say(session, page, "keep", op="save", what="place", name="one-more", value=dock)
    assert str(MOST_KEPT) in full["reason"]
    assert bench.say(session, page, "keep", op="save", what="place", name="p1", value=dock)["ok"]


def test_an_observer_makes_no_group_and_undoes_nothing(bench: ConsoleBench) -> None:
    page = Page()
    session = bench.gateway.join("key-12345", "", page, role="observer")
    place = {"kind": "point", "points": [[1.0, 2.0]]}
    keep: dict[str, Any] = {"t": "keep", "op": "save", "what": "place", "name": "x", "value": place}
    for frame in ({"t": "group", "op": "save", "name": "x", "robots": ["r1"]}, {"t": "undo", "id": "a"}, keep):
        assert "observer" in bench.say(session, page, **frame)["reason"]
    driver = bench.gateway.join("key-67890", "", page, role="driver")
    assert "driver" in bench.say(driver, page, "group", op="save", name="x", robots=["r1"])["reason"]
    assert "driver" in bench.say(driver, page, **keep)["reason"]
