from __future__ import annotations

from dataclasses import replace

import pytest

from fullswarm.bringup import preflight
from fullswarm.bringup.checks import Check
from fullswarm.bringup.preflight import PINGS, BusState
from fullswarm.messages import Ping, RobotHealth
from fullswarm.operator.session import Session
from fullswarm.operator.view import FleetView, RobotRow
from fullswarm.reasons import Code
from tests.unit.agent_bench import Bench

HEALTH = RobotHealth(robot="r1", driver="sim://r1", make="iRobot", model="Create 2", firmware="", lifecycle="READY")
ROW = RobotRow("r1", 0.1, 0.0, 0.0, 0.0, 0.0, HEALTH, version="1.2.3")


def listen(bench: Bench, robot: str = "r1") -> BusState:
    line = Session(bench.bus, bench.keys, bench.runtime, "tcp/hub", "ann")
    view = FleetView(bench.bus, bench.keys, bench.runtime, (robot,))
    return preflight.listen(line, view, robot)


def judged(heard: BusState, battery_low: float = 0.1) -> dict[str, Check]:
    return {each.name: each for each in preflight.bus_checks(heard, battery_low)}


def test_an_agent_sends_each_ping_back_once() -> None:
    bench = Bench([(2.0, 2.0, 0.0), (5.0, 5.0, 0.0)])
    pongs: list[Ping] = []
    bench.bus.subscribe(bench.keys.pong(), Ping, pongs.append)
    heard = listen(bench)
    assert heard.there
    assert heard.core
    assert (len(heard.trips_s), heard.lost) == (PINGS, 0)
    assert [each.robot for each in pongs] == ["r1"] * PINGS
    assert len({each.id for each in pongs}) == PINGS
    found = judged(heard)
    assert {each.status for each in found.values()} == {"ok"}


def test_who_is_not_there_is_not_pinged() -> None:
    bench = Bench([(2.0, 2.0, 0.0)])
    pings: list[Ping] = []
    bench.bus.subscribe(bench.keys.ping(), Ping, pings.append)
    heard = listen(bench, "r2")
    assert not heard.there
    assert pings == []
    assert list(preflight.bus_checks(heard, 0.1)) == []


def test_an_agent_that_does_not_know_pings_is_older_not_absent() -> None:
    found = judged(BusState(ROW, core=True, trips_s=(), lost=PINGS))["round trip (bus)"]
    assert (found.status, "fullswarm update" in found.mend) == ("failure", True)


@pytest.mark.parametrize(
    ("trips_s", "lost", "status", "what"),
    [
        ((0.002, 0.003, 0.004), 0, "ok", "half of 3 within 3 ms, all within 4 ms"),
        ((0.08, 0.09, 0.1), 0, "warning", "half of 3 within 90 ms, all within 100 ms"),
        ((0.002, 0.003), 1, "warning", "half of 2 within 2.5 ms, all within 3 ms; 1 not answered in 500 ms"),
    ],
)
def test_round_trips(trips_s: tuple[float, ...], lost: int, status: str, what: str) -> None:
    found = judged(BusState(ROW, core=True, trips_s=trips_s, lost=lost))["round trip (bus)"]
    assert (found.status, found.what) == (status, what)


@pytest.mark.parametrize(
    ("share", "status", "what"),
    [
        (-1.0, "ok", "unknown: this robot does not report it"),
        (0.8, "ok", "80%"),
        (0.15, "warning", "15%"),
        (0.1, "failure", "10%: at 10% it stops"),
    ],
)
def test_batteries(share: float, status: str, what: str) -> None:
    row = replace(ROW, health=_health(battery=share))
    found = judged(BusState(row, core=True, trips_s=(0.01,)))["battery"]
    assert (found.status, found.what) == (status, what)


def _health(**fields: object) -> RobotHealth:
    import msgspec

    return msgspec.structs.replace(HEALTH, **fields)


@pytest.mark.parametrize(
    ("fields", "status", "mend"),
    [
        ({"lifecycle": "FAULT", "fault": "a wheel is blocked", "fault_code": Code.OVERCURRENT}, "failure", "Free its"),
        ({"lifecycle": "OPEN"}, "failure", "cable and power"),
        ({"estop": True}, "warning", "fullswarm estop --clear"),
        ({"stop_reason": "the hub is lost", "stop_code": Code.HUB}, "warning", "hub or its network"),
        ({"pose_note": "no fix for 3 s"}, "warning", "position source"),
    ],
)
def test_what_a_robot_complains_of_comes_with_what_mends_it(fields: dict[str, object], status: str, mend: str) -> None:
    found = judged(BusState(replace(ROW, health=_health(**fields)), core=True, trips_s=(0.01,)))["driver"]
    assert (found.status, mend in found.mend) == (status, True)


def test_without_a_core_nobody_can_ask_for_anything() -> None:
    assert judged(BusState(ROW, trips_s=(0.01,)))["core"].status == "warning"
