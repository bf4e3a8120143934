from __future__ import annotations

import io
import json
import math
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from fullswarm.bus import LocalBus
from fullswarm.clock import SimClock
from fullswarm.keys import Keys
from fullswarm.messages import HealthReport, Heartbeat, Lease, Leases, RequestStatus, RobotHealth, RobotStates, Summary
from fullswarm.operator.render import fleet_table, footer_lines
from fullswarm.operator.robot_state import advise, ended_text, row_state
from fullswarm.operator.view import FleetView, NodeRow, RobotRow, Snapshot
from fullswarm.reasons import Code, reason
from fullswarm.runtime import Runtime

KEYS = Keys("lab")


def health(robot: str, **fields: object) -> RobotHealth:
    plain: dict[str, object] = {
        "robot": robot,
        "driver": f"sim://{robot}",
        "make": "sim",
        "model": "disc",
        "firmware": "1",
        "lifecycle": "ACTIVE",
    }
    return RobotHealth(**{**plain, **fields})  # type: ignore[arg-type]  # keyword fields by name


def row(robot: str = "r1", age_s: float = 0.1, **fields: object) -> RobotRow:
    return RobotRow(robot, age_s, 1.0, -2.5, math.pi / 2, 0.25, health(robot, **fields))


def text_of(snapshot: Snapshot, width: int = 80, max_rows: int | None = None, max_lines: int | None = None) -> str:
    console = Console(file=io.StringIO(), width=width, color_system=None)
    console.print(fleet_table(snapshot, max_rows, max_lines))
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


class Listening:
    def __init__(self) -> None:
        self.runtime = Runtime(SimClock(10.0))
        self.bus = LocalBus(self.runtime.mailbox)
        self.view = FleetView(self.bus, KEYS, self.runtime, expected=("r1", "r9"))

    def report(self, host: str, *robots: RobotHealth) -> None:
        message = HealthReport(host=host, process="p", version="1", robots=robots)
        self.bus.publish(KEYS.health(host), message)

    def states(self, host: str, *robots: str, x_m: float = 1.0) -> None:
        ones = (x_m,) * len(robots)
        message = RobotStates(
            host=host,
            sequence=1,
            stamp_s=0.0,
            robots=robots,
            x_m=ones,
            y_m=ones,
            heading_rad=ones,
            speed_m_s=ones,
            turn_rad_s=ones,
            radius_m=ones,
        )
        self.bus.publish(KEYS.state("0_0", host), message)


@pytest.fixture
def listening() -> Listening:
    return Listening()


def test_ages_count_from_the_newest_message_of_a_robot(listening: Listening) -> None:
    listening.report("h", health("r1"), health("r2"))
    listening.runtime.run(0.5)
    listening.states("h", "r2", "r3", x_m=4.0)
    listening.runtime.run(0.75)
    snapshot = listening.view.snapshot()
    assert [(each.robot, each.age_s, each.x_m) for each in snapshot.robots if each.robot != "r1"] == [
        ("r2", 0.75, 4.0),
        ("r3", 0.75, 4.0),
    ]
    assert snapshot.robots[0].age_s == 1.25
    assert math.isnan(snapshot.robots[0].x_m)
    assert snapshot.robots[2].health is None
    assert snapshot.silent == ("r1",)  # heard, but too long ago
    assert snapshot.missing == ("r9",)  # expected, never heard


def test_the_newest_of_everything_is_kept(listening: Listening) -> None:
    for behaviour in ("flocking", "stop"):
        listening.report("h", health("r1", behaviour=behaviour))
        listening.bus.publish(KEYS.summary("work"), Summary(metric="work", values={"total_m": len(behaviour)}))
        listening.bus.publish(KEYS.heartbeat("core"), Heartbeat(node="core", process="p", sequence=1))
        status = RequestStatus(request_id=behaviour, behaviour=behaviour, phase="running", missing=("r1", "r7"))
        listening.bus.publish(KEYS.behaviour_status, status)
    listening.runtime.run(0.25)
    snapshot = listening.view.snapshot()
    assert snapshot.robots[0].health == health("r1", behaviour="stop")
    assert [each.values for each in snapshot.summaries] == [{"total_m": 4}]
    assert snapshot.nodes == (NodeRow("core", 0.25, ()),)
    assert snapshot.request is not None
    assert snapshot.request.request_id == "stop"
    assert snapshot.missing == ("r7", "r9")  # r1 has joined since


