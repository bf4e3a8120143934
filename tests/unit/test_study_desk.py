"""A trial in the console: phases, probes, questionnaire, what is logged, and stops that pass in every phase."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from fullswarm.messages import EStop, StopRequest, WorldHold
from fullswarm.operator.console.study import MOTION, PAIRS, SUBSCALES, Lines, Probe, StartRequest
from tests.unit.console_bench import KEYS, Page, health
from tests.unit.study_lab import StudyBench, plan

RATINGS = dict.fromkeys(SUBSCALES, 50)


@pytest.fixture
def bench(tmp_path: Path) -> StudyBench:
    bench = StudyBench(tmp_path, plan())
    bench.beat()
    bench.report(health("r1", moving=True), health("r2"))
    bench.states("r1", "r2")
    bench.run(0.3)
    return bench


def live(bench: StudyBench, seconds: float) -> None:
    """Run with robots that report."""
    for _ in range(round(seconds / 0.5)):
        bench.report(health("r1", moving=True), health("r2"))
        bench.states("r1", "r2")
        bench.run(0.5)


def shown(page: Page) -> dict[str, Any]:
    return page.last("study")


def test_a_trial_from_the_briefing_to_the_questionnaire(bench: StudyBench) -> None:
    page, session = bench.join()
    assert shown(page)["phase"] == "briefing"
    assert bench.record()["state"] == "prepared"
    refused = bench.say(session, page, "request", behaviour="move_to_goal_bc", robots=["r1"])
    assert refused["reason"] == "the trial is not running"
    assert bench.say(session, page, "study", op="start")["ok"]
    assert shown(page)["left_s"] == 20
    assert bench.say(session, page, "request", behaviour="move_to_goal_bc", robots=["r1"])["ok"]
    live(bench, 5.5)
    probe = shown(page)["probe"]
    assert probe["question"] == "How many are stopped?"
    assert bench.say(session, page, "study", op="answer", probe="x", value="1")["reason"] == (
        "that question is not asked now"
    )
    assert bench.say(session, page, "study", op="answer", probe=probe["id"], value="one")["reason"]
    assert bench.say(session, page, "study", op="answer", probe=probe["id"], value="1")["ok"]
    assert shown(page)["probe"] is None
    live(bench, 15.0)
    assert shown(page)["phase"] == "tlx"
    assert [each for each in bench.sent if isinstance(each, StopRequest)], "the robots are stopped at the end"
    pairs = [list(pair) for pair in PAIRS]
    rate: dict[str, Any] = {"op": "tlx", "ratings": RATINGS, "pairs": pairs}
    assert "rate all six" in bench.say(session, page, "study", op="tlx")["reason"]
    assert (
        "in steps of 5" in bench.say(session, page, "study", **{**rate, "ratings": {**RATINGS, "effort": 51}})["reason"]
    )
    assert "fifteen pairs" in bench.say(session, page, "study", **{**rate, "pairs": pairs[:14]})["reason"]
    assert bench.say(session, page, "study", **rate)["ok"]
    assert (shown(page)["phase"], bench.record()["state"]) == ("done", "complete")
    asked, answer, tlx = bench.events("probe")[0], bench.events("answer")[0], bench.events("tlx")[0]
    assert (asked["truth"], answer["value"]) == ("1", "1")
    assert 0.0 < answer["response_s"] < 1.0
    assert tlx["weights"] == {
        "mental": 5, "physical": 4, "temporal": 3, "performance": 2, "effort": 1, "frustration": 0,
    }  # fmt: skip


def test_what_the_operator_does_is_logged_and_sticks_are_thinned(bench: StudyBench) -> None:
    page, session = bench.join()
    bench.say(session, page, "input", kind="select", robots=["r1"])
    bench.say(session, page, "study", op="start")
    bench.say(session, page, "input", kind="select", robots=["@scouts"])
    bench.say(session, page, "input", kind="view", detail="1,2 40")
    for _ in range(40):  # 20 Hz for 2 s
        bench.say(session, page, "drive", behaviour="drive_bc", robots=["r1"], sticks={"linear": 0.12345})
        bench.run(0.05)
    bench.say(session, page, "release")
    bench.say(session, page, "stop", robots=["r2"])
    kinds = [each["kind"] for each in bench.events()]
    assert kinds == ["begin", "select", "view", *["drive"] * 10, "release", "stop"], (
        "before the start nothing is logged"
    )
    assert bench.events("select")[0]["robots"] == ["r1", "r2"], "a group is stored as its robots"
    assert bench.events("drive")[0]["sticks"] == {"linear": 0.123}
    assert bench.events("release")[0]["robots"] == ["r1"]
    assert all(each["participant"] for each in bench.events("stop"))
    assert "anna" not in (bench.folder / "events.jsonl").read_text(), "no names"


@pytest.mark.parametrize("phase", ["briefing", "running", "frozen", "tlx", "done"])
def test_stop_and_estop_pass_in_every_phase(tmp_path: Path, phase: str) -> None:
    probe = Probe(name="n", at_s=1.0, question="?", truth="robots", freeze=True)
    bench = StudyBench(tmp_path, plan(probes=(probe,) if phase == "frozen" else (), can_freeze=True, duration_s=3.0))
    page, session = bench.join()
    if phase != "briefing":
        bench.say(session, page, "study", op="start")
    if phase == "frozen":
        bench.run(1.5)
        assert shown(page)["probe"]["freeze"]
    if phase in ("tlx", "done"):
        bench.run(3.5)
    if phase == "done":
        pairs = [list(pair) for pair in PAIRS]
        assert bench.say(session, page, "study", op="tlx", ratings=RATINGS, pairs=pairs)["ok"]
    bench.sent.clear()
    assert bench.say(session, page, "stop")["ok"]
    assert bench.say(session, page, "estop", reason="dog")["ok"]
    assert bench.say(session, page, "clear")["ok"]
    bench.run(0.1)
    assert any(isinstance(each, StopRequest) for each in bench.sent)
    assert [each.engaged for each in bench.sent if isinstance(each, EStop)][:1] == [True]


def test_a_stop_is_carried_out_although_the_log_cannot_be_written(bench: StudyBench) -> None:
    page, session = bench.join()
    bench.say(session, page, "study", op="start")
    (bench.folder / "events.jsonl").unlink()
    (bench.folder / "events.jsonl").mkdir()
    assert bench.say(session, page, "stop")["ok"]
    bench.run(0.05)
    assert any(isinstance(each, StopRequest) for each in bench.sent)


def test_a_freeze_holds_the_world_and_the_time_until_it_is_answered(tmp_path: Path) -> None:
    probe = Probe(name="n", at_s=2.0, question="?", truth="stopped", freeze=True)
    bench = StudyBench(tmp_path, plan(probes=(probe,), can_freeze=True))
    holds: list[WorldHold] = []
    bench.bus.subscribe(KEYS.world_hold, WorldHold, holds.append)
    page, session = bench.join()
    bench.say(session, page, "study", op="start")
    bench.run(6.0)
    assert shown(page)["probe"]["freeze"]
    assert len(holds) >= 7, "repeated, or the world goes on by itself"
    assert bench.say(session, page, "request", behaviour="move_to_goal_bc")["reason"] == "answer the question first"
    bench.say(session, page, "study", op="answer", probe="n@2", value="0")
    bench.run(0.2)
    assert not holds[-1].held
    assert shown(page)["left_s"] in (17, 18), "the trial's time stood still"
    assert bench.events("answer")[0]["response_s"] == pytest.approx(4.0, abs=0.1)
    times = [json.loads(line)["at_s"] for line in (tmp_path / MOTION).read_text().splitlines()]
    assert times == sorted(times)
    bench.run(1.0)
    assert not holds[-1].held


def test_with_real_robots_a_freeze_is_a_question_in_real_time(tmp_path: Path) -> None:
    probe = Probe(name="n", at_s=1.0, question="?", truth="robots", freeze=True, timeout_s=2.0)
    bench = StudyBench(tmp_path, plan(probes=(probe,), can_freeze=False))
    holds: list[WorldHold] = []
    bench.bus.subscribe(KEYS.world_hold, WorldHold, holds.append)
    page, session = bench.join()
    bench.say(session, page, "study", op="start")
    bench.run(1.5)
    assert shown(page)["probe"]["freeze"] is False
    bench.run(2.0)
    assert shown(page)["probe"] is None, "not answered in time"
    answer = bench.events("answer")[0]
    assert (answer["value"], answer["why"]) == ("", "timeout")
    assert holds == []


def test_the_page_of_a_trial_gets_nothing_of_the_condition_but_its_label(tmp_path: Path) -> None:
    bench = StudyBench(tmp_path, plan(behaviours=("move_to_goal_bc",), request=StartRequest(behaviour="drive_bc")))
    page, session = bench.join()
    assert set(page.last("hello")["behaviours"]) == {"move_to_goal_bc"}
    bench.say(session, page, "study", op="start")
    bench.run(0.2)
    assert [each.behaviour for each in bench.requests()][:1] == ["drive_bc"]
    refused = bench.say(session, page, "request", behaviour="flocking_bc")
    assert refused["reason"] == "flocking_bc is not offered in this trial"
    assert shown(page)["title"] == "P01 · condition B · 1 of 2"


def test_another_page_watches_without_questions_until_the_participants_page_is_gone(bench: StudyBench) -> None:
    page, session = bench.join()
    bench.say(session, page, "study", op="start")
    watcher, other = bench.join("session-2", "bert")
    assert not shown(watcher)["mine"]
    bench.say(other, watcher, "stop")
    assert bench.events("stop")[0]["participant"] is False
    bench.gateway.leave(session, page)
    live(bench, 1.5)
    assert shown(watcher)["mine"]


def test_a_trial_that_ends_early_is_interrupted_and_a_second_console_does_not_go_on_with_it(tmp_path: Path) -> None:
    bench = StudyBench(tmp_path, plan())
    page, session = bench.join()
    bench.say(session, page, "study", op="start")
    successor = StudyBench(tmp_path, plan())
    assert successor.record()["state"] == "interrupted"
    late, _ = successor.join()
    assert shown(late)["phase"] == "done"
    bench.gateway.close()
    assert "the console ended" in bench.record()["reason"]


def test_a_trial_begins_when_core_and_robots_report(tmp_path: Path) -> None:
    bench = StudyBench(tmp_path, plan(robots=2))
    bench.report(health("r1"))
    bench.run(0.1)
    page, session = bench.join()
    assert "1 of 2 robots" in bench.say(session, page, "study", op="start")["reason"]
    assert bench.record()["state"] == "prepared"
    bench.report(health("r1"), health("r2"))
    bench.run(0.1)
    assert bench.say(session, page, "study", op="start")["ok"]


def test_the_log_is_bounded(tmp_path: Path) -> None:
    lines = Lines(tmp_path / "x.jsonl", most_bytes=100)
    assert [lines.add({"n": number}) for number in range(30)].count(True) == 12
    assert lines.left_out == 18
    assert (tmp_path / "x.jsonl").stat().st_size <= 100


def test_a_console_without_a_study_says_so(tmp_path: Path) -> None:
    from tests.unit.console_bench import ConsoleBench

    bench = ConsoleBench()
    page, session = bench.join()
    assert bench.say(session, page, "study", op="start")["reason"] == "this console is not in a study"
    assert not page.all("study")
