"""Range scans in the console: robots are asked only for what pages look at, and pages get what they can draw."""

from __future__ import annotations

import base64
import math

import msgspec
import numpy as np
import pytest

from fullswarm.maps.scans import pack
from fullswarm.messages import RangeQuery, RangeReport, SensorScan
from fullswarm.operator.console.scans import MOST_ROBOTS, PAGE_RAYS
from tests.unit.console_bench import KEYS, ConsoleBench

SCAN = SensorScan(
    sensor="front", mount=(0.1, 0.0, 0.0), robot_at=(1.0, 2.0, 0.5 * math.pi), first_rad=-1.0, step_rad=0.1,
    distances=pack(np.array([1.0, math.inf, math.nan])), max_m=4.0, stamp_s=9.9,
)  # fmt: skip


def report(bench: ConsoleBench, robot: str, **changed: object) -> None:
    scan = msgspec.structs.replace(SCAN, **changed)
    bench.bus.publish(KEYS.range_report(robot), RangeReport(robot=robot, scans=(scan,), stamp_s=10.0))
    bench.run(0.1)


def asked(bench: ConsoleBench) -> list[RangeQuery]:
    found: list[RangeQuery] = []
    bench.bus.subscribe(KEYS.range_query, RangeQuery, found.append)
    return found


def test_only_the_pages_that_look_at_a_robot_get_its_scans() -> None:
    bench = ConsoleBench()
    looking, session = bench.join()
    other, others = bench.join("session-2", "bert")
    assert bench.say(session, looking, "scans", robots=["r1"])["ok"]
    assert bench.say(others, other, "scans", robots=["r2"])["ok"]
    report(bench, "r1")
    report(bench, "r3")
    frame = looking.last("scans")
    assert (frame["robot"], len(looking.all("scans")), other.all("scans")) == ("r1", 1, [])
    (scan,) = frame["scans"]
    assert scan["at"] == pytest.approx([1.0, 2.1, 0.5 * math.pi], abs=1e-4)
    assert (scan["first_rad"], scan["step_rad"], scan["max_m"]) == (-1.0, 0.1, 4.0)
    assert scan["age_s"] == pytest.approx(0.1)
    assert np.frombuffer(base64.b64decode(scan["mm"]), "<u2").tolist() == [1000, 65534, 65535]


def test_robots_are_asked_while_a_page_looks_and_no_longer() -> None:
    bench = ConsoleBench()
    queries = asked(bench)
    bench.run(2.0)
    page, session = bench.join()
    bench.run(2.0)
    assert queries == []
    bench.say(session, page, "scans", robots=["r2", "r1"])
    bench.run(2.5)
    assert [each.robots for each in queries] == [("r1", "r2")] * 3
    bench.gateway.leave(session, page)
    bench.run(3.0)
    assert [each.robots for each in queries[3:]] == [("-",)]
    bench.gateway.close()


def test_who_only_looks_on_may_look_and_a_study_shows_none() -> None:
    bench = ConsoleBench(read_only=True)
    page, session = bench.join()
    assert bench.say(session, page, "scans", robots=["r1"])["ok"]


@pytest.mark.parametrize("robots", [["r1"] * 5, ["a/b"], [""], "r1", [1]])
def test_a_frame_that_asks_for_too_much_is_refused(robots: object) -> None:
    bench = ConsoleBench()
    queries = asked(bench)
    page, session = bench.join()
    assert not bench.say(session, page, "scans", robots=robots)["ok"]
    bench.run(0.1)
    assert queries == []


def test_many_pages_ask_for_few_robots() -> None:
    bench = ConsoleBench()
    queries = asked(bench)
    for k in range(20):
        page, session = bench.join(f"session-{k}")
        bench.say(session, page, "scans", robots=["popular", *(f"r{k}_{n}" for n in range(3))])
    bench.run(1.5)
    assert len(queries[-1].robots) == MOST_ROBOTS
    assert "popular" in queries[-1].robots


def test_old_scans_and_those_from_nowhere_are_left_out_and_long_ones_are_thinned() -> None:
    bench = ConsoleBench()
    page, session = bench.join()
    bench.say(session, page, "scans", robots=["r1"])
    report(bench, "r1", stamp_s=8.0)
    report(bench, "r1", robot_at=None)
    assert [each["scans"] for each in page.all("scans")] == [[], []]
    report(bench, "r1", distances=pack(np.linspace(1.0, 2.0, 2048)), step_rad=0.003)
    (scan,) = page.last("scans")["scans"]
    assert 300 < len(base64.b64decode(scan["mm"])) // 2 <= PAGE_RAYS