def test_a_snapshot_is_json_without_nan(listening: Listening) -> None:
    listening.report("h", health("r1", fault="wheel stuck"))
    listening.runtime.run(0.5)
    plain = json.loads(json.dumps(listening.view.snapshot().as_dict(), allow_nan=False))
    assert plain["robots"][0]["x_m"] is None
    assert plain["robots"][0]["fault"] == "wheel stuck"
    assert plain["robots"][0]["age_s"] == 0.5
    assert plain["missing"] == ["r9"]
    assert plain["request"] is None


def test_a_closed_view_receives_nothing(listening: Listening) -> None:
    listening.view.close()
    listening.report("h", health("r1"))
    listening.runtime.run(0.1)
    assert listening.view.robots() == ()
    assert listening.view.present() == ("r1", "r9")


def said(seen: RobotRow) -> tuple[str, bool]:
    state = row_state(seen)
    return state.text, state.attention


def test_a_settled_robot_is_shown_with_its_reason_and_needs_no_attention() -> None:
    why = reason(Code.SETTLED)
    text, attention = said(row(behaviour="move_to_goal_bc", stop_reason=why.text, stop_code=why.code, moving=False))
    assert text == f"settled: {why.text}"
    assert not attention


@pytest.mark.parametrize(
    ("fields", "state"),
    [
        ({"moving": True}, ("moving", False)),
        ({}, ("standing", False)),
        ({"estop": True}, ("E-STOP", True)),
        ({"estop": True, "moving": True}, ("E-STOP, still rolling", True)),
        ({"estop": True, "fault": "port gone", "lifecycle": "FAULT"}, ("E-STOP, FAULT: port gone", True)),
        ({"fault": "the charger is plugged in"}, ("STOPPED: the charger is plugged in", True)),
        ({"stop_reason": "the hub is lost"}, ("STOPPED: the hub is lost", True)),
        ({"stop_reason": "ann did it", "stop_code": Code.STOPPED, "behaviour": ""}, ("standing", False)),
        ({"stop_reason": "ann did it", "stop_code": Code.STOPPED, "behaviour": "drive"}, ("STOPPED: ann did it", True)),
        ({"stop_reason": "over", "stop_code": Code.EXPIRED, "behaviour": ""}, ("standing", False)),
        ({"stop_reason": "over", "stop_code": Code.EXPIRED, "behaviour": "drive_bc"}, ("standing", False)),
        ({"stop_reason": "ann did it", "stop_code": Code.ESTOP_RELEASED, "behaviour": ""}, ("standing", False)),
        ({"lifecycle": "FAULT"}, ("FAULT: no reason given", True)),
        ({"lifecycle": "OPEN"}, ("open, not ready", False)),
        ({"contacts": 1, "moving": True}, ("moving, TOUCHING", True)),
        ({"battery": 0.1}, ("standing, BATTERY 10%", True)),
    ],
)
def test_states_are_shown_as_text(fields: dict[str, object], state: tuple[str, bool]) -> None:
    assert said(row("r1", 0.1, **fields)) == state


def test_a_robot_at_standstill_is_not_shown_as_rolling() -> None:
    reported = row("r1", 0.1, estop=True, moving=True)
    assert said(replace(reported, speed_m_s=0.0)) == ("E-STOP", True)
    assert said(replace(reported, speed_m_s=-0.1)) == ("E-STOP, still rolling", True)


def test_silence_precedes_what_was_last_received() -> None:
    assert said(row("r1", 7.0, moving=True)) == ("SILENT for 7 s", True)
    assert said(RobotRow("r1", 0.1, 0.0, 0.0, 0.0, 0.0, None)) == ("no health report", True)


