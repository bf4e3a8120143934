"""What a page may send and what it gets: requests, stops, leases, sessions."""

from __future__ import annotations

from typing import Any

import pytest

from fullswarm.messages import (
    EStop,
    EStopReceipt,
    LeaseRequest,
    Needs,
    StopRequest,
)
from fullswarm.operator.console.gateway import KEPT_S, MOST_SESSIONS
from fullswarm.operator.console.stops import STOP_WATCH_S
from fullswarm.operator.view import SILENT_S
from fullswarm.reasons import Code, joined, reason
from tests.unit.console_bench import KEYS, ConsoleBench, Page, health


@pytest.fixture
def bench() -> ConsoleBench:
    return ConsoleBench()


# -------------------------------------------------------------------- requests
def test_a_request_is_sent_to_all_but_is_mine_only_to_one(bench: ConsoleBench) -> None:
    anna, session = bench.join()
    bert, _ = bench.join("session-2", "bert")
    asked = bench.say(session, anna, "request", behaviour="move_to_goal_bc", robots=["r1"], parameters={"goal": [1, 2]})
    assert asked["ok"]
    bench.run(0.01)
    sent = bench.requests()[0]
    assert (sent.id, sent.operator) == (asked["request_id"], "console anna@base sess")
    bench.status(sent.id, "running", robots=("r1",), running=("r1",))
    bench.run(0.01)
    assert anna.last("request")["mine"]
    assert not bert.last("request")["mine"]
    assert bert.last("request")["operator"] == "console anna@base sess"
    assert bert.log("request") == [
        "console anna@base sess: Move to goal for r1", "Move to goal runs on 1 of 1",
    ]  # fmt: skip
    assert [frame["entry"]["mine"] for frame in anna.all("log")] == [True, True]


def test_a_request_says_team_needs_and_roles_and_the_page_learns_what_came_of_them(bench: ConsoleBench) -> None:
    page, session = bench.join()
    asked = bench.say(
        session, page, "request", behaviour="move_to_goal_bc", robots=["@scouts"], team="swarm",
        needs={"speed_m_s": 0.3, "capabilities": ["lamp"]}, roles={"leader": ["r1"], "guard": ["+lamp"]},
    )  # fmt: skip
    bench.run(0.01)
    sent = bench.requests()[0]
    assert sent.team == "swarm"
    assert sent.needs == Needs(speed_m_s=0.3, capabilities=("lamp",))
    assert sent.roles == {"leader": ("r1",), "guard": ("+lamp",)}
    bench.status(asked["request_id"], "running", robots=("r1",), left_out=("r2",), roles={"r1": "leader"})
    bench.run(0.01)
    shown = page.last("request")
    assert (shown["left_out"], shown["roles"]) == (["r2"], {"r1": "leader"})


def test_a_refusal_reaches_log_and_page_with_its_reason(bench: ConsoleBench) -> None:
    page, session = bench.join()
    asked = bench.say(session, page, "request", behaviour="flockign")
    bench.run(0.01)
    bench.status(asked["request_id"], "refused", behaviour="flockign", reason="unknown behaviour")
    bench.run(0.01)
    assert page.last("request")["reason"] == "unknown behaviour"
    assert page.log("refused") == ["flockign refused: unknown behaviour"]
    count = len(bench.requests())
    bench.run(1.0)
    assert len(bench.requests()) == count


def test_a_refusal_advises_the_button_of_the_page_and_no_shell(bench: ConsoleBench) -> None:
    page, session = bench.join()
    asked = bench.say(session, page, "request", behaviour="flocking")
    bench.run(0.01)
    why = joined({"r1": reason(Code.ESTOP_LATCHED)})
    told = {"reason": why.text, "code": why.code, "refused_by": ("r1",)}
    bench.status(asked["request_id"], "refused", behaviour="flocking", **told)
    bench.run(0.01)
    assert "e-stop is latched; clear it with the button 'Clear the e-stop…'" in page.last("request")["reason"]
    assert "`" not in page.last("request")["reason"] + page.log("refused")[-1]


