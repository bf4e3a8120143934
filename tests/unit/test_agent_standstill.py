"""Standing or not, judged by the make's noise: e-stops of a rover whose filter never shows zero, and health."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fullswarm.agent.motion.reflexes import Standstill
from fullswarm.agent.orders.estops import SETTLE_TIMEOUT_S
from fullswarm.drivers.base import EXACT, NO_OBSTACLES, Description, FleetReading, Limits
from fullswarm.drivers.base import Standstill as Noise
from fullswarm.drivers.mavlink.autopilot import FILTERED
from fullswarm.messages import EStopReceipt
from tests.unit.agent_bench import Bench
from tests.unit.rover_agent import Lab

CONFIRMED_S = 1.0
CREEP_M_S = 0.05
SEEDS = range(20)


def judged(noise: Noise, rows: list[tuple[float, float, float]], rate_hz: float = 20.0) -> list[bool]:
    """Return the judgement after each reading: position m, speed m/s, turn rate rad/s."""
    make = Description("test", "test", 0.3, Limits(1.0, 2.0, 1.0, 2.0), standstill=noise)
    judge, verdicts, heading = Standstill((make,), 50.0), [], 0.0
    for number, (x_m, speed_m_s, turn_rad_s) in enumerate(rows):
        heading += turn_rad_s / rate_hz
        reading = FleetReading(
            np.array([number / rate_hz]), np.full((1, 3), math.nan), np.array([[x_m, 0.0, heading]]),
            np.array([[speed_m_s, turn_rad_s]]), np.zeros(1, np.uint8), np.zeros(1, np.int64), np.full(1, -1.0),
            NO_OBSTACLES, np.full(1, math.nan),
        )  # fmt: skip
        judge.update(reading)
        verdicts.append(bool(judge.at_standstill[0]))
    return verdicts


# ------------------------------------------------------------------ the judgement alone
def test_wheel_encoders_are_believed_at_once() -> None:
    assert judged(EXACT, [(0.0, 0.2, 0.0), (0.01, 0.0, 0.0), (0.01, 0.0, 0.1)]) == [False, True, False]


def test_a_filter_is_watched_for_its_window() -> None:
    verdicts = judged(FILTERED, [(0.0, 0.03, 0.0)] * 12)
    assert verdicts == [False] * 8 + [True] * 4  # 0.4 s of readings at 20 Hz


@pytest.mark.parametrize("error_m_s", [-CREEP_M_S, 0.0, CREEP_M_S])
def test_a_creep_shows_in_the_position_whatever_the_velocity_says(error_m_s: float) -> None:
    rows = [(CREEP_M_S * number / 20.0, CREEP_M_S + error_m_s, 0.0) for number in range(60)]
    assert not any(judged(FILTERED, rows))


def test_turning_on_the_spot_and_swaying_are_motion() -> None:
    assert not any(judged(FILTERED, [(0.0, 0.0, 0.1)] * 40))
    assert not any(judged(FILTERED, [(0.02 * (number % 2), 0.0, 0.0) for number in range(40)]))


def test_what_has_no_odometry_does_not_stand() -> None:
    assert not any(judged(EXACT, [(math.nan, 0.0, 0.0)] * 3))


# ------------------------------------------------------------------ a rover as recorded
def confirmed(lab: Lab, order: str, within_s: float) -> EStopReceipt:
    lab.until(lambda: lab.confirmation(order) is not None, within_s)
    _, receipt = lab.confirmation(order) or pytest.fail("it was confirmed")
    return receipt


@pytest.mark.parametrize("seed", SEEDS)
def test_an_e_stop_of_a_standing_rover_is_confirmed_within_a_second(seed: int) -> None:
    lab = Lab(seed)
    lab.runtime.run(1.0 + 1.7 * seed)
    order, _ = lab.estop()
    assert confirmed(lab, order, CONFIRMED_S).rolled_m == 0.0, "noise is no way"
    lab.close()


@pytest.mark.parametrize("seed", SEEDS)
def test_an_e_stop_of_a_creeping_rover_is_never_confirmed(seed: int) -> None:
    lab = Lab(seed)
    lab.rover.creep_m_s = CREEP_M_S if seed % 2 else -CREEP_M_S
    lab.runtime.run(1.7 * seed)
    order, _ = lab.estop()
    lab.runtime.run(SETTLE_TIMEOUT_S + 1.0)
    assert lab.confirmation(order) is None
    assert [each.standing for _, each in lab.receipts] == [False, False], "at once, and after the time to settle"
    assert lab.receipts[-1][1].rolled_m > 0.15
    lab.rover.creep_m_s = 0.0
    confirmed(lab, order, CONFIRMED_S)
    lab.close()


def test_a_standing_rover_is_never_said_to_move() -> None:
    lab = Lab(3)
    lab.runtime.run(1.0)
    lab.health.clear()
    speeds = []
    for _ in range(600):
        lab.runtime.run(0.1)
        speeds.append(abs(float(lab.agent.twist[0, 0])))
        assert lab.standing
    assert not any(each.moving for each in lab.health)
    assert max(speeds) > 0.02, "the filter shows a speed, as the recorded one does"
    lab.close()


def test_a_driving_rover_is_confirmed_when_it_has_come_to_rest() -> None:
    lab = Lab(5)
    lab.drive()
    lab.until(lambda: lab.truth.speed_m_s > 0.95)
    begun_m = lab.truth.rolled_m
    order, pressed_s = lab.estop()
    lab.until(lambda: abs(lab.truth.speed_m_s) < 0.05)
    stood_s = lab.runtime.now_s()
    assert lab.confirmation(order) is None
    receipt = confirmed(lab, order, stood_s + CONFIRMED_S - lab.runtime.now_s())
    assert receipt.rolled_m == pytest.approx(lab.truth.rolled_m - begun_m, abs=FILTERED.wander_m + 0.05)
    assert lab.runtime.now_s() - pressed_s < 3.0
    lab.close()


# ------------------------------------------------------------------ exact makes, at any rate
@pytest.mark.parametrize("rate_hz", [10.0, 50.0, 200.0])
def test_wheels_that_stand_are_confirmed_after_two_periods(rate_hz: float) -> None:
    bench = Bench([(5.0, 5.0, 0.0)], agent_settings={"control_rate_hz": rate_hz})
    pressed_s = bench.runtime.now_s()
    bench.estop(True, "e")
    while not bench.receipts[-1].standing:
        bench.run(0.001)
        assert bench.runtime.now_s() < pressed_s + 1.0
    assert 2.0 / rate_hz < bench.runtime.now_s() - pressed_s <= 3.1 / rate_hz