def full_snapshot() -> Snapshot:
    return Snapshot(
        swarm="lab",
        connected=True,
        robots=(
            row("r1", behaviour="flocking_bc", moving=True),
            row("r2", behaviour="flocking_bc", collisions=3, stop_reason="the core's heartbeat is silent"),
            RobotRow("r3", 12.0, math.nan, math.nan, math.nan, math.nan, health("r3")),
        ),
        nodes=(NodeRow("core", 0.1, ()), NodeRow("centralised", 5.0, ())),
        summaries=(
            Summary(metric="coverage", values={"fraction": 0.254, "area_m2": 101.6}),
            Summary(metric="work", values={"total_m": 12.345}, finished=True, reason="60 s are over"),
        ),
        request=RequestStatus(request_id="ab12", behaviour="flocking_bc", phase="running"),
        missing=("r4",),
    )


def test_the_table_shows_everything_in_80_columns() -> None:
    text = text_of(full_snapshot())
    lines = [line.rstrip() for line in text.splitlines()]
    assert max(map(len, lines)) <= 80
    assert lines == [
        "swarm lab: 3 robots, hub connected, centralised SILENT, alive: core",
        "robot behaviour      x m    y m head °   m/s age s hits state",
        "r2    flocking_bc   1.00  -2.50     90  0.25   0.1    3 STOPPED: the core's",
        "                                                        heartbeat is silent",
        "r3    -                -      -      -     -  12.0    0 SILENT for 12 s",
        "r1    flocking_bc   1.00  -2.50     90  0.25   0.1    0 moving",
        "MISSING, not reporting: r4",
        "SILENT, no longer reporting: r3",
        "request ab12: flocking_bc running",
        "coverage: 25.4% of the area, area 101.60 m²",
        "work: total 12.35 m; finished: 60 s are over",
    ]


def test_an_empty_swarm_shows_what_is_missing() -> None:
    text = text_of(Snapshot("lab", connected=False))
    assert text.splitlines()[0].rstrip() == "swarm lab: 0 robots, HUB LOST, NO CORE"


def test_a_long_table_shows_trouble_first_and_counts_the_rest() -> None:
    rows = (*(row(f"r{number}") for number in range(5)), row("z", estop=True))
    lines = [line.split() for line in text_of(Snapshot("lab", True, rows), max_rows=3).splitlines()]
    assert [line[0] for line in lines[2:5]] == ["z", "r0", "…"]
    assert lines[4] == ["…", "4", "more"]


def test_names_with_brackets_are_not_markup() -> None:
    snapshot = Snapshot("lab", True, (row("r1", behaviour="[red]x", stop_reason="[bold]why[/]"),))
    assert "[red]x" in text_of(snapshot)
    assert "[bold]why[/]" in text_of(snapshot)


def test_trouble_comes_first_and_r2_before_r10() -> None:
    rows = (row("r10"), row("r1"), row("r2"), row("r9", estop=True))
    lines = text_of(Snapshot("lab", True, rows)).splitlines()[2:]
    assert [line.split()[0] for line in lines] == ["r9", "r1", "r2", "r10"]


def test_holders_are_shown_when_there_are_any() -> None:
    snapshot = replace(full_snapshot(), leases=(Lease(robot="r1", operator="anna@lab1", age_s=2.0),))
    lines = [line.rstrip() for line in text_of(snapshot).splitlines()]
    assert max(map(len, lines)) <= 80
    assert lines[1] == "robot behaviour      x m    y m   m/s hits held by   state"
    assert lines[-6] == "r1    flocking_bc   1.00  -2.50  0.25    0 anna@lab1 moving"
    assert snapshot.as_dict()["robots"][0]["held_by"] == "anna@lab1"  # type: ignore[index]  # plain JSON


def test_forty_robots_in_trouble_stay_legible_in_80_columns() -> None:
    rows = tuple(
        row(f"rover-{number}", behaviour="voronoi_coverage_bc", stop_reason="the hub is lost") for number in range(40)
    )
    leases = tuple(Lease(robot=each.robot, operator="anna@lab1", age_s=2.0) for each in rows)
    lines = text_of(Snapshot("lab", True, rows, leases=leases)).splitlines()
    assert max(map(len, lines)) <= 80
    for number in range(40):  # names and numbers whole, whatever else is folded
        (line,) = [each for each in lines if each.split()[:1] == [f"rover-{number}"]]
        assert line.split()[1:6] == ["voronoi_coverage_bc", "1.00", "-2.50", "0.25", "0"]


