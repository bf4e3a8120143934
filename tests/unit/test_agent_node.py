"""The agent in a simulated world: it does what it is asked and stops when it must."""

from __future__ import annotations

import math
import re
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.agent.behaviours import move_to_goal
from fullswarm.agent.orders import tasks
from fullswarm.bus import LocalBus
from fullswarm.core.behaviours import load_records, make_record
from fullswarm.drivers.base import Hazard
from fullswarm.errors import ConfigError
from fullswarm.messages import Command, ControlRequest
from tests.unit.agent_bench import TICK_S, Bench

GOAL = {"goal": [15.0, 5.0], "gain": 1.0, "arrive_radius_m": 0.2}
SLACK_S = TICK_S
"""Set-points are looked at once per tick, so a figure may be one tick too long."""


@pytest.fixture
def bench() -> Bench:
    return Bench([(5.0, 5.0, 0.0)])


def driving(bench: Bench, **fields: Any) -> Bench:
    bench.enable("move_to_goal", GOAL, **fields)
    bench.run(1.0)
    assert bench.commanded[0, 0] > 0.4
    return bench


def test_it_drives_to_the_goal_and_stands_there(bench: Bench) -> None:
    bench.enable("move_to_goal", {**GOAL, "goal": [7.0, 6.0]})
    bench.run(12.0)
    assert math.dist(bench.agent.pose[0, :2], (7.0, 6.0)) <= 0.21
    assert not bench.commanded.any()


def test_without_a_task_it_stands(bench: Bench) -> None:
    bench.run(1.0)
    assert not bench.commanded.any()


def test_a_silent_core_stops_it_after_a_second_and_its_return_starts_it_again(bench: Bench) -> None:
    driving(bench).beating = False
    assert 0.85 <= bench.time_to_zero_s() <= 1.0 + TICK_S + SLACK_S
    bench.run(2.0)
    assert not bench.commanded.any()
    bench.beating = True
    bench.run(0.5)
    assert bench.commanded[0, 0] > 0.0


def test_a_behaviour_whose_record_says_so_goes_on_without_the_core(bench: Bench) -> None:
    driving(bench, survives_core=True).beating = False
    bench.run(3.0)
    assert bench.commanded[0, 0] > 0.4


def test_a_lost_hub_stops_it_at_the_next_tick(bench: Bench) -> None:
    driving(bench).bus.hub = False
    assert bench.time_to_zero_s() <= TICK_S + SLACK_S
    bench.bus.hub = True
    bench.run(0.5)
    assert bench.commanded[0, 0] > 0.0


def centralised(bench: Bench) -> None:
    bench.enable("central", centralised=True)
    for number in range(20):
        bench.command(0.4, number)
        bench.run(0.05)
    assert bench.commanded[0, 0] == pytest.approx(0.4)


def test_a_command_lives_for_its_ttl(bench: Bench) -> None:
    centralised(bench)
    # The last command came one period of 0.05 s ago.
    assert 0.2 <= bench.time_to_zero_s() <= 0.25 + TICK_S + SLACK_S


def test_a_command_that_waited_in_a_queue_is_not_obeyed(bench: Bench) -> None:
    centralised(bench)
    bench.time_to_zero_s()
    bench.run(3.0)
    bench.command(0.4, 100, stamp_s=bench.runtime.now_s() - 2.0)
    bench.run(TICK_S)
    assert not bench.commanded.any()
    bench.command(0.4, 101)
    bench.run(TICK_S)
    assert bench.commanded[0, 0] > 0.0


@pytest.mark.parametrize("number", [0, 19, -5])
def test_an_old_command_is_not_obeyed_again(bench: Bench, number: int) -> None:
    centralised(bench)
    bench.time_to_zero_s()
    bench.command(0.4, number)
    bench.run(TICK_S)
    assert not bench.commanded.any()


@pytest.mark.parametrize("speed", [math.nan, math.inf, -math.inf])
def test_a_command_that_is_not_finite_is_not_obeyed(bench: Bench, speed: float) -> None:
    bench.enable("central", centralised=True)
    bench.command(speed, 1)
    bench.run(0.1)
    assert not bench.commanded.any()


def test_an_intent_lapses(bench: Bench) -> None:
    parameters = {"magnitude": 1.0, "speed_m_s": 0.5, "direction": [1.0, 0.0]}
    for _ in range(10):
        bench.enable("move", parameters, expires_s=0.3)
        bench.run(0.05)
    assert bench.commanded[0, 0] > 0.2
    assert 0.2 <= bench.time_to_zero_s() <= 0.3 + TICK_S + SLACK_S


