"""Odometry without fixes, and fixes without a heading."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from fullswarm.agent.pose.estimator import DirectEstimator, Estimator
from fullswarm.agent.pose.pose_filter import Fix, Verdict
from fullswarm.drivers.base import Pose
from tests.unit.estimator_run import CONFIG, FIX_M, FIX_RAD, MAKES, TICK_S, Run, both, reading


# ---------------------------------------------------------------- odometry alone
@both
def test_before_the_first_fix_it_is_odometry_on_the_start_pose_and_then_the_fix(make: Callable[[], Estimator]) -> None:
    estimator = make()
    assert estimator.update(reading(1.0, [1.0, 0.5, 0.1]), TICK_S)[0] == pytest.approx([1.0, 0.5, 0.1])
    verdicts = [
        estimator.take(0, Fix(1.0, Pose(7.0, 8.0, 2.0), 0.01, 0.01)).verdict for _ in range(CONFIG.fix_first_count)
    ]
    assert verdicts == [Verdict.PENDING] * (CONFIG.fix_first_count - 1) + [Verdict.ACCEPTED]
    assert estimator.update(reading(1.0, [1.0, 0.5, 0.1]), TICK_S)[0] == pytest.approx([7.0, 8.0, 2.0])


@both
def test_without_fixes_the_doubt_grows_as_the_error_does(make: Callable[[], Estimator]) -> None:
    ratios = []
    for seed in range(20):
        run = Run(make(), seed)
        run.find()
        sigmas = []
        for tick in range(500):
            run.tick()
            if tick % 100 == 0:
                sigmas.append(run.estimator.known_sigma(0))
        assert sigmas == sorted(sigmas)
        assert sigmas[-1][0] > 3.0 * sigmas[0][0]
        ratios.append(run.error_m() / run.estimator.known_sigma(0)[0])
    assert 0.3 < np.mean(ratios) < 1.6


@both
def test_odometry_that_was_reset_is_not_a_way(make: Callable[[], Estimator]) -> None:
    run = Run(make(), 9)
    for _ in range(50):
        run.tick()
        run.fix()
    pose = run.tick()
    run.odometry = [0.0, 0.0, 0.0]
    run.past.clear()
    assert run.tick() == pose
    assert run.fix() is Verdict.ACCEPTED


def test_a_pose_that_a_driver_no_longer_senses_is_carried_on() -> None:
    estimator = DirectEstimator(np.zeros((1, 3)))
    sensed = reading(1.0, [4.0, 0.0, 0.0])
    sensed.pose[0] = [2.0, 3.0, math.pi / 2]
    assert estimator.update(sensed, TICK_S) is sensed.pose
    assert estimator.update(reading(1.02, [4.01, 0.0, 0.0]), TICK_S)[0] == pytest.approx([2.0, 3.0, math.pi / 2])
    assert estimator.update(reading(1.04, [4.11, 0.0, 0.0]), TICK_S)[0] == pytest.approx([2.0, 3.1, math.pi / 2])


def test_nobody_knows_where_a_robot_is_that_nobody_has_placed() -> None:
    estimator = DirectEstimator(np.zeros((1, 3)), placed=[False])
    assert estimator.known_sigma(0) == (-1.0, -1.0)
    for number in range(CONFIG.fix_first_count):
        assert estimator.known_sigma(0) == (-1.0, -1.0)
        estimator.take(0, Fix(0.01 * number, Pose(1.0, 1.0, 1.0), 0.01, 0.02))
    assert estimator.known_sigma(0) == pytest.approx((0.01, 0.02))


# ---------------------------------------------------------------- fixes without a heading
def test_a_heading_that_nobody_saw_is_found_by_the_way_that_the_robot_took() -> None:
    run = Run(MAKES[1](), 10)
    run.truth = [0.0, 0.0, 0.1]  # it was put down 0.1 rad off
    run.past = [(0.0, run.truth)]
    for _ in range(400):
        run.tick()
        run.estimator.take(0, Fix(run.now_s, Pose(run.truth[0], run.truth[1], 0.0), FIX_M, math.pi))
    assert abs(run.error()[2]) < 0.05


def test_the_direct_estimator_keeps_its_own_heading_then() -> None:
    estimator = MAKES[0]()
    estimator.update(reading(1.0, [0.0, 0.0, 0.7]), TICK_S)
    for _ in range(CONFIG.fix_first_count):
        estimator.take(0, Fix(1.0, Pose(1.0, 2.0, 0.0), 0.01, math.pi))
    for x_m in (1.0, 1.01):
        assert estimator.take(0, Fix(1.0, Pose(x_m, 2.0, 0.0), 0.01, math.pi)).verdict is Verdict.ACCEPTED
    assert estimator.update(reading(1.0, [0.0, 0.0, 0.7]), TICK_S)[0] == pytest.approx([1.01, 2.0, 0.7])


@both
def test_a_break_in_the_odometry_widens_the_doubt_by_what_may_have_happened(make: Callable[[], Estimator]) -> None:
    run = Run(make(), 3)
    for _ in range(50):
        run.tick()
        run.fix()
    before = run.estimator.known_sigma(0)
    after = reading(run.now_s + 2.0, run.odometry)
    after.odometry_breaks = np.array([2])  # of two, one reading was lost
    pose = run.estimator.update(after, TICK_S)[0]
    position_m, heading_rad = run.estimator.known_sigma(0)
    assert position_m == pytest.approx(2.0 * 0.5 / math.sqrt(3.0), rel=0.1)  # 2 s at 0.5 m/s, either way
    assert heading_rad == pytest.approx(math.pi / math.sqrt(3.0), rel=0.05)
    again = reading(run.now_s + 2.1, run.odometry)
    again.odometry_breaks = np.array([2])
    assert run.estimator.update(again, TICK_S)[0] == pytest.approx(pose)
    assert run.estimator.known_sigma(0)[0] < 1.1 * position_m  # the same break counts once
    far = Pose(pose[0] + 0.8, pose[1] - 0.5, pose[2] + 1.0)
    assert run.estimator.take(0, Fix(run.now_s + 2.1, far, FIX_M, FIX_RAD)).verdict is Verdict.ACCEPTED
    assert run.estimator.known_sigma(0)[0] < 2.0 * max(before[0], FIX_M)
