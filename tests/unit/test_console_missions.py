"""Missions in the console: what pages get of them, and what a page may do to them."""

from __future__ import annotations

from typing import Any

import msgspec
import pytest

from fullswarm.messages import MissionReply, MissionRequest, MissionStatus, StepStatus, TrackStatus
from fullswarm.operator.console.missions import MOST, SHOWN_S
from fullswarm.operator.console.sessions import MISSION_S
from tests.unit.console_bench import KEYS, ConsoleBench


@pytest.fixture
def bench() -> ConsoleBench:
    return ConsoleBench()


def publish(bench: ConsoleBench, phase: Any, sequence: int, mission: str = "m1", **fields: Any) -> None:
    step = StepStatus(name="out", behaviour="flocking_bc", phase="running", robots=("r1",), confirm="Clear?")
    status = MissionStatus(
        mission=mission, name="tour", phase=phase, operator="anna", core="core-1", sequence=sequence,
        tracks=(TrackStatus(name="main", steps=(step,)),), **fields,
    )  # fmt: skip
    bench.bus.publish(KEYS.mission_status, status)
    bench.run(0.11)


def asked(bench: ConsoleBench) -> list[MissionRequest]:
    found: list[MissionRequest] = []
    bench.bus.subscribe(KEYS.mission_request, MissionRequest, found.append)
    return found


def test_each_page_gets_the_newest_state_and_a_line_per_phase(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    publish(bench, "running", 1)
    publish(bench, "running", 2)
    publish(bench, "paused", 4, reason="stopped by bob")
    publish(bench, "running", 3)  # it was late
    shown = page.last("missions")["missions"]
    assert [(each["name"], each["phase"], each["reason"]) for each in shown] == [("tour", "paused", "stopped by bob")]
    assert shown[0]["tracks"][0]["steps"][0]["confirm"] == "Clear?"
    assert page.log("mission") == ["anna starts mission tour", "mission tour is paused: stopped by bob"]
    late, _ = bench.join("session-2", "bert")
    assert late.last("missions")["missions"] == shown


def test_a_mission_that_is_not_reported_any_more_says_so_and_one_that_has_ended_goes(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    publish(bench, "running", 1)
    bench.run(SHOWN_S + 2.0)
    late, _ = bench.join("session-2", "bert")
    assert late.last("missions")["missions"][0]["silent"]
    publish(bench, "done", 2)
    assert not page.last("missions")["missions"][0]["silent"]
    bench.run(SHOWN_S + 2.0)
    assert page.last("missions")["missions"] == []
    for number in range(MOST + 3):
        publish(bench, "running", number, mission=f"n{number}")
    assert len(page.last("missions")["missions"]) == MOST


def test_a_page_controls_a_mission_and_learns_why_not(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bert, _ = bench.join("session-2", "bert")
    sent = asked(bench)
    answer = bench.say(session, page, "mission", op="confirm", mission="m1", track="main", step="out", take=True)
    bench.run(0.5)
    assert len({each.id for each in sent}) == 1
    assert len(sent) > 1, "sent until it is answered"
    first = sent[0]
    assert (first.op, first.mission, first.track, first.step, first.take) == ("confirm", "m1", "main", "out", True)
    assert (first.id, first.operator) == (answer["request_id"], "console anna@base sess")
    assert first.clock, "a stop must be able to overtake it"
    reply = MissionReply(id=first.id, ok=False, reason="r1 is held by bob", code="held")
    bench.bus.publish(KEYS.mission_reply(first.id), reply)
    bench.run(0.1)
    told = page.last("mission")
    assert (told["ok"], told["reason"], told["code"], told["op"]) == (False, "r1 is held by bob", "held", "confirm")
    assert bert.all("mission") == []
    count = len(sent)
    bench.run(1.0)
    assert len(sent) == count


STEPS: list[dict[str, object]] = [
    {
        "name": f"point {number}", "behaviour": "move_to_goal_bc", "robots": ["r1", "r2"],
        "parameters": {"goal": [float(number), 2.0]}, "done": {"arrived": "all"},
    }
    for number in (1, 2)
]  # fmt: skip
PLAN = {"name": "route-1", "tracks": [{"name": "main", "steps": STEPS}]}


def test_a_page_starts_a_mission_and_learns_why_not(bench: ConsoleBench) -> None:
    page, session = bench.join()
    sent = asked(bench)
    answer = bench.say(session, page, "startmission", plan=PLAN, take=True)
    bench.run(0.1)
    first = sent[0]
    assert (first.op, first.mission, first.take, first.id) == ("start", "", True, answer["request_id"])
    assert first.plan is not None
    assert msgspec.json.decode(msgspec.json.encode(first.plan)) == PLAN
    reply = MissionReply(id=first.id, ok=False, reason="there is no robot 'r2'", code="unknown-robot")
    bench.bus.publish(KEYS.mission_reply(first.id), reply)
    bench.run(0.1)
    told = page.last("mission")
    assert (told["op"], told["mission"], told["ok"], told["reason"]) == (
        "start", "route-1", False, "there is no robot 'r2'",
    )  # fmt: skip


def test_a_mission_that_no_core_answers_is_not_started_by_a_later_one(bench: ConsoleBench) -> None:
    page, session = bench.join()
    sent = asked(bench)
    bench.say(session, page, "startmission", plan=PLAN)
    bench.run(MISSION_S + 0.1)
    assert not page.last("mission")["ok"]
    count = len(sent)
    bench.run(5.0)
    assert len(sent) == count


def changed(**step: object) -> dict[str, object]:
    """Return the plan with one step, which has these fields."""
    return {"name": "route-1", "tracks": [{"name": "main", "steps": [STEPS[0] | step]}]}


@pytest.mark.parametrize(
    "plan",
    [
        None, {}, {"name": "n" * 65, "tracks": []}, changed(unknown=1), changed(fail_after_s=-1.0),
        changed(parameters={"gain": 2**60}), changed(done={"arrived": "some"}),
    ],
)  # fmt: skip
def test_what_is_no_mission_is_refused(bench: ConsoleBench, plan: object) -> None:
    page, session = bench.join()
    sent = asked(bench)
    assert not bench.say(session, page, "startmission", plan=plan)["ok"]
    bench.run(1.0)
    assert sent == []


def test_a_request_that_no_core_answers_is_given_up(bench: ConsoleBench) -> None:
    page, session = bench.join()
    sent = asked(bench)
    bench.say(session, page, "mission", op="resume", mission="m1")
    bench.run(MISSION_S + 0.1)
    assert not page.last("mission")["ok"]
    count = len(sent)
    bench.run(5.0)
    assert len(sent) == count, "it must not resume the mission of a core that is started later"


@pytest.mark.parametrize("frame", [{"op": "start", "mission": "m1"}, {"op": "abort", "mission": ""}, {"op": "abort"}])
def test_what_is_no_control_of_a_mission_is_refused(bench: ConsoleBench, frame: dict[str, str]) -> None:
    page, session = bench.join()
    assert not bench.say(session, page, "mission", **frame)["ok"]


def test_a_console_for_looking_controls_nothing() -> None:
    bench = ConsoleBench(read_only=True)
    page, session = bench.join()
    sent = asked(bench)
    assert not bench.say(session, page, "mission", op="abort", mission="m1")["ok"]
    assert not bench.say(session, page, "startmission", plan=PLAN)["ok"]
    bench.run(1.0)
    assert sent == []
