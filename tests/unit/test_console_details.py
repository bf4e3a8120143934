"""The details of one robot: only for pages whose pane is open, bounded, and of what was received."""

from __future__ import annotations

import itertools
from typing import Any

import pytest

from fullswarm.messages import PoseSource
from fullswarm.operator.console.detail import BATTERY_EVERY_S, DETAIL_HZ, MESSAGES, MOTION_S
from tests.unit.console_bench import ConsoleBench, health


@pytest.fixture
def bench() -> ConsoleBench:
    return ConsoleBench()


def tell(bench: ConsoleBench, **fields: Any) -> None:
    bench.states("r1")
    bench.report(health("r1", **fields))
    bench.run(0.5)


def test_only_a_page_with_an_open_pane_gets_details_and_of_one_robot(bench: ConsoleBench) -> None:
    open_page, session = bench.join()
    other, _ = bench.join("session-2", "bert")
    tell(bench)
    assert open_page.all("detail") == []
    assert bench.say(session, open_page, "inspect", robot="r1")["ok"]
    tell(bench)
    assert {frame["robot"] for frame in open_page.all("detail")} == {"r1"}
    assert other.all("detail") == []
    bench.say(session, open_page, "inspect", robot="r2")  # in its place
    count = len(open_page.all("detail"))
    tell(bench)
    assert len(open_page.all("detail")) == count, "r2 has not been received"
    bench.say(session, open_page, "inspect", robot="r1")
    bench.say(session, open_page, "inspect", robot="")
    tell(bench)
    assert len(open_page.all("detail")) == count
    assert session.inspected == {}


def test_a_page_that_leaves_is_forgotten(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.say(session, page, "inspect", robot="r1")
    bench.gateway.leave(session, page)
    assert session.inspected == {}
    assert not bench.say(session, page, "inspect", robot="r1" * 40)["ok"], "not an id"


def test_a_screen_that_may_only_look_may_look_closely() -> None:
    bench = ConsoleBench(read_only=True)
    page, session = bench.join()
    assert bench.say(session, page, "inspect", robot="r1")["ok"]


def test_speed_and_command_of_the_last_minute_come_with_the_first_frame(bench: ConsoleBench) -> None:
    page, session = bench.join()
    for k in range(int(MOTION_S * DETAIL_HZ) + 20):
        tell(bench, command_m_s=0.001 * k, battery=0.5)
    bench.say(session, page, "inspect", robot="r1")
    tell(bench, command_m_s=0.3, command_rad_s=-0.2, battery=0.5)
    frame = page.last("detail")
    assert len(frame["motion"]) == MOTION_S * DETAIL_HZ
    ago_s, speed, command = frame["motion"][-1]
    assert -1.0 <= ago_s <= 0.0
    assert (speed, command, frame["command_rad_s"]) == (1.0, 0.3, -0.2)  # the bench's states are all 1.0
    assert -MOTION_S - 1.0 <= frame["motion"][0][0] <= -MOTION_S + 1.0
    times = [row[0] for row in frame["battery"]]
    assert all(b - a >= BATTERY_EVERY_S - 0.2 for a, b in itertools.pairwise(times))
    assert len(times) >= 6


def test_what_the_driver_says_is_kept_when_it_changes_and_bounded(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.say(session, page, "inspect", robot="r1")
    for k in range(MESSAGES + 5):
        tell(bench, fault=f"cliff {k}", lifecycle="READY")
        tell(bench, fault=f"cliff {k}", lifecycle="READY")
    texts = [each["text"] for each in page.last("detail")["messages"]]
    assert texts[0] == f"driver: cliff {MESSAGES + 4}", "the newest first"
    assert len(texts) == MESSAGES
    assert len(set(texts)) == len(texts)


def test_a_pose_is_shown_with_its_sources_and_how_far_they_are_off(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.say(session, page, "inspect", robot="r1")
    sources = (PoseSource(sensor="ceiling", used=True, residual_m=0.01), PoseSource(sensor="gnss", refused="too far"))
    tell(bench, pose_source="fixes", pose_sources=sources, position_sigma_m=0.02)
    pose = page.last("detail")["pose"]
    assert (pose["source"], pose["sigma_m"]) == ("fixes", 0.02)
    assert [each["sensor"] for each in pose["sources"]] == ["ceiling", "gnss"]
    assert pose["sources"][0]["residual_m"] == 0.01
    assert pose["sources"][1]["refused"] == "too far"


def test_its_last_requests_are_listed_with_their_outcome_there(bench: ConsoleBench) -> None:
    page, session = bench.join()
    bench.say(session, page, "inspect", robot="r1")
    first = bench.say(session, page, "request", behaviour="move_to_goal_bc", robots=["r1", "r2"])["request_id"]
    bench.run(0.01)
    bench.status(first, "running", robots=("r1", "r2"), running=("r1",), refused_by=("r2",), reason="no", code="given")
    second = bench.say(session, page, "request", behaviour="flocking", robots=["r2"])["request_id"]
    bench.run(0.01)
    bench.status(second, "running", behaviour="flocking", robots=("r2",), running=("r2",))
    tell(bench)
    (only,) = page.last("detail")["requests"]
    assert (only["behaviour"], only["outcome"], only["reason"]) == ("move_to_goal_bc", "runs", "")
    assert only["operator"] == session.name
    third = bench.say(session, page, "request", behaviour="flocking", robots=["r1"])["request_id"]
    bench.run(0.01)
    bench.status(third, "refused", behaviour="flocking", robots=("r1",), refused_by=("r1",), reason="x", code="cliff")
    tell(bench)
    newest = page.last("detail")["requests"][0]
    assert (newest["outcome"], newest["code"]) == ("refused", "cliff")
