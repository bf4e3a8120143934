"""The engine with dead time, motor lag, soft brakes, unequal wheels and slip, against independent sums."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.config import WorldConfig
from fullswarm.simulation.world import World

DT_S = 0.02
IDEAL = {"dead_time_s": 0.0, "lag_s": 0.0, "slip": 0.0, "unequal_wheels": 0.0}


def world(engine: str = "drivetrain", seed: int = 0, robots: int = 1, **drivetrain: float) -> World:
    config = WorldConfig.model_validate(
        {"engine": engine, "seed": seed, "bounds_m": (-50.0, -50.0, 50.0, 50.0), "drivetrain": {**IDEAL, **drivetrain}}
    )
    return World(config, [f"r{row}" for row in range(robots)], [(3.0 * row, 0.0, 0.3) for row in range(robots)])


def drive(body: World, steps: int, twist: tuple[float, float]) -> list[tuple[float, float]]:
    """Return the measured twists of the first body."""
    found = []
    for _ in range(steps):
        body.set_twists(np.array([twist] * len(body.ids)))
        body.step()
        found.append(tuple(body.twist[0].tolist()))
    return found


def test_an_ideal_drivetrain_is_the_kinematic_engine() -> None:
    ideal, plain = world(), world("kinematic")
    for twist in ((0.5, 1.0), (-0.2, -3.0), (0.0, 0.0)):
        assert np.array(drive(ideal, 40, twist)) == pytest.approx(np.array(drive(plain, 40, twist)), abs=1e-9)
    assert ideal.pose == pytest.approx(plain.pose, abs=1e-9)


@pytest.mark.parametrize("dead_time_s", [0.05, 0.1, 0.15])
def test_a_command_has_no_effect_during_the_dead_time(dead_time_s: float) -> None:
    speeds = [speed for speed, _ in drive(world(dead_time_s=dead_time_s), 20, (0.5, 0.0))]
    idle = math.ceil(dead_time_s / DT_S - 1e-9)
    assert speeds[:idle] == [0.0] * idle
    assert speeds[idle] > 0.0


def test_soft_brakes_stop_in_the_distance_that_their_share_gives() -> None:
    body = world(brakes=0.5)
    drive(body, 50, (0.5, 0.0))
    start_m = float(np.hypot(*body.pose[0, :2]))
    drive(body, 50, (0.0, 0.0))
    went_m = float(np.hypot(*body.pose[0, :2])) - start_m
    assert body.twist[0, 0] == 0.0
    assert went_m == pytest.approx(0.5**2 / (2 * 0.5 * 2.0), abs=0.5 * DT_S)


def test_motors_follow_with_their_time_constant() -> None:
    body = world(lag_s=0.1)
    speeds = [speed for speed, _ in drive(body, 100, (0.5, 0.0))]
    # A first-order lag behind a ramp of a stays a times its constant behind, and ends where the ramp ends.
    assert 2.0 * DT_S * 10 - speeds[9] == pytest.approx(2.0 * 0.1, rel=0.3)
    assert speeds[-1] == pytest.approx(0.5, abs=1e-6)


@given(seed=st.integers(0, 2**31), share=st.floats(0.001, 0.05))
@settings(max_examples=25, deadline=None)
def test_wheels_bend_the_way_and_never_speed_a_body_up_beyond_their_share(seed: int, share: float) -> None:
    body = world(seed=seed, unequal_wheels=share, slip=share)
    drive(body, 100, (0.4, 0.0))
    before = body.pose.copy()
    drive(body, 50, (0.4, 0.0))
    went_m = float(np.hypot(*(body.pose - before)[0, :2]))
    assert 0.4 * (1.0 - 1.6 * share) <= went_m <= 0.4 * (1.0 + 0.5 * share) + 1e-9
    base_m = 0.235
    assert 0.0 < abs(body.pose[0, 2] - 0.3) <= 3.0 * 0.4 * 2.0 * share / base_m


def test_a_seed_repeats_and_another_differs() -> None:
    first, again, other = (world(seed=seed, slip=0.05, unequal_wheels=0.05, robots=3) for seed in (4, 4, 5))
    for each in (first, again, other):
        drive(each, 50, (0.5, 0.5))
    assert first.pose.tobytes() == again.pose.tobytes()
    assert not np.allclose(first.pose, other.pose, atol=1e-4)


def test_what_robots_state_covers_their_way_from_a_command_to_standstill() -> None:
    """From any speed, in any world: the measured way is within what `Limits` add up to; undeclared, it is not."""
    for seed in range(20):
        config = WorldConfig.model_validate({
            "engine": "drivetrain", "seed": seed, "bounds_m": (-50.0, -50.0, 50.0, 50.0),
            "drivetrain": {"brakes": 0.5, "dead_time_s": 0.1, "lag_s": 0.1},
        })  # fmt: skip
        body = World(config, ["r"], [(0.0, 0.0, 0.0)])
        drive(body, 80, (0.5, 0.0))
        before = body.pose[0, :2].copy()
        drive(body, 80, (0.0, 0.0))
        went_m = float(np.hypot(*(body.pose[0, :2] - before)))
        limits = body.descriptions[0].limits
        stated_m = 0.5 * limits.dead_time_s + 0.5**2 / (2.0 * limits.accel_m_s2) + limits.overrun_s * 0.5
        assert went_m <= stated_m + 0.5 * DT_S
        assert went_m > 0.5**2 / (2.0 * 2.0) + 0.05