def test_authority_comes_with_what_was_accepted_and_not_before(bench: ConsoleBench) -> None:
    page, session = bench.join()
    refused = bench.say(session, page, "request", behaviour="x", robots=["r1"])
    bench.run(0.01)
    bench.status(refused["request_id"], "refused", reason="no")
    bench.run(2.0)
    assert not [each for each in bench.sent if isinstance(each, LeaseRequest)]
    good = bench.say(session, page, "request", behaviour="move_to_goal_bc", robots=["@scouts"])
    bench.run(0.01)
    bench.status(good["request_id"], "accepted", robots=("r1", "r2"))
    bench.run(0.01)
    held = next(each for each in bench.sent if isinstance(each, LeaseRequest))
    assert (held.robots, held.hold, held.take) == (("r1", "r2"), True, False)


def test_a_request_to_the_whole_swarm_takes_no_lease(bench: ConsoleBench) -> None:
    page, session = bench.join()
    asked = bench.say(session, page, "request", behaviour="move_to_goal_bc")
    bench.run(0.01)
    bench.status(asked["request_id"], "accepted", robots=("r1", "r2"))
    bench.run(2.0)
    assert not [each for each in bench.sent if isinstance(each, LeaseRequest)]


def test_the_log_keeps_the_newest_two_hundred(bench: ConsoleBench) -> None:
    for number in range(230):
        bench.status(f"id{number}", "refused", reason="no", behaviour=f"b{number}")
    bench.run(0.1)
    page, _ = bench.join()
    log = page.frames[0]["history"]["log"]
    assert len(log) == 200
    assert log[-1]["text"] == "b229 refused: no"


