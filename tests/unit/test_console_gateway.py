from __future__ import annotations

import base64
import math
from typing import Any

import numpy as np
import pytest

from fullswarm.messages import (
    CoverageMeasurement,
    FileReload,
    Interventions,
    SeenObstacles,
)
from fullswarm.operator import robot_state
from fullswarm.perf.coverage import pack
from fullswarm.reasons import Code
from tests.unit.console_bench import KEYS, ConsoleBench, health


@pytest.fixture
def bench() -> ConsoleBench:
    return ConsoleBench()


# -------------------------------------------------------------------- what a page is told
def test_a_page_is_greeted_with_the_world_as_the_core_has_it(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    hello = page.frames[0]
    assert hello["t"] == "hello"
    assert (hello["swarm"], hello["version"], hello["read_only"]) == ("lab", "9.9", False)
    assert hello["operator"] == "console anna@base sess"
    assert hello["arena"] == [0.0, 0.0, 10.0, 8.0]
    assert hello["boxes"] == [[5.0, 5.0, 1.0, 2.0, 0.3]]
    assert hello["groups"] == {"scouts": ["r1", "r2"]}
    assert hello["sensing_radius_m"] == 3.0


def test_a_default_that_stands_in_the_database_is_filled_in(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    assert page.frames[0]["behaviours"]["move_to_goal_bc"]["parameters"]["gain"]["default"] == 2.5


def test_a_console_without_a_core_reports_it_and_catches_up() -> None:
    bench = ConsoleBench(core=False)
    page, _ = bench.join()
    bench.run(3.0)
    assert page.frames[0]["arena"] is None
    assert page.last("fleet")["core_age_s"] is None
    bench.core = True
    for _ in range(5):  # it is asked ever more seldom while it is silent
        bench.beat()
        bench.run(0.3)
    assert page.last("world")["arena"] == [0.0, 0.0, 10.0, 8.0]
    assert page.last("fleet")["core_age_s"] < 1.0
    assert page.log("link") == ["the core is running"]


def test_states_come_at_20_hz_while_messages_arrive(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    before = len(page.all("state"))
    for _ in range(40):
        bench.states("r1", "r2")
        bench.run(0.025)
    assert 19 <= len(page.all("state")) - before <= 21
    assert page.last("state")["robots"][0][:5] == ["r1", 1.0, 1.0, 1.0, 1.0]
    bench.run(0.1)
    count = len(page.all("state"))
    bench.run(1.0)
    assert len(page.all("state")) == count


def test_the_fleet_is_the_sign_of_life_and_names_what_to_do(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    bench.report(health("r1", fault="link lost", lifecycle="FAULT"), health("r2", battery=0.1, behaviour="flocking"))
    bench.states("r1", "r2")
    before = len(page.all("fleet"))
    bench.run(0.75)
    assert 3 <= len(page.all("fleet")) - before <= 4
    first, second = page.last("fleet")["robots"]
    assert first["attention"]
    assert first["advice"] == robot_state.UNKNOWN
    assert (first["host"], first["version"], first["radius_m"]) == ("h", "1.2", 0.17)
    assert (second["behaviour"], second["battery"], second["advice"]) == ("flocking", 0.1, "Charge it soon.")
    assert page.log("fault") == ["r1: link lost"]
    bench.run(3.0)
    assert page.last("fleet")["silent"] == ["r1", "r2"]
    assert page.log("link")[-1] == "r1, r2: silent"


def test_a_robot_that_falls_silent_is_told_within_a_second_and_at_once(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    for _ in range(10):
        bench.report(health("r1"), health("r2"))
        bench.states("r1", "r2")
        bench.run(0.05)
    for _ in range(19):
        bench.report(health("r2"))
        bench.states("r2")
        bench.run(0.05)
    assert page.last("fleet")["silent"] == ["r1"], "0.95 s after its last message"


def test_a_control_law_that_fails_is_in_the_log(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    why = "law 'glide': NameError: name 'x' is not defined"
    for stop_reason, stop_code in ((why, Code.LAW), ("", ""), ("the hub is silent", Code.HUB), (why, Code.LAW)):
        robots = (health(robot, stop_reason=stop_reason, stop_code=stop_code) for robot in ("r1", "r2"))
        bench.report(*robots)
        bench.states("r1", "r2")
        bench.run(0.5)
    assert page.log("fault") == [f"r1, r2: {why}"] * 2


def test_what_became_of_a_changed_file_is_in_the_log_once_for_all_robots(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    problem = "/lab/glide.py:3: SyntaxError: invalid syntax"

    def report(problem: str) -> None:
        for host in ("r1", "r2", "r3"):
            message = FileReload(host=host, file="/lab/glide.py", problem=problem)
            bench.bus.publish(KEYS.reload(host), message)
        bench.run(0.1)

    for each in ("", problem, problem, "", ""):
        report(each)
    assert page.log("fault") == [f"glide.py is not loaded, what ran before goes on: {problem}"] * 2
    assert page.log("reload") == ["glide.py is loaded"] * 3


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"fault": "/dev/ttyUSB0: not activated", "fault_code": Code.CHARGER}, "Take it off its charger."),
        ({"fault": "the charger is plugged in"}, robot_state.PREVENTED),
        ({"fault": "one that a newer version knows", "fault_code": "flood"}, robot_state.PREVENTED),
        ({"fault": "axis 3: WATCHDOG_TIMER_EXPIRED", "lifecycle": "FAULT"}, robot_state.UNKNOWN),
        ({"fault": "the port is in use by pid 7", "lifecycle": "FAULT"}, robot_state.UNKNOWN),
        ({"fault": "no such battery message", "lifecycle": "FAULT"}, robot_state.UNKNOWN),
        ({"stop_reason": "two hazards", "stop_code": Code.HAZARD,
          "stop_parameters": {"hazards": "wheel_drop motors_off"}},
         "Put all its wheels on the floor, away from edges. Release its safety switch."),
        ({"stop_reason": "the pilot took over and a wheel hangs", "stop_code": Code.HAZARD,
          "stop_parameters": {"hazards": "wheel_drop estop_button"}}, ""),
        ({"stop_reason": "over", "stop_code": Code.EXPIRED, "behaviour": "drive_bc"}, ""),
    ],
)  # fmt: skip
def test_advice_is_given_only_where_the_cause_is_certain(
    bench: ConsoleBench, fields: dict[str, Any], said: str
) -> None:
    page, _ = bench.join()
    bench.report(health("r1", **fields))
    bench.states("r1")
    bench.run(0.5)
    assert page.last("fleet")["robots"][0]["advice"] == said


def test_a_core_that_falls_silent_is_reported_within_one_and_a_half_seconds(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    for _ in range(10):
        bench.beat()
        bench.run(0.1)
    assert page.last("fleet")["core_age_s"] <= 0.3
    bench.run(1.4)
    assert page.last("fleet")["core_age_s"] > 1.0
    assert page.log("link") == ["the core is running", "the core is silent"]


def test_a_core_that_was_started_again_is_asked_again(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    bench.beat("core-1")
    bench.run(0.2)
    bench.database["group/rear"] = {"robots": ["r4"]}
    bench.beat("core-2")
    bench.run(0.5)
    assert page.last("world")["groups"] == {"rear": ["r4"], "scouts": ["r1", "r2"]}


def test_a_change_in_the_database_is_sent(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    bench.change("world/bounds", [[0, 0], [4, 4]])
    bench.run(0.2)
    assert page.last("world")["arena"] == [0, 0, 4, 4]
    bench.change("behaviour/new", {"summary": "New"})
    bench.run(0.5)
    assert "new" in page.last("world")["behaviours"]
    bench.change("group/scouts", None)
    bench.run(0.2)
    assert page.last("world")["groups"] == {}


def test_goals_are_those_of_the_core_even_after_a_start_in_mid_run(bench: ConsoleBench) -> None:
    bench.change(
        "wanted/r1",
        {"request_id": "q", "behaviour": "formation", "parameters": {"target": [1.0, 2.0], "arrive_radius_m": 0.1}},
    )
    bench.change("wanted/r2", {"request_id": "p", "behaviour": "move_to_goal_bc", "parameters": {"goal": [3, 4]}})
    bench.run(0.2)
    page, _ = bench.join()
    goals = page.last("goals")["robots"]
    assert goals["r1"] == {
        "behaviour": "formation", "request_id": "q", "goal": None, "target": [1.0, 2.0], "radius_m": 0.1,
    }  # fmt: skip
    assert goals["r2"]["goal"] == [3.0, 4.0]
    bench.change("wanted/r2", None)
    bench.run(0.2)
    assert set(page.last("goals")["robots"]) == {"r1"}


def test_the_goal_of_a_centralised_behaviour_is_that_of_its_request(bench: ConsoleBench) -> None:
    page, session = bench.join()
    asked = bench.say(session, page, "request", behaviour="move_to_goal_bc", robots=["r1"], parameters={"goal": [2, 2]})
    bench.change("wanted/r1", {"request_id": asked["request_id"], "behaviour": "central", "parameters": {}})
    bench.run(0.2)
    assert page.last("goals")["robots"]["r1"]["goal"] == [2.0, 2.0]


def test_interventions_are_joined_and_expire(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    for host in ("a", "b"):
        bench.bus.publish(
            KEYS.intervention(host),
            Interventions(host=host, robots=(host,), x_m_s=(0.1,), y_m_s=(-0.2,), reasons=("a wall",)),
        )
    bench.run(0.2)
    assert sorted(page.last("filter")["robots"]) == [["a", 0.1, -0.2, "a wall"], ["b", 0.1, -0.2, "a wall"]]
    bench.bus.publish(KEYS.intervention("a"), Interventions(host="a"))
    bench.run(0.2)
    assert [row[0] for row in page.last("filter")["robots"]] == ["b"]
    bench.run(1.0)
    assert page.last("filter")["robots"] == []


def grid(host: str, cells: list[tuple[int, int]], rows: int = 4, columns: int = 6) -> CoverageMeasurement:
    covered = np.zeros((rows, columns), np.uint8)
    for row, column in cells:
        covered[row, column] = 1
    return CoverageMeasurement(
        host=host, robots=(host,), origin_x_m=-1.0, origin_y_m=2.0, cell_m=0.5, rows=rows, columns=columns,
        cells=pack(covered), stamp_s=0.0,
    )  # fmt: skip


def unpacked(frame: dict[str, Any]) -> np.ndarray[Any, np.dtype[np.uint8]]:
    bits = np.frombuffer(base64.b64decode(frame["bits"]), np.uint8)
    return np.unpackbits(bits, count=frame["rows"] * frame["columns"]).reshape(frame["rows"], frame["columns"])


def test_coverage_is_joined_over_all_hosts(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    bench.bus.publish(KEYS.measurement("coverage", "a"), grid("a", [(0, 0)]))
    bench.bus.publish(KEYS.measurement("coverage", "b"), grid("b", [(3, 5)]))
    bench.run(1.1)
    frame = page.last("coverage")
    assert (frame["origin"], frame["cell_m"]) == ([-1.0, 2.0], 0.5)
    assert np.argwhere(unpacked(frame)).tolist() == [[0, 0], [3, 5]]
    count = len(page.all("coverage"))
    bench.bus.publish(KEYS.measurement("coverage", "a"), grid("a", [(0, 0)]))
    bench.run(2.0)
    assert len(page.all("coverage")) == count


def test_a_grid_too_fine_for_a_page_is_made_coarser(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    bench.bus.publish(KEYS.measurement("coverage", "a"), grid("a", [(0, 0), (999, 1500)], 1000, 1501))
    bench.run(1.1)
    frame = page.last("coverage")
    assert frame["rows"] * frame["columns"] <= 260_000
    assert np.argwhere(unpacked(frame)).tolist() == [[0, 0], [frame["rows"] - 1, frame["columns"] - 1]]


def test_obstacles_that_two_robots_have_seen_are_one(bench: ConsoleBench) -> None:
    page, _ = bench.join()
    row = (1.0, 2.0, 0.5, 0.5, 0.0, 0.0)
    bench.bus.publish(KEYS.obstacles("a"), SeenObstacles(host="a", rows=(row,), stamp_s=0.0))
    bench.bus.publish(KEYS.obstacles("b"), SeenObstacles(host="b", rows=(row, (9.0, *row[1:])), stamp_s=0.0))
    bench.run(1.1)
    assert [each[0] for each in page.last("obstacles")["rows"]] == [1.0, 9.0]


@pytest.mark.parametrize("wild", [math.nan, math.inf, 1e308])
def test_an_impossible_obstacle_ends_nothing_and_is_reported_once(bench: ConsoleBench, wild: float) -> None:
    page, session = bench.join()
    good, bad = (1.0, 2.0, 0.5, 0.5, 0.0, 0.0), (3.0, 2.0, wild, 0.5, 0.0, 0.0)
    for _ in range(3):  # as handlers get it: no bus is needed to reach them
        bench.gateway._on_obstacles(SeenObstacles(host="a", rows=(good, bad), stamp_s=0.0))
        bench.run(1.1)
    assert page.last("obstacles")["rows"] == [list(good)]
    assert len([text for text in page.log("fault") if "obstacles" in text]) == 1
    assert bench.gateway.undrawn == {"obstacles": 3}
    assert bench.say(session, page, "estop")["ok"]


def test_what_cannot_be_drawn_leaves_the_other_frames_and_the_buttons(bench: ConsoleBench) -> None:
    page, session = bench.join()
    # A value that no database may hold, and whose fault is found only when the frame is written.
    bench.gateway._world._values["behaviour/wild"] = {"parameters": {}, "summary": object()}
    bench.gateway._changed.add("world")
    bench.states("r1")
    bench.report(health("r1"))
    bench.run(0.5)
    assert page.last("fleet")["robots"][0]["robot"] == "r1"
    assert bench.say(session, page, "estop")["ok"]
    bench.run(0.2)
    assert page.last("estop")["engaged"]
    late, _ = bench.join("session-2")
    assert late.last("hello")["history"]["log"]
    assert bench.gateway.undrawn == {"world": 2}
    assert [text for text in page.log("fault") if "'world'" in text]


def test_trails_are_kept_for_a_minute(bench: ConsoleBench) -> None:
    for step in range(10):
        bench.states("r1", x_m=1.0 + step)
        bench.run(0.2)
    page, _ = bench.join()
    trail = page.frames[0]["history"]["trails"]["r1"]
    assert trail[0] == [1.0, 1.0]
    assert trail[-1] == [10.0, 10.0]
    bench.run(70.0)
    late, _ = bench.join("session-2")
    assert not late.frames[0]["history"]["trails"].get("r1")
