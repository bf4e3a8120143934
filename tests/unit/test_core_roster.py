from __future__ import annotations

import pytest

from fullswarm.bus import LocalBus
from fullswarm.clock import SimClock
from fullswarm.core.roster import REPORT_S, SILENCE_S, Roster
from fullswarm.keys import Keys
from fullswarm.messages import HealthReport, KnownRobots, ReportQuery, RobotHealth
from fullswarm.operator.view import FleetView
from fullswarm.runtime import Runtime

KEYS = Keys("lab")


class Bench:
    """A roster of r1 and r2, and what it says of them."""

    def __init__(self) -> None:
        self.runtime = Runtime(SimClock(10.0))
        self.bus = LocalBus(self.runtime.mailbox)
        self.said: list[KnownRobots] = []
        self.bus.subscribe(KEYS.known_robots, KnownRobots, self.said.append)
        self.roster = Roster(self.bus, KEYS, self.runtime, ("r1", "r2"), process="core-1")

    def report(self, *robots: str) -> None:
        healths = tuple(
            RobotHealth(robot=each, driver="d", make="m", model="m", firmware="1", lifecycle="READY") for each in robots
        )
        message = HealthReport(host=robots[0], process="p", version="1", robots=healths, stamp_s=self.runtime.now_s())
        self.bus.publish(KEYS.health(robots[0]), message)

    def lists(self) -> tuple[tuple[str, ...], tuple[str, ...]]:
        return self.said[-1].present, self.said[-1].absent


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_the_core_tells_which_robots_report_when_that_changes(bench: Bench) -> None:
    bench.runtime.run(0.2)
    assert bench.lists() == ((), ("r1", "r2"))
    bench.report("r2")
    bench.report("r7")  # not of the fleet file
    bench.runtime.run(0.2)
    assert bench.lists() == (("r2", "r7"), ("r1",))
    bench.runtime.run(SILENCE_S)
    assert bench.lists() == ((), ("r1", "r2", "r7"))
    assert [each.core for each in bench.said] == ["core-1"] * len(bench.said)
    assert [each.sequence for each in bench.said] == list(range(1, len(bench.said) + 1))


def test_it_tells_so_each_second_and_when_asked(bench: Bench) -> None:
    bench.runtime.run(5.0)
    assert 4 <= len(bench.said) <= 5.0 / REPORT_S + 1
    count = len(bench.said)
    bench.bus.publish(KEYS.report_query, ReportQuery(source="operator"))
    bench.runtime.run(0.0)
    assert len(bench.said) == count + 1
    bench.roster.close()
    bench.bus.publish(KEYS.report_query, ReportQuery(source="operator"))
    bench.runtime.run(5.0)
    assert len(bench.said) == count + 1


def test_who_looks_later_sees_which_robots_are_missing(bench: Bench) -> None:
    bench.report("r1")
    bench.runtime.run(2.0 * SILENCE_S)
    view = FleetView(bench.bus, KEYS, bench.runtime)
    assert not view.counted()
    bench.report("r2")
    bench.runtime.run(0.3)
    assert view.counted()
    assert view.snapshot().missing == ("r1",)  # it reported before this view was there
    assert not view.complete()  # nothing but its health is known of r2
    bench.roster.close()
    bench.runtime.run(5.0)
    assert view.snapshot().missing == ()  # no core says so any more


def test_a_view_waits_for_a_robot_that_the_core_receives(bench: Bench) -> None:
    bench.roster.close()
    view = FleetView(bench.bus, KEYS, bench.runtime)
    bench.bus.publish(KEYS.known_robots, KnownRobots(present=("r1",), absent=()))
    bench.runtime.run(0.05)
    assert view.robots() == ()
    assert not view.complete()
    assert view.snapshot().missing == ()  # its report is still to come
    bench.runtime.run(1.0)
    assert view.snapshot().missing == ("r1",)  # what it sends reaches the core, and not this view
    assert not view.complete()