def test_a_repeated_request_changes_nothing_but_is_answered_again(bench: Bench) -> None:
    request = ControlRequest(
        request_id="q", robot="r1", behaviour="drive", law="drive", enable=True, core="c", sequence=7, expires_s=0.3,
        parameters={"linear": 1.0, "angular": 0.0, "speed_m_s": 0.5, "turn_rad_s": 1.0},
    )  # fmt: skip
    for _ in range(8):
        bench.bus.publish(bench.keys.control_requests("r1", "drive"), request)
        bench.run(0.1)
    # Repeating an intent's delivery must not lengthen its life.
    assert not bench.commanded.any()
    assert len(bench.acks) == 8
    assert all(ack == bench.acks[0] and ack.accepted for ack in bench.acks)


def test_an_older_request_of_the_same_core_is_ignored(bench: Bench) -> None:
    driving(bench)
    bench.enable("stop", sequence=0)
    bench.run(0.5)
    assert bench.commanded[0, 0] > 0.4


def test_estop_latches_confirms_and_refuses_until_released(bench: Bench) -> None:
    driving(bench)
    bench.estop(True, "e1")
    assert [(receipt.robot, receipt.standing) for receipt in bench.receipts] == [("r1", False)]
    assert not bench.commanded.any()
    bench.run(1.0)
    standing = bench.receipts[-1]
    assert standing.standing
    # 0.5 m/s braked with 2 m/s² rolls 62 mm, and up to a tick at full speed before.
    assert 0.05 <= standing.rolled_m <= 0.0625 + 0.5 * 2 * TICK_S
    bench.enable("move_to_goal", GOAL)
    bench.run(0.5)
    assert not bench.commanded.any()
    assert not bench.acks[-1].accepted
    assert "estop --clear" in bench.acks[-1].reason
    bench.estop(True, "e1")
    assert bench.receipts[-1] == standing, "a repeated order is confirmed, not carried out again"
    bench.estop(False, "e2")
    bench.run(1.0)
    assert bench.receipts[-1].id == "e2"
    assert not bench.commanded.any(), "released, but nobody asked it to drive"
    driving(bench, request_id="asked again")


def test_estop_of_one_robot_leaves_the_others(bench: Bench) -> None:
    bench = Bench([(5.0, 5.0, 0.0), (5.0, 8.0, 0.0)])
    bench.enable("move_to_goal", GOAL)
    bench.run(1.0)
    bench.estop(True, "e1", ("r2",))
    bench.run(0.5)
    assert bench.commanded[0, 0] > 0.0
    assert not bench.commanded[1].any()


def test_stop_ends_the_task_once(bench: Bench) -> None:
    driving(bench).stop("s1")
    assert bench.time_to_zero_s() <= TICK_S + SLACK_S
    driving(bench, request_id="asked again").stop("s1")
    bench.run(0.1)
    assert bench.commanded[0, 0] > 0.0, "the repetition of an earlier stop must not end a later task"


def test_an_unknown_law_is_refused_with_a_near_match(bench: Bench) -> None:
    bench.enable("flokking")
    bench.run(0.1)
    assert not bench.acks[-1].accepted
    assert "did you mean 'flocking'?" in bench.acks[-1].reason


def test_a_law_that_fails_makes_its_robots_stand_and_say_why(bench: Bench) -> None:
    driving(bench)
    bench.enable("move_to_goal", {"goal": [1.0, 1.0]})
    assert bench.time_to_zero_s() <= TICK_S + SLACK_S
    assert "needs a parameter" in bench.agent.desired.law_error[0].text
    driving(bench)