def test_leases_that_the_core_no_longer_reports_are_not_shown(listening: Listening) -> None:
    lease = Lease(robot="r1", operator="anna@lab1", age_s=2.0)
    listening.bus.publish(KEYS.leases, Leases(leases=(lease,)))
    listening.runtime.run(1.0)
    assert listening.view.snapshot().leases == (lease,)
    listening.runtime.run(3.0)
    assert listening.view.snapshot().leases == ()


def test_repeated_values_are_not_shown_and_a_share_is_labelled() -> None:
    summaries = (
        Summary(metric="arrival", values={"fraction": 0.75, "truth_fraction": 0.5, "elapsed_s": 3.0}),
        Summary(metric="loop", values={"elapsed_s": 3.0}),
        Summary(metric="work", values={"total_m": 2.0, "truth_total_m": 2.1}),
    )
    assert footer_lines(Snapshot("lab", True, summaries=summaries)) == [
        "work: total 2.00 m",
        "arrival: 75.0% of the robots",
    ]


def test_what_says_little_by_its_name_is_said_in_words() -> None:
    summaries = (Summary(metric="coordination", values={"deadlock_count": 15.0, "sidestep_s": 27.75}),)
    (line,) = footer_lines(Snapshot("lab", True, summaries=summaries))
    assert line == "coordination: blocked and stepped aside 15 times, 28 s spent on stepping aside"


@pytest.mark.parametrize(
    ("code", "behaviour", "words"),
    [
        (Code.EXPIRED, "drive_bc", "stick released"), (Code.EXPIRED, "", "stick released"),
        (Code.STOPPED, "", "stopped by an operator"), (Code.ESTOP_RELEASED, "", "e-stop cleared"),
        (Code.ARRIVED, "", "arrived"),
    ],
)  # fmt: skip
def test_what_ended_as_intended_is_no_alarm(code: Code, behaviour: str, words: str) -> None:
    seen = row("r1", behaviour=behaviour, stop_code=code, stop_reason="whatever it says")
    state = row_state(seen, "page")
    assert (state.attention, state.brief) == (False, "")
    assert ended_text(seen) == words
    assert advise(seen, "page") == ""


def test_trouble_has_a_word_and_an_advice_for_its_reader() -> None:
    cliff = row("r1", fault="the cliff sensor sees no floor", fault_code=Code.CLIFF)
    hazard = row("r1", stop_code=Code.HAZARD, stop_reason="x", stop_parameters={"hazards": "wheel_drop"})
    silent = replace(row("r1"), age_s=9.0)
    assert [row_state(each, "page").brief for each in (cliff, hazard, silent)] == ["cliff", "wheel drop", "silent"]
    assert ended_text(cliff) == ended_text(silent) == ""
    waits = row("r1", stop_code=Code.CHARGE_WAITS, stop_reason="waits")
    assert "`fullswarm docks`" in advise(waits)
    assert "`" not in advise(waits, "page")
    newer = reason(Code.VERSION, process="r2", software="2", own="1", kinds="A/1")
    stands = row("r1", stop_code=newer.code, stop_reason=newer.text, stop_parameters=dict(newer.parameters))
    assert "`" in row_state(stands).why
    assert "`" not in row_state(stands, "page").why


def test_trouble_stays_on_a_small_screen() -> None:
    lines = [line.rstrip() for line in text_of(full_snapshot(), max_rows=3, max_lines=2).splitlines()]
    assert lines[-2:] == ["MISSING, not reporting: r4", "SILENT, no longer reporting: r3"]


def test_a_clock_that_is_apart_is_named_with_what_to_do() -> None:
    listening = Listening()
    report = HealthReport(host="h", process="p", version="1", robots=(health("r1"),), wall_offset_s=-7.3)
    listening.bus.publish(KEYS.health("h"), report)
    near = HealthReport(host="g", process="p", version="1", robots=(health("r2"),), wall_offset_s=0.4)
    listening.bus.publish(KEYS.health("g"), near)
    listening.runtime.run(0.1)
    (line,) = [each for each in footer_lines(listening.view.snapshot()) if "CLOCK" in each]
    assert line.startswith("CLOCK of r1 is 7.3 s behind the core's: set it")
    robots: Any = listening.view.snapshot().as_dict()["robots"]
    assert [each["wall_offset_s"] for each in robots] == [-7.3, 0.4]
