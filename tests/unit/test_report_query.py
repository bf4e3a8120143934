"""Who has just connected asks, and gets at once what is otherwise published seldom."""

from __future__ import annotations

import contextlib

from fullswarm.bus import LocalBus
from fullswarm.bus.report_query import LEAST_S, ReportsOnQuery
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import ChargingStatus, HealthReport, KnownRobots, Leases, ReportQuery, RobotProfiles, Summary
from fullswarm.operator.view import FleetView
from fullswarm.runtime import Runtime


def test_a_flood_of_queries_gets_few_answers() -> None:
    runtime, keys = Runtime(SimClock()), Keys()
    bus = LocalBus(runtime.mailbox)
    answers: list[float] = []
    answering = ReportsOnQuery(bus, keys, runtime, lambda: answers.append(runtime.now_s()))
    runtime.every(0.001, lambda: bus.publish(keys.report_query, ReportQuery(source="flood")), first_s=0.0)
    runtime.run(1.0)
    assert 9 <= len(answers) <= 1.0 / LEAST_S + 1
    assert answers[0] == 0.0
    answering.close()
    runtime.run(1.0)
    assert len(answers) <= 1.0 / LEAST_S + 1


def test_a_swarm_tells_all_of_itself_within_a_tenth_of_a_second() -> None:
    config = SwarmConfig.model_validate(
        {
            "robot": [{"id": f"r{number}"} for number in (1, 2, 3)],
            "world": {"engine": "kinematic"},
            "dock": [{"id": "d1", "pose": [0.3, 5.0, 3.14159]}],
        }
    )
    with contextlib.closing(Lockstep(config)) as swarm:
        swarm.run(7.3)  # away from the usual moments of publishing
        keys, heard = Keys(config.swarm), set[str]()
        for key, kind in (
            (keys.health(), HealthReport), (keys.profile(), RobotProfiles), (keys.leases, Leases),
            (keys.charging_status, ChargingStatus), (keys.summary(), Summary), (keys.known_robots, KnownRobots),
        ):  # fmt: skip
            swarm.bus.subscribe(key, kind, lambda message: heard.add(type(message).__name__))
        swarm.run(0.03)
        before = set(heard)
        view = FleetView(swarm.bus, keys, swarm.runtime)
        assert not view.complete()
        swarm.run(0.1)
        assert heard >= {"HealthReport", "RobotProfiles", "Leases", "ChargingStatus", "Summary", "KnownRobots"}, before
        assert view.complete()
        assert view.counted()
        assert {"core", "centralised"} <= {node.node for node in view.snapshot().nodes}
        seen = view.snapshot()
        assert [row.robot for row in seen.robots if row.profile is not None] == ["r1", "r2", "r3"]
        assert [dock.dock for dock in seen.docks] == ["d1"]
        view.close()
