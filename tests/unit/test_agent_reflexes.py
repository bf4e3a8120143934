"""Reflexes on board: battery, arena's edge, lost pose, clock that leaps, world that stands still."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm import reasons
from fullswarm.agent.motion.reflexes import Reflexes, Thresholds
from fullswarm.agent.motion.robot_controller import StopReason
from fullswarm.agent.safety.dead_time import Commands
from fullswarm.clock import SimClock
from fullswarm.drivers.base import NO_OBSTACLES, FleetReading, Hazard
from fullswarm.messages import RobotStates, StopRequest
from fullswarm.reasons import TEXTS, Code
from tests.unit.agent_bench import TICK_S, Bench

TTL_S, READING_S = 0.3, 0.5
FAR = {"goal": [18.0, 10.0], "gain": 0.5, "arrive_radius_m": 0.05}
STICKS = {"linear": 1.0, "angular": 0.0, "speed_m_s": 0.5, "turn_rad_s": 1.0}


@pytest.fixture
def bench() -> Bench:
    made = Bench([(2.0, 10.0, 0.0)])
    made.enable("move_to_goal", FAR)
    made.run(1.0)
    assert made.commanded.any()
    return made


def reason(bench: Bench) -> StopReason:
    return StopReason(int(bench.agent.controller.reason[0]))


def battery(bench: Bench, level: float) -> None:
    assert bench.agent.reading is not None
    bench.agent.reading.battery[:] = level  # the fleet's own array: it stays


# ------------------------------------------------------------------ battery
def test_a_low_battery_ends_the_task_at_once_and_says_so(bench: Bench) -> None:
    battery(bench, 0.09)
    assert bench.time_to_zero_s() <= TICK_S + 1e-9
    bench.run(TICK_S)
    assert bench.agent.tasks.of[0] is None
    assert bench.agent.inbox.ended[0] == reasons.reason(Code.BATTERY)
    bench.enable("move_to_goal", FAR, request_id="q2")
    assert not bench.acks[-1].accepted
    assert (bench.acks[-1].code, bench.acks[-1].reason) == (Code.BATTERY, TEXTS[Code.BATTERY])


def test_a_stop_says_that_a_person_has_seen_why_it_stands(bench: Bench) -> None:
    battery(bench, 0.09)
    bench.run(2 * TICK_S)
    battery(bench, 0.5)
    bench.bus.publish(bench.keys.stop, StopRequest(id="s1", source="ann"))
    bench.run(2 * TICK_S)
    assert bench.agent.inbox.ended[0] == reasons.reason(Code.STOPPED, by="ann")


def test_a_stop_of_a_robot_that_was_asked_for_nothing_says_nothing() -> None:
    bench = Bench([(2.0, 10.0, 0.0)])
    bench.bus.publish(bench.keys.stop, StopRequest(id="s1", source="ann"))
    bench.run(2 * TICK_S)
    assert bench.agent.inbox.ended[0] == reasons.NONE


def test_it_drives_again_only_when_charged_well_above_the_threshold(bench: Bench) -> None:
    for level, accepted in ((0.09, False), (0.12, False), (0.16, True)):
        battery(bench, level)
        bench.run(2 * TICK_S)
        bench.enable("move_to_goal", FAR, request_id=f"q-{level}")
        assert bench.acks[-1].accepted is accepted
    bench.run(0.2)
    assert bench.commanded.any()


def test_a_person_may_drive_it_to_its_charger(bench: Bench) -> None:
    battery(bench, 0.01)
    bench.run(2 * TICK_S)
    bench.enable("drive", STICKS, request_id="stick", expires_s=0.3)
    bench.run(0.1)
    assert bench.commanded.any()


def test_an_unknown_level_is_no_low_one_and_a_warning_of_the_robot_counts(bench: Bench) -> None:
    assert bench.agent.reading is not None
    assert bench.agent.reading.battery[0] == -1.0
    bench.agent.reading.hazards[:] = int(Hazard.BATTERY_LOW)
    assert bench.time_to_zero_s() <= TICK_S + 1e-9


# ------------------------------------------------------------------ the arena's edge
def no_walls(pose: tuple[float, float, float], **world: Any) -> Bench:
    return Bench([pose], world={"walls": False, "bounds_m": (0.0, 0.0, 10.0, 10.0), **world})


@pytest.mark.parametrize("accel", [0.4, 2.0])
def test_a_robot_that_is_not_filtered_stops_at_the_edge(accel: float) -> None:
    bench = no_walls((8.0, 5.0, 0.0), accel_limit_m_s2=accel)
    bench.enable("flocking", {**flocking(), "cruise_m_s": 0.5})
    bench.run(0.2)
    assert bench.commanded.any()
    bench.run(12.0)
    assert bench.agent.pose[0, 0] <= 10.0 + 1e-6
    assert bench.agent.pose[0, 0] > 9.7
    assert reason(bench) is StopReason.GEOFENCE


def flocking() -> dict[str, Any]:
    return {
        "repulsion_radius_m": 0.8, "alignment_radius_m": 2.0, "attraction_radius_m": 3.0,
        "separation": 1.5, "alignment": 1.0, "cohesion": 0.5,
    }  # fmt: skip


def test_outside_it_turns_round_and_drives_back() -> None:
    bench = no_walls((10.5, 5.0, 0.0))
    bench.enable("drive", STICKS, expires_s=0.3)
    bench.run(0.2)
    assert not bench.commanded.any()
    assert reason(bench) is StopReason.GEOFENCE
    bench.enable("move_to_goal", {"goal": [5.0, 5.0], "gain": 0.5, "arrive_radius_m": 0.05}, request_id="home")
    furthest = 0.0
    for _ in range(400):
        bench.run(TICK_S)
        furthest = max(furthest, float(bench.agent.pose[0, 0]))
    assert furthest <= 10.5 + 1e-6
    assert bench.agent.pose[0, 0] < 9.0


def furthest_out_m(
    start: tuple[float, float, float], accel: float, wishes: list[tuple[float, float]], dead_ticks: int = 0
) -> float:
    """Drive an independent body by wishes of 1 s each: it brakes no harder than `accel` and follows 0.1 s late.

    With a stated dead time it follows later by that.
    """
    commands = Commands(np.array([dead_ticks * TICK_S]), np.array([accel]), np.array([1e3]), TICK_S)
    applied, now_s = np.zeros((1, 2)), 0.0
    reflexes = Reflexes((0.0, 0.0, 6.0, 4.0), Thresholds(), np.array([accel]))
    speed, turn, pose, worst = 0.0, 0.0, np.array([start]), -math.inf
    late = [(0.0, 0.0)] * (5 + dead_ticks)
    for speed_wish, turn_wish in wishes:
        for _ in range(50):
            commands.update(applied, now_s)
            now_s += TICK_S
            wish = np.array([[speed_wish, turn_wish]])
            reflexes.watch_geofence(pose, np.array([[speed, turn]]), wish, commands.underway)
            applied[0] = min(max(speed_wish, reflexes.floor[0]), reflexes.ceiling[0]), turn_wish
            late.append((float(applied[0, 0]), turn_wish))
            target, turn = late.pop(0)
            speed += min(max(target - speed, -accel * TICK_S), accel * TICK_S)
            pose[0] += TICK_S * np.array([speed * math.cos(pose[0, 2]), speed * math.sin(pose[0, 2]), turn])
            worst = max(worst, -pose[0, 0], pose[0, 0] - 6.0, -pose[0, 1], pose[0, 1] - 4.0)
    return worst


POSES = st.tuples(st.floats(0.0, 6.0), st.floats(0.0, 4.0), st.floats(-math.pi, math.pi))


@settings(max_examples=200, deadline=None)
@given(POSES, st.floats(0.1, 4.0), st.lists(st.floats(-3.0, 3.0), min_size=1, max_size=6), st.integers(0, 10))
def test_whoever_drives_straight_never_crosses_the_fence(
    start: tuple[float, float, float], accel: float, speeds: list[float], dead_ticks: int
) -> None:
    """But for what it drives in one control period: it is seen and braked once in each."""
    period_m = TICK_S * max(abs(each) for each in speeds)
    assert furthest_out_m(start, accel, [(each, 0.0) for each in speeds], dead_ticks) <= max(0.01, period_m)


@settings(max_examples=200, deadline=None)
@given(
    POSES, st.floats(1.0, 4.0),
    st.lists(st.tuples(st.floats(-0.5, 0.5), st.floats(-4.0, 4.0)), min_size=1, max_size=6),
)  # fmt: skip
def test_whoever_turns_crosses_it_by_less_than_he_needs_to_brake(
    start: tuple[float, float, float], accel: float, wishes: list[tuple[float, float]]
) -> None:
    """Driving along an edge he may begin to turn towards it: nobody knew before, and he still rolls."""
    assert furthest_out_m(start, accel, wishes) <= 0.5 * 0.15 + 0.5**2 / (2.0 * accel)


# ------------------------------------------------------------------ pose, clock, world
def test_an_estimator_without_a_pose_or_one_that_fails(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object) -> np.ndarray:
        return np.full((1, 3), math.nan)

    def fails(*_: object) -> np.ndarray:
        raise np.linalg.LinAlgError("singular matrix")

    for broken in (unknown, fails):
        with monkeypatch.context() as patch:
            patch.setattr(bench.agent._estimator, "update", broken)
            assert bench.time_to_zero_s() <= TICK_S + 1e-9
            assert not bench.commanded.any()
        bench.run(0.1)
        assert bench.commanded.any(), "it goes on when the pose is back"


class LeapingClock(SimClock):
    """A clock that leaps without the timers' taking note: what a suspended computer wakes up with."""

    leap_s = 0.0

    def now_s(self) -> float:
        return super().now_s() + self.leap_s