# -------------------------------------------------------------------- stops
def test_a_stop_needs_no_lease_and_shows_which_robots_stand(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.leases(r1="bert@lab")
    bench.report(health("r1", moving=True), health("r2", moving=False))
    bench.run(0.1)
    assert bench.say(session, page, "stop")["ok"]
    bench.run(0.15)
    assert any(isinstance(each, StopRequest) for each in bench.sent)
    assert page.last("stop") == {
        "t": "stop", "robots": [], "standing": ["r2"], "moving": ["r1"], "silent": [], "done": False,
    }  # fmt: skip
    bench.report(health("r1", moving=False), health("r2"))
    bench.run(0.15)
    assert page.last("stop")["done"]
    assert page.log("stop") == ["console anna@base sess stops the whole swarm"]


def test_a_stop_is_not_done_while_a_robot_is_silent(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.report(health("r1"), health("r2", moving=True))
    bench.run(SILENT_S)
    bench.report(health("r1"))
    bench.run(0.1)
    assert bench.say(session, page, "stop")["ok"]
    bench.run(0.15)
    told = page.last("stop")
    assert (told["standing"], told["moving"], told["silent"], told["done"]) == (["r1"], [], ["r2"], False)
    bench.report(health("r1"), health("r2"))
    bench.run(0.15)
    told = page.last("stop")
    assert (told["standing"], told["silent"], told["done"]) == (["r1", "r2"], [], True)


def test_a_robot_that_never_reported_is_silent_when_a_stop_names_it(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.report(health("r1"))
    bench.run(0.1)
    assert bench.say(session, page, "stop", robots=["r1", "r9"])["ok"]
    bench.run(0.15)
    told = page.last("stop")
    assert (told["standing"], told["silent"], told["done"]) == (["r1"], ["r9"], False)


def test_a_stop_of_no_robot_is_not_done(bench: ConsoleBench) -> None:
    page, session = bench.join()
    assert bench.say(session, page, "stop")["ok"]
    bench.run(0.15)
    told = page.last("stop")
    assert (told["standing"], told["moving"], told["silent"], told["done"]) == ([], [], [], False)


def test_a_robot_that_stays_silent_does_not_bring_an_old_stop_up_again(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.report(health("r1"), health("r2"))
    bench.run(SILENT_S + 0.1)
    bench.say(session, page, "stop")
    for _ in range(round(STOP_WATCH_S) + 1):
        bench.report(health("r1"))
        bench.run(1.0)
    count = len(page.all("stop"))
    bench.report(health("r1", moving=True), health("r2", moving=True))
    bench.run(1.0)
    assert len(page.all("stop")) == count


def test_an_estop_shows_each_receipt_and_the_silent_robots(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.report(health("r1"), health("r2"), health("r3"))
    bench.run(0.1)
    pressed = bench.say(session, page, "estop", reason="a child")
    assert pressed["ok"]
    bench.run(0.2)
    for robot, standing, rolled_m in (("r1", True, 0.05), ("r2", False, 0.0)):
        bench.bus.publish(
            KEYS.estop_receipt(robot),
            EStopReceipt(id=pressed["request_id"], robot=robot, engaged=True, standing=standing, rolled_m=rolled_m),
        )
    bench.run(0.2)
    frame = page.last("estop")
    assert (frame["id"], frame["engaged"], frame["done"]) == (pressed["request_id"], True, False)
    assert (frame["waiting"], frame["silent"]) == (["r2", "r3"], ["r3"])
    assert frame["operator"] == "console anna@base sess"
    assert frame["receipts"][0]["robot"] == "r1"
    assert frame["receipts"][0]["after_s"] == pytest.approx(0.2, abs=0.06)
    for robot in ("r2", "r3"):
        receipt = EStopReceipt(id=pressed["request_id"], robot=robot, engaged=True, standing=True)
        bench.bus.publish(KEYS.estop_receipt(robot), receipt)
    bench.run(1.0)
    assert page.last("estop")["done"]
    later, _ = bench.join("session-2")
    assert later.last("estop")["done"]


def test_an_estop_of_another_operator_is_shown_and_blocks_the_stick(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.report(health("r1"))
    bench.run(0.1)
    assert bench.say(session, page, "drive", behaviour="drive_bc", robots=["r1"], sticks={"linear": 1.0})["ok"]
    bench.bus.publish(KEYS.estop, EStop(id="e1", engaged=True, source="cli@other:1"))
    bench.run(0.1)
    assert page.last("estop")["operator"] == "cli@other:1"
    assert "release the dead-man" in bench.say(
        session, page, "drive", behaviour="drive_bc", robots=["r1"], sticks={"linear": 1.0}
    )["reason"]  # fmt: skip
    assert bench.say(session, page, "release")["ok"]
    assert bench.say(session, page, "drive", behaviour="drive_bc", robots=["r1"], sticks={"linear": 1.0})["ok"]


def test_what_robots_and_core_repeat_is_no_new_estop(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    bench.bus.publish(KEYS.estop, EStop(id="a", engaged=True, source="r1", robots=("r1",)))
    bench.bus.publish(KEYS.estop, EStop(id="b", engaged=True, source="core-12", robots=("r1",)))
    bench.bus.publish(KEYS.stop, StopRequest(id="c", source="r1", robots=("r1",)))
    bench.run(0.3)
    assert page.all("estop") == []
    assert page.all("stop") == []


def test_a_release_ends_the_pressing_of_every_desk(bench: ConsoleBench) -> None:
    anna, session = bench.join()
    bert, other = bench.join("session-2", "bert")
    bench.report(health("r1"))
    bench.run(0.1)
    bench.say(session, anna, "estop")
    bench.run(1.0)
    assert len([each for each in bench.sent if isinstance(each, EStop)]) >= 10
    bench.say(other, bert, "clear")
    bench.run(0.05)
    bench.sent.clear()
    bench.run(8.0)
    assert not [each for each in bench.sent if isinstance(each, EStop) and each.engaged]
    released = [each for each in bench.sent if isinstance(each, EStop)]
    assert 0 < len(released) <= 60
    bench.sent.clear()
    bench.run(5.0)
    assert bench.sent == []


# -------------------------------------------------------------------- leases
def test_leases_show_which_are_mine_and_a_loss_is_reported(bench: ConsoleBench) -> None:
    page, session = bench.join()
    assert bench.say(session, page, "lease", robots=["r1"], hold=True)["ok"]
    bench.leases(r1=session.name, r2="bert@lab")
    bench.run(0.1)
    assert {each["robot"]: each["mine"] for each in page.last("leases")["leases"]} == {"r1": True, "r2": False}
    bench.leases(r1="bert@lab", r2="bert@lab")
    bench.run(0.1)
    assert page.last("lost") == {"t": "lost", "robots": ["r1"], "by": "bert@lab"}
    assert page.log("lease")[-1] == f"bert@lab holds r1, taken from {session.name}"


def test_a_robot_of_another_operator_is_held_only_by_taking_it(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.leases(r1="bert@lab")
    bench.run(0.1)
    assert bench.say(session, page, "lease", robots=["@scouts"], hold=True)["reason"] == "r1 is held by bert@lab"
    bench.run(2.0)
    assert bench.sent == []
    assert bench.say(session, page, "lease", robots=["@scouts"], hold=True, take=True)["ok"]
    bench.run(0.01)
    taken = bench.sent[-1]
    assert isinstance(taken, LeaseRequest)
    assert taken.take
    assert bench.say(session, page, "lease", robots=["@nobody"], hold=True)["reason"].startswith("no group 'nobody'")


# -------------------------------------------------------------------- sessions
def test_a_reload_is_the_same_operator_with_the_same_robots(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.say(session, page, "lease", robots=["r1"], hold=True)
    bench.gateway.leave(session, page)
    bench.run(KEPT_S - 2.0)
    assert bench.join()[1] is session
    bench.run(30.0)
    held = [each for each in bench.sent if isinstance(each, LeaseRequest)]
    assert held
    assert all(each.hold for each in held)


def test_a_session_without_pages_releases_its_robots(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.say(session, page, "lease", robots=["r1"], hold=True)
    bench.gateway.leave(session, page)
    bench.run(KEPT_S + 2.0)
    last = bench.sent[-1]
    assert isinstance(last, LeaseRequest)
    assert not last.hold
    assert bench.join()[1] is not session


def test_desks_without_end_are_not_kept(bench: ConsoleBench) -> None:
    for number in range(3 * MOST_SESSIONS):
        page, session = bench.join(f"session-{number}")
        bench.gateway.leave(session, page)
    assert len(bench.gateway._sessions) <= MOST_SESSIONS


def test_read_only_answers_nothing_but_a_ping() -> None:
    bench = ConsoleBench(read_only=True)
    page, session = bench.join()
    assert page.frames[0]["read_only"]
    assert bench.say(session, page, "ping")["ok"]
    commands: dict[str, dict[str, Any]] = {
        "request": {"behaviour": "move_to_goal_bc"}, "stop": {}, "estop": {}, "clear": {}, "release": {},
        "drive": {"behaviour": "drive_bc", "sticks": {"linear": 1}}, "lease": {"hold": True},
    }  # fmt: skip
    for t, fields in commands.items():
        answer = bench.say(session, page, t, **fields)
        assert not answer["ok"]
        assert "--read-only" in answer["reason"]
    bench.run(2.0)
    assert bench.sent == []


def test_a_closed_console_releases_robots_and_sends_nothing_more(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.say(session, page, "drive", behaviour="drive_bc", robots=["r1"], sticks={"linear": 1.0})
    bench.gateway.close()
    bench.run(0.2)
    count = len(page.frames)
    bench.states("r1")
    bench.run(2.0)
    assert len(page.frames) == count
    assert bench.requests()[-1].parameters == {"linear": 0.0}


def test_a_driver_does_all_but_clear_an_estop_and_take_robots_over(bench: ConsoleBench) -> None:
    page = Page()
    session = bench.gateway.join("session-1", "ben", page, named=True, role="driver")
    bench.run(0.1)
    assert not page.frames[0]["read_only"]
    assert bench.say(session, page, "estop")["ok"]
    assert bench.say(session, page, "stop")["ok"]
    assert bench.say(session, page, "lease", robots=["r1"], hold=True)["ok"]
    sent = len(bench.sent)
    refused = {
        "clear": bench.say(session, page, "clear"),
        "lease": bench.say(session, page, "lease", robots=["r1"], hold=True, take=True),
        "request": bench.say(session, page, "request", behaviour="move_to_goal_bc", take=True),
        "mission": bench.say(session, page, "mission", op="resume", mission="m1", take=True),
        "startmission": bench.say(session, page, "startmission", plan={"name": "route", "tracks": []}, take=True),
    }
    assert {t: (each["ok"], "driver" in each["reason"]) for t, each in refused.items()} == dict.fromkeys(
        refused, (False, True)
    )
    assert len(bench.sent) == sent