def test_a_law_that_raises_is_named_with_its_line(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    driving(bench)
    monkeypatch.delattr(move_to_goal, "np")
    bench.enable("move_to_goal", {"goal": [1.0, 1.0], "gain": 1.0, "arrive_radius_m": 0.1})
    bench.run(0.2)
    said = bench.agent.desired.law_error[0].text
    assert re.fullmatch(r"law 'move_to_goal': NameError: name '\w+' is not defined \(move_to_goal.py:\d+\)", said)


def test_a_law_that_answers_nan_makes_its_robots_stand(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    law = move_to_goal.velocity
    broken: list[bool] = []
    monkeypatch.setattr(move_to_goal, "velocity", lambda *given: law(*given) * (math.nan if broken else 1.0))
    driving(bench)
    broken.append(True)
    assert bench.time_to_zero_s() <= TICK_S + SLACK_S
    assert "not finite" in bench.agent.desired.law_error[0].text


seeds = st.integers(0, 2**32 - 1)


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_set_points_stay_within_limits_whatever_is_wished(seed: int) -> None:
    rng = np.random.default_rng(seed)
    bench = Bench([(10.0, 10.0, 0.0)], agent_settings={"speed_limit_m_s": 0.3, "turn_limit_rad_s": 1.0})
    before = bench.commanded.copy()
    for _ in range(30):
        parameters = {
            "linear": rng.uniform(-1, 1), "angular": rng.uniform(-1, 1), "speed_m_s": 50.0, "turn_rad_s": 50.0,
        }  # fmt: skip
        bench.enable("drive", parameters)
        bench.run(TICK_S)
        now = bench.commanded
        assert abs(now[0, 0]) <= 0.3 + 1e-9
        assert abs(now[0, 1]) <= 1.0 + 1e-9
        same_way = max(before[0, 0] * np.sign(now[0, 0]), 0.0)
        assert abs(now[0, 0]) - same_way <= 2.0 * TICK_S + 1e-9, "accelerates harder than the wheels can"
        before = now.copy()


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_filtered_robots_never_touch_each_other_a_box_or_a_wall(seed: int) -> None:
    rng = np.random.default_rng(seed)
    spots = [(x, y) for x in (0.5, 1.5, 2.5, 3.5) for y in (0.5, 1.5, 3.5)]
    rng.shuffle(spots)
    poses = [(x, y, rng.uniform(-math.pi, math.pi)) for x, y in spots[:6]]
    world = {"bounds_m": [0, 0, 4, 4], "boxes": [[2.0, 2.5, 0.6, 0.4, 0.5]]}
    bench = Bench(poses, world=world)
    for row in range(6):
        goal = rng.uniform(-0.5, 4.5, 2).tolist()
        bench.enable("move_to_goal", {**GOAL, "goal": goal}, robot=f"r{row + 1}", filtered=True)
    bench.run(15.0)
    assert bench.agent.calculators.collisions.sum() == 0


def test_unfiltered_robots_do_touch() -> None:
    bench = Bench([(5.0, 5.0, 0.0), (7.0, 5.0, math.pi)])
    bench.enable("move_to_goal", {**GOAL, "goal": [6.0, 5.0], "arrive_radius_m": 0.0})
    bench.run(5.0)
    assert bench.agent.calculators.collisions.sum() > 0


@pytest.mark.parametrize("law", ["drive", "move"])
def test_a_stick_cannot_push_a_filtered_robot_into_another(law: str) -> None:
    bench = Bench([(5.0, 5.0, 0.0), (7.0, 5.0, math.pi)])
    for _ in range(100):
        for number, way in ((1, 1.0), (2, -1.0)):
            sticks = {"linear": 1.0, "angular": 0.0, "speed_m_s": 0.5, "turn_rad_s": 1.0}
            move = {"magnitude": 1.0, "speed_m_s": 0.5, "direction": [way, 0.0]}
            parameters = sticks if law == "drive" else move
            bench.enable(law, parameters, robot=f"r{number}", expires_s=0.3, filtered=True)
        bench.run(0.05)
    gap_m = math.dist(*bench.agent.pose[:, :2]) - 2 * 0.17
    assert bench.agent.calculators.collisions.sum() == 0
    assert 0.03 <= gap_m <= 0.1


def test_the_requests_own_margin_counts() -> None:
    bench = Bench([(5.0, 5.0, 0.0), (7.0, 5.0, math.pi)])
    parameters = {**GOAL, "goal": [6.0, 5.0], "arrive_radius_m": 0.0, "safety_margin_m": 0.3}
    bench.enable("move_to_goal", parameters, filtered=True)
    bench.run(10.0)
    assert math.dist(*bench.agent.pose[:, :2]) - 2 * 0.17 >= 0.3


def test_after_a_hazard_only_a_new_request_moves_it(bench: Bench) -> None:
    driving(bench, request_id="first")
    bench.simulated.hazards[0] = int(Hazard.CLIFF)
    bench.run(TICK_S * 2)
    assert not bench.commanded.any()
    bench.simulated.hazards[0] = 0
    bench.enable("move_to_goal", GOAL, request_id="first")
    bench.run(0.5)
    assert not bench.commanded.any()
    assert not bench.acks[-1].accepted
    assert "ask for it again" in bench.acks[-1].reason
    driving(bench, request_id="second")


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("safety_margin_m", -5.0, r"safety_margin_m = -5 is outside \[0, 1\] m"),
        ("safety_margin_m", -1e-9, "is outside"),
        ("safety_margin_m", math.nan, "not a finite number"),
        ("safety_margin_m", "none", "not a finite number"),
        ("safety_margin_m", True, "not a finite number"),
        ("barrier_gain_per_s", 0.0, r"outside \[0.01, 20\] 1/s"),
        ("barrier_gain_per_s", math.inf, "not a finite number"),
        ("gain", -1.0, r"gain = -1 is outside \[0.05, 5\] 1/s"),
        ("gain", "fast", "gain = 'fast' is not a finite number"),
        ("goal", [math.nan, 1.0], "goal.x = nan is not a finite number"),
        ("goal", 3.0, r"goal = 3.0 is not a point"),
        ("hearing_m", 1e300, "hearing_m"),
        ("unheard_of", math.inf, "refuses unheard_of: no behaviour"),
        ("unheard_of", [[1.0, math.nan]], "refuses unheard_of: no behaviour"),
    ],
)
@pytest.mark.parametrize("before", [True, False])
def test_a_parameter_out_of_range_is_refused_with_the_reason_and_changes_nothing(
    bench: Bench, name: str, value: Any, said: str, before: bool
) -> None:
    if before:  # the same law runs already: its parameters are renewed in place
        bench.enable("move_to_goal", GOAL, filtered=True)
    margin_m = bench.agent.tasks.margin_m[0]
    bench.enable("move_to_goal", {**GOAL, name: value}, filtered=True)
    assert not bench.acks[-1].accepted
    assert re.search(said, bench.acks[-1].reason), bench.acks[-1].reason
    bench.run(0.5)
    assert bench.agent.tasks.margin_m[0] == margin_m >= 0.0
    assert bench.commanded.any() == before