def leap(bench: Bench, seconds: float) -> None:
    """Let the clock leap between two ticks."""
    clock = bench.runtime.clock = LeapingClock(bench.runtime.now_s())
    clock.leap_s = seconds


def run_on(bench: Bench, seconds: float) -> None:
    clock = bench.runtime.clock
    assert isinstance(clock, LeapingClock)
    bench.runtime.run(seconds - clock.leap_s)


@pytest.mark.parametrize("seconds", [0.5, 3.0, 3600.0])
def test_after_a_leap_of_the_clock_nothing_old_moves_it(bench: Bench, seconds: float) -> None:
    bench.enable("move_to_goal", FAR, request_id="q2", survives_core=True)
    bench.run(0.2)
    assert bench.commanded.any()
    leap(bench, seconds)
    began_s = bench.runtime.now_s()
    bench.agent.tick()  # the very first one
    assert not bench.commanded.any()
    assert reason(bench) in (StopReason.CLOCK, StopReason.READING)
    while bench.runtime.now_s() < began_s + TTL_S - 1.5 * TICK_S:
        run_on(bench, TICK_S)
        assert not bench.commanded.any()
    run_on(bench, 0.2)
    assert bench.commanded.any(), "it goes on with what is new"


def test_a_command_from_before_the_leap_is_stale(bench: Bench) -> None:
    bench.enable("", {}, request_id="q-central", centralised=True, behaviour="central", survives_core=True)
    bench.command(0.3, sequence=100)
    bench.run(TICK_S)
    assert bench.commanded.any()
    leap(bench, 0.31)
    bench.agent.tick()
    assert not bench.commanded.any()
    run_on(bench, 1.0)
    assert not bench.commanded.any()
    assert reason(bench) is StopReason.STALE


