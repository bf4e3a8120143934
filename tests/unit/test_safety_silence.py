"""Data that is old or missing makes the safe set smaller: silent neighbours, old poses, unknown poses, blind robots."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.agent.neighbours import estimates
from fullswarm.agent.neighbours.estimates import Assumed, CellSubscriptions, Neighbours, Predicted, Received
from fullswarm.agent.safety.filter import (
    BLIND,
    CROWDED,
    EXPLAIN,
    FREE,
    Measured,
    Requested,
    SafetyFilter,
    Tuning,
    robot_params,
)
from fullswarm.bus.local import LocalBus
from fullswarm.drivers.base import NO_OBSTACLES, Description, Limits
from fullswarm.keys import Keys
from fullswarm.messages import RobotStates
from fullswarm.runtime import Mailbox

ACCEL, SPEED, TURN, HALT_S, TIMEOUT_S = 2.0, 0.5, 4.25, 1.3, 1.0
ASSUMED = Assumed(ACCEL, SPEED, TURN, HALT_S)
HERE = np.zeros((1, 2))
BOUNDS = np.array([-50.0, -50.0, 50.0, 50.0])


def state(x: float, y: float, speed: float = 0.0, sequence: int = 1, robot: str = "other") -> RobotStates:
    return RobotStates(
        host=robot, sequence=sequence, stamp_s=0.1 * sequence, robots=(robot,), x_m=(x,), y_m=(y,), heading_rad=(0.0,),
        speed_m_s=(speed,), turn_rad_s=(0.0,), radius_m=(0.17,),
    )  # fmt: skip


def table() -> Neighbours:
    return Neighbours(("me",), TIMEOUT_S, ASSUMED)


def one_filter() -> SafetyFilter:
    limits = Limits(SPEED, TURN, ACCEL, 20.0)
    robots = robot_params(
        (Description("any", "any", 0.17, limits),), np.array([SPEED]), np.array([TURN]), np.array([True])
    )
    return SafetyFilter(("me",), robots, Tuning(0.02, 3.0, 1.0, 3.0), BOUNDS)


def go(
    others: Neighbours, now_s: float, wish: tuple[float, float] = (0.5, 0.0), pose: tuple[float, ...] = (0.0, 0.0, 0.0),
    stamp_s: float | None = None, made: SafetyFilter | None = None,
) -> float:  # fmt: skip
    """Return the speed that the filter lets through at the origin, heading east."""
    made, twists = made or one_filter(), np.array([[0.5, 0.0]])
    others.set_time(now_s)
    near = others.around(HERE, 3.0)
    requested = Requested(np.array([wish]), np.ones(1, bool), np.array([2.0]), np.array([0.03]))
    measured = Measured(
        np.array([pose]), np.zeros((1, 2)), np.array([now_s if stamp_s is None else stamp_s]), np.zeros((1, 2))
    )
    made.apply(now_s, requested, measured, near, NO_OBSTACLES, twists)
    return float(twists[0, 0])


def stating(message: RobotStates, **columns: float) -> RobotStates:
    return msgspec.structs.replace(message, **{name: (value,) for name, value in columns.items()})


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.3), st.sampled_from([0.2, 1.0, 4.0, None]))
@settings(max_examples=300, deadline=None)
def test_a_robot_is_always_in_the_disc_where_it_is_believed(seed: int, age_s: float, times: float | None) -> None:
    """Whether it states limits, lower or higher than those of this robot, or none and has the same."""
    rng = np.random.default_rng(seed)
    others, dt_s = table(), 0.001
    accel, top_speed, top_turn = np.array([ACCEL, SPEED, TURN]) * (times or 1.0)
    pose, speed, turn = np.array([1.0, 2.0, 0.0]), rng.uniform(-top_speed, top_speed), rng.uniform(-top_turn, top_turn)
    heard = stating(state(1.0, 2.0, speed), turn_rad_s=turn)
    if times:
        heard = stating(heard, speed_limit_m_s=top_speed, turn_limit_rad_s=top_turn, accel_m_s2=accel)
    others.receive(heard, 0.0)
    goal_speed, goal_turn = rng.choice([-1.0, 0.0, 1.0]) * top_speed, rng.choice([-1.0, 0.0, 1.0]) * top_turn
    for _ in range(round(age_s / dt_s)):
        speed += float(np.clip(goal_speed - speed, -accel * dt_s, accel * dt_s))
        turn = float(goal_turn)
        pose += dt_s * np.array([speed * math.cos(pose[2]), speed * math.sin(pose[2]), turn])
    others.set_time(age_s)
    others.around(HERE, 3.0)
    # What the prediction's straight chord leaves out is of third order in the age.
    assert math.dist(others.places[0], pose[:2]) <= others.spread_m[0] + top_speed * top_turn**2 * age_s**3 / 24 + 2e-3


@pytest.mark.parametrize("count", [1, 2])
def test_a_robot_that_states_no_limits_any_more_is_taken_for_one_like_this(count: int) -> None:
    """A host of one robot and one of several are taken in by different code."""
    robots = tuple(f"r{row}" for row in range(count))
    plain = RobotStates(
        host="h", sequence=1, stamp_s=0.1, robots=robots, x_m=(1.0,) * count, y_m=(0.0,) * count,
        heading_rad=(0.0,) * count, speed_m_s=(0.0,) * count, turn_rad_s=(0.0,) * count, radius_m=(0.17,) * count,
    )  # fmt: skip
    fast = {"speed_limit_m_s": 2.0, "turn_limit_rad_s": 1.0, "accel_m_s2": 8.0}
    stated = msgspec.structs.replace(plain, **{name: (value,) * count for name, value in fast.items()})
    others, spreads = table(), []
    for number, message in enumerate((plain, stated, plain)):
        others.receive(msgspec.structs.replace(message, sequence=number + 1, stamp_s=0.1 * number), 0.1 * number)
        others.set_time(0.1 * number + 0.1)
        others.around(HERE, 3.0)
        spreads.append(others.spread_m[:count].tolist())
    assert spreads[0] == pytest.approx([0.5 * 0.01 * ACCEL] * count)  # from standstill in whatever direction
    assert spreads[1] == pytest.approx([0.5 * 0.01 * 8.0] * count)
    assert spreads[2] == pytest.approx(spreads[0])


def test_the_room_shrinks_with_age_and_stays_gone() -> None:
    others = table()
    others.receive(state(0.75, 0.0), 0.0)
    speeds = [go(others, age_s) for age_s in (0.0, 0.05, 0.2, 0.5, 0.9, 1.05, 1.4, 10.0, 3600.0)]
    assert speeds == sorted(speeds, reverse=True)
    assert speeds[0] > 0.3
    assert speeds[-1] == 0.0


def test_a_silent_neighbour_is_gone_for_laws_and_stands_for_the_filter() -> None:
    others = table()
    others.receive(state(1.0, 0.0, speed=0.3), 0.0)
    others.set_time(2.0)
    assert others.within(HERE, 3.0)[0].tolist() == [0, 0]
    start, other, *_ = others.around(HERE, 3.0)
    assert start.tolist() == [0, 1]
    assert others.silent == 1
    row = other[0]
    disc = [*others.places[row].tolist(), others.spread_m[row]]
    assert disc[2] < SPEED * HALT_S + SPEED**2 / (2 * ACCEL)  # no farther than at full speed from the start
    others.set_time(200.0)
    others.around(HERE, 3.0)
    assert [*others.places[row].tolist(), others.spread_m[row]] == disc


@given(
    st.integers(0, 2**32 - 1), st.floats(0.0, 0.3), st.floats(0.0, 0.3), st.sampled_from([0.5, 4.0]), st.booleans(),
    st.floats(0.0, 8.0),
)  # fmt: skip
@settings(max_examples=100, deadline=None)
def test_the_disc_of_a_silent_robot_holds_it_when_its_motors_answer_late_and_stop_slowly(
    seed: int, dead_s: float, lag_s: float, top_speed: float, alone: bool, age_s: float
) -> None:
    """Motors of the first order behind a dead time; the set-point is any at all until it is zero."""
    rng, others, dt_s = np.random.default_rng(seed), table(), 0.002
    accel, top_turn = 2.0, 1.0
    extra_m, extra_s = Limits(
        top_speed, top_turn, accel, 20.0, overrun_s=lag_s, overrun_m=lag_s * top_speed, dead_time_s=dead_s
    ).stop_extra(top_speed)
    speed = ramp = top_speed * float(rng.choice([1.0, 0.3]))
    heard = stating(
        state(1.0, 2.0, speed), speed_limit_m_s=top_speed, turn_limit_rad_s=top_turn, accel_m_s2=accel,
        stop_extra_m=extra_m, stop_extra_s=extra_s,
    )  # fmt: skip
    if not alone:  # a host of several robots is taken in by other code
        columns = {name: value * 2 for name in msgspec.structs.asdict(heard)
                   if isinstance(value := getattr(heard, name), tuple) and name != "robots"}  # fmt: skip
        heard = msgspec.structs.replace(heard, robots=("other", "second"), **columns)
    others.receive(heard, 0.0)
    pose, turn = np.array([1.0, 2.0, 0.0]), float(rng.choice([-1.0, 0.0, 1.0])) * top_turn
    wanted = [top_speed] * round((HALT_S + dead_s) / dt_s)
    for tick in range(round(age_s / dt_s)):
        target = wanted[tick] if tick < len(wanted) else 0.0
        ramp += float(np.clip(target - ramp, -accel * dt_s, accel * dt_s))
        speed += (ramp - speed) * (1.0 - math.exp(-dt_s / lag_s)) if lag_s > 1e-3 else ramp - speed
        pose += dt_s * np.array([speed * math.cos(pose[2]), speed * math.sin(pose[2]), turn])
    others.set_time(age_s)
    others.around(HERE, 3.0)
    assert math.dist(others.places[0], pose[:2]) <= others.spread_m[0] + 5e-3
    if others.at_rest(age_s)[0]:
        assert abs(speed) <= 0.05 * top_speed


def test_a_robot_whose_limits_are_not_stated_stops_as_late_as_this_one() -> None:
    late, prompt = Neighbours(("me",), TIMEOUT_S, ASSUMED._replace(extra_m=0.2, extra_s=0.5)), table()
    for others in (late, prompt):
        others.receive(state(1.0, 0.0), 0.0)
        others.set_time(5.0)
        others.around(HERE, 3.0)
    assert late.spread_m[0] == pytest.approx(prompt.spread_m[0] + 0.2)
    stop_s = HALT_S + SPEED / ACCEL
    assert prompt.at_rest(stop_s + 0.1)[0]
    assert not late.at_rest(stop_s + 0.1)[0]
    assert late.at_rest(stop_s + 0.6)[0]


def test_who_is_inside_the_disc_of_a_silent_robot_may_leave_it() -> None:
    others = table()
    others.receive(state(0.5, 0.0), 0.0)
    assert go(others, 5.0, (0.5, 0.0)) == 0.0
    assert go(others, 5.0, (-0.5, 0.0)) == pytest.approx(-0.5)


def test_a_silent_robot_that_is_heard_again_is_where_it_says() -> None:
    others = table()
    others.receive(state(0.5, 0.0), 0.0)
    assert go(others, 5.0) == 0.0
    others.receive(state(9.0, 0.0, sequence=2), 5.0)
    assert go(others, 5.0) == 0.5


def test_a_state_that_is_no_number_does_not_make_a_robot_vanish() -> None:
    others = table()
    others.receive(state(0.5, 0.0), 0.0)
    others.receive(state(math.nan, 0.0, sequence=2), 0.5)
    assert go(others, 1.0) == 0.0


def test_silence_where_nobody_listens_says_nothing() -> None:
    mailbox = Mailbox()
    others = table()
    listening = CellSubscriptions(
        LocalBus(mailbox), Keys("swarm").state, RobotStates, 3.0, lambda states: others.receive(states, 0.0)
    )
    listening.follow(np.array([[1.5, 1.5]]), 3.0)  # cells from -3 to 6 m
    others.receive(state(2.0, 2.0, robot="dead"), 0.0)
    others.receive(state(5.95, 2.0, robot="leaving"), 0.0)
    others.forget(0.2, listening.covers)
    assert np.isfinite(others.arrival_s[:2]).all(), "nobody is silent yet"
    others.forget(1.0, listening.covers)
    assert np.isfinite(others.arrival_s[:2]).tolist() == [True, False]
    listening.follow(np.array([[40.0, 1.5]]), 3.0)
    others.forget(1.0, listening.covers)
    assert not np.isfinite(others.arrival_s[0])
    listening.close()


def test_an_old_own_pose_costs_room() -> None:
    others = table()
    others.receive(state(0.9, 0.0), 1.0)
    made = one_filter()
    fresh = go(others, 1.0, made=made)
    old = go(others, 1.0, stamp_s=0.7, made=made)
    assert old < fresh


@pytest.mark.parametrize("wish", [(0.5, 0.0), (math.nan, math.nan)], ids=["velocity", "twist"])
def test_without_a_pose_it_brakes_and_says_why(wish: tuple[float, float]) -> None:
    made = one_filter()
    assert go(table(), 0.0, wish, (math.nan, 0.0, 0.0), made=made) == 0.0
    assert made.verdict[0] == BLIND
    assert made.note(0) == EXPLAIN[BLIND]
    assert go(table(), 0.1, wish, made=made) == 0.5
    assert made.verdict[0] == FREE


def test_a_robot_at_ones_own_place_leaves_no_way() -> None:
    others, made = table(), one_filter()
    others.receive(state(0.0, 0.0), 0.0)
    assert go(others, 0.0, made=made) == 0.0
    assert made.verdict[0] == CROWDED


def test_the_deviation_is_told_and_added_up() -> None:
    others, made = table(), one_filter()
    for tick in range(50):
        others.receive(state(0.4, 0.0, sequence=tick + 1), 0.02 * tick)
        go(others, 0.02 * tick, made=made)
    assert made.deviation_m_s[0] == pytest.approx(0.5, abs=0.05)
    assert made.deviation_m[0] == pytest.approx(0.5 * 49 * 0.02, rel=0.1)
    others.receive(state(9.0, 0.0, sequence=60), 1.0)
    go(others, 1.0, made=made)
    assert made.deviation_m_s[0] == 0.0


def test_old_and_new_states_share_one_kernel_for_all_who_are_heard() -> None:
    """The disc never jumps to a smaller one with age while nothing is heard."""
    received = Received(
        np.array([[1.0, 0.0, 0.0, 0.4, 1.0, 0.17]]),
        np.zeros(1),
        np.full((1, 5), np.nan),
        np.zeros((1, 2)),
        np.zeros(1),
        np.full((1, 4), np.nan),
    )
    out = Predicted(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1), np.zeros(1))
    sizes = []
    for age_s in np.linspace(0.0, 3.0, 301).tolist():
        estimates.predict(received, out, ASSUMED, 1, age_s, TIMEOUT_S)
        sizes.append(float(out.spread_m[0]))
    assert (np.diff(sizes) >= -1e-12).all()