@pytest.mark.parametrize("expires_s", [math.nan, -1.0, 1e9])
def test_an_intent_that_would_not_lapse_is_refused(bench: Bench, expires_s: float) -> None:
    request = ControlRequest(
        request_id="q", robot="r1", behaviour="drive", law="drive", enable=True, core="c", sequence=7,
        expires_s=expires_s, stamp_s=bench.runtime.now_s(),
        parameters={"linear": 1.0, "angular": 0.0, "speed_m_s": 0.5, "turn_rad_s": 1.0},
    )  # fmt: skip
    LocalBus.publish(bench.bus, bench.keys.control_requests("r1", "drive"), request)  # no wire has looked at it
    bench.run(0.2)
    assert "expires_s" in bench.acks[-1].reason
    assert not bench.commanded.any()


@pytest.mark.parametrize("fields", [{"ttl_s": math.nan}, {"stamp_s": math.nan}, {"ttl_s": -1.0}])
def test_a_command_without_a_sound_time_is_not_obeyed(bench: Bench, fields: dict[str, float]) -> None:
    bench.enable("central", centralised=True)
    command = Command(
        robot="r1", request_id="q-central", linear_m_s=0.3, angular_rad_s=0.0, ttl_s=0.3, sequence=5,
        stamp_s=bench.runtime.now_s(),
    )  # fmt: skip
    command = msgspec.structs.replace(command, **fields)
    LocalBus.publish(bench.bus, bench.keys.command("r1"), command)
    bench.run(0.1)
    assert not bench.commanded.any()


def test_what_the_records_allow_is_allowed_on_board() -> None:
    tables = load_records()
    for name in tables:
        record = make_record(name, tables)
        if record.centralised or not record.law:
            continue
        for key, parameter in record.parameters.items():
            for value in (parameter.min, parameter.max, parameter.default):
                if value is not None and parameter.type == "number":
                    request = ControlRequest(
                        request_id="q", robot="r1", behaviour=name, law=record.law, enable=True,
                        expires_s=record.expires_s, parameters={**record.static, key: value},
                    )  # fmt: skip
                    tasks.check(request)
            if parameter.type == "number" and parameter.max is not None:
                with pytest.raises(ConfigError, match=key):
                    tasks.check(msgspec.structs.replace(request, parameters={key: parameter.max * 1.001 + 0.001}))