def test_a_clock_that_goes_back_is_a_leap_too() -> None:
    def slept(now_s: float, before_s: float) -> bool:
        reflexes.watch_clock(now_s, before_s, TTL_S)
        return reflexes.clock_jumped

    reflexes = Reflexes((0.0, 0.0, 1.0, 1.0), Thresholds(), np.ones(1))
    ticks = ((10.0, 9.98), (5.0, 10.0), (5.29, 5.27), (5.31, 5.29))
    assert [slept(*each) for each in ticks] == [False, True, True, False]


def test_readings_that_stop_as_those_of_a_frozen_world(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    assert bench.agent.reading is not None
    frozen = bench.agent.reading
    monkeypatch.setattr(bench.agent.fleet, "read", lambda: frozen)
    took_s = bench.time_to_zero_s()
    assert took_s <= READING_S + TICK_S + 1e-9
    assert reason(bench) is StopReason.READING


def test_a_row_of_its_own_for_every_robot() -> None:
    reflexes = Reflexes((0.0, 0.0, 1.0, 1.0), Thresholds(battery_low=0.2), np.ones(2))
    reading = FleetReading(
        stamp_s=np.zeros(2), pose=np.zeros((2, 3)), odometry=np.zeros((2, 3)), twist=np.zeros((2, 2)),
        hazards=np.zeros(2, np.uint8), contacts=np.zeros(2, np.int64), battery=np.array([0.19, 0.5]),
        obstacles=NO_OBSTACLES, position_sigma_m=np.full(2, math.nan),
    )  # fmt: skip
    reflexes.update(reading, np.array([[0.0, 0.0, 0.0], [0.0, math.nan, 0.0]]))
    assert reflexes.battery_low.tolist() == [True, False]
    assert reflexes.pose_unknown.tolist() == [False, True]


@pytest.mark.parametrize("heading_rad", [0.0, 0.5 * math.pi])
def test_who_stands_in_a_corner_may_drive_along_the_edges(heading_rad: float) -> None:
    """The cosine of a right angle is no zero: without care a robot exactly on an edge could not leave along it."""
    made = Reflexes((0.0, 0.0, 20.0, 20.0), Thresholds(), np.ones(1))
    pose, along, out = np.array([[0.0, 0.0, heading_rad]]), np.array([[0.4, 0.0]]), np.array([[-0.4, 0.0]])
    made.watch_geofence(pose, along, along)
    assert made.ceiling[0] > 0.4
    made.watch_geofence(pose, out, out)
    assert made.floor[0] == 0.0


def test_a_late_make_states_what_its_stop_takes_beyond_its_brakes() -> None:
    """Others keep that much farther away when it falls silent; a prompt make states nothing."""
    heard: list[RobotStates] = []
    for world in ({"engine": "drivetrain", "drivetrain": {"dead_time_s": 0.1, "lag_s": 0.05}}, {}):
        bench = Bench([(2.0, 2.0, 0.0)], world=world)
        bench.bus.subscribe(bench.keys.state(), RobotStates, heard.append)
        bench.run(0.2)
        limits = bench.agent.fleet.descriptions[0].limits
        if world:
            expected = limits.stop_extra(heard[-1].speed_limit_m_s[0])
            assert (*heard[-1].stop_extra_m, *heard[-1].stop_extra_s) == pytest.approx(expected)
            assert expected[0] > 0.1 * heard[-1].speed_limit_m_s[0]
    assert heard[-1].stop_extra_m == heard[-1].stop_extra_s == ()


# ------------------------------------------------------------------ ranges
def test_a_range_sensor_that_falls_silent_stops_the_robot_until_it_scans_again(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench([(2.0, 10.0, 0.0)], world={"ranges": {"max_m": 4.0}})
    bench.enable("move_to_goal", FAR)
    bench.run(1.0)
    assert bench.commanded.any()
    with monkeypatch.context() as broken:
        broken.setattr(bench.simulated, "scan", lambda row: None)
        assert 0.4 < bench.time_to_zero_s() < 0.5 + 2 * TICK_S
        assert reason(bench) is StopReason.RANGES
        bench.run(3.0)
        assert not bench.commanded.any()
    bench.run(1.0)
    assert bench.commanded.any()


def test_a_robot_whose_range_sensor_never_scans_does_not_set_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("fullswarm.simulation.world.World.scan", lambda self, row: None)
    bench = Bench([(2.0, 10.0, 0.0)], world={"ranges": {"max_m": 4.0}})
    bench.enable("move_to_goal", FAR)
    bench.run(2.0)
    assert not bench.commanded.any()
    assert reason(bench) is StopReason.RANGES
