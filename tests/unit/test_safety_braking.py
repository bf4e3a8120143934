"""What a stop in sampled time takes, against the sum of its periods."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.agent.safety.barrier import approach_limit
from fullswarm.agent.safety.braking import fastest, stop_distance, way

most = st.floats(0.5, 20.0)
period_s = st.floats(0.005, 0.1)


def stopped(speed: float, most: float, period_s: float) -> float:
    """Return how far it goes from `speed` >= 0 to zero, gliding from command to command."""
    distance = 0.0
    while speed > 0.0:
        then = max(0.0, speed - most * period_s)
        distance += 0.5 * (speed + then) * period_s
        speed = then
    return distance


@given(speed=st.floats(0.0, 5.0), most=most, period_s=period_s)
def test_the_distance_of_a_stop_is_the_sum_of_its_periods(speed: float, most: float, period_s: float) -> None:
    assert stop_distance.plain(speed, most, period_s) == pytest.approx(stopped(speed, most, period_s), abs=1e-9)


@given(angle=st.floats(1e-6, 3.0), now=st.floats(0.0, 5.0), most=most, period_s=period_s)
def test_the_fastest_turn_and_its_stop_take_the_angle(angle: float, now: float, most: float, period_s: float) -> None:
    rate = fastest.plain(angle, now, most, period_s)
    if rate < 0.0:
        assert 0.5 * now * period_s > angle
        return
    first = max(rate, 0.5 * (now + rate)) * period_s
    assert first + stopped(rate, most, period_s) == pytest.approx(angle, abs=1e-9)


@given(speed=st.floats(0.001, 5.0), most=most, period_s=period_s)
def test_to_brake_takes_no_more_than_was_left_for_it(speed: float, most: float, period_s: float) -> None:
    then = max(0.0, speed - most * period_s)
    assert way.plain(speed, then, most, period_s) <= stop_distance.plain(speed, most, period_s) + 1e-12


@given(room_m=st.floats(1e-5, 5.0), accel=most, period_s=st.floats(0.005, 0.05))
def test_an_approach_at_the_limit_of_the_braking_barrier_never_needs_the_brakes(
    room_m: float, accel: float, period_s: float
) -> None:
    speed = 0.0
    for _ in range(400):
        then = min(speed + accel * period_s, approach_limit.plain(room_m, 0.0, accel, 3.0 * period_s))
        assert speed - then <= accel * period_s + 1e-9
        assert way.plain(speed, then, accel, period_s) <= room_m + 1e-9
        room_m -= max(then, 0.5 * (speed + then)) * period_s
        speed = then
    assert math.isfinite(room_m)
    assert room_m >= -1e-12
