"""The filter is as certain as it is right, with fixes that come in time and with late ones."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.agent.pose.estimator import DirectEstimator, EkfEstimator, Estimator
from fullswarm.agent.pose.pose_filter import Fix, Verdict
from fullswarm.drivers.base import Pose
from tests.unit.estimator_run import CONFIG, FIX_M, MAKES, TICK_S, Run, both, reading


def covariance(estimator: Estimator) -> np.ndarray:
    assert isinstance(estimator, EkfEstimator | DirectEstimator)
    return estimator._filters[0].estimate.covariance()


# ---------------------------------------------------------------- the filter is as certain as it is right
@pytest.mark.parametrize(("late_ticks", "low", "high"), [(0, 2.4, 3.6), (5, 2.4, 3.6), (14, 2.4, 3.6)])
def test_the_normalised_error_is_that_of_three_degrees_of_freedom(late_ticks: int, low: float, high: float) -> None:
    squared = []
    for seed in range(30):
        run = Run(MAKES[1](), seed)
        for tick in range(1, 401):
            run.tick()
            if tick % 5 == 0 and tick > late_ticks:
                run.fix(late_ticks)
            if tick > 100 and tick % 50 == 0:
                run.tick()
                error = run.error()
                squared.append(error @ np.linalg.solve(covariance(run.estimator), error))
    # The mean of 180 is 3 ± 0.18 for an honest filter; one that ignores its odometry's noise has 20.
    assert low < np.mean(squared) < high


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([2, 5, 25]))
def test_it_is_nearer_the_truth_than_the_fixes_whatever_the_run(seed: int, every: int) -> None:
    run = Run(MAKES[1](), seed)
    errors = []
    for tick in range(1, 301):
        run.tick()
        if tick % every == 0:
            run.fix()
        if tick > 100:
            errors.append(run.error_m())
    mean_of_a_fix = FIX_M * math.sqrt(math.pi / 2.0)
    assert np.mean(errors) < (1.0 if every < 10 else 1.6) * mean_of_a_fix
    assert max(errors) < 10.0 * FIX_M


# ---------------------------------------------------------------- late fixes
@both
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), late_ticks=st.integers(0, 14))
def test_a_late_fix_counts_for_where_the_robot_was(make: Callable[[], Estimator], seed: int, late_ticks: int) -> None:
    run = Run(make(), seed, speed_m_s=0.5)
    for tick in range(1, 151):
        run.tick()
        if tick > 20 and tick % 2 == 0:
            run.fix(late_ticks)
        if tick > 60:
            run.tick()
            # Taken for the present, a fix of 0.28 s ago would be 14 cm off on the average.
            assert run.error_m() < 0.12


@both
def test_a_fix_between_two_readings_counts_for_its_own_moment(make: Callable[[], Estimator]) -> None:
    for at_s in (0.93, 1.0, 1.05):
        estimator = make()
        for tick in range(1, 51):
            estimator.update(reading(tick * TICK_S, [0.5 * tick * TICK_S, 0.0, 0.0], (0.5, 0.0)), TICK_S)
        for _ in range(CONFIG.fix_first_count):
            estimator.take(0, Fix(at_s, Pose(3.0 + 0.5 * at_s, 1.0, 0.0), 0.001, 0.001))
        pose = estimator.update(reading(1.02, [0.51, 0.0, 0.0]), TICK_S)[0]
        assert pose == pytest.approx([3.51, 1.0, 0.0], abs=1e-3)


@both
def test_a_fix_from_before_what_is_remembered_is_refused(make: Callable[[], Estimator]) -> None:
    run = Run(make(), 8)
    for _ in range(100):
        run.tick()
    pose = list(run.pose)
    assert run.estimator.take(0, Fix(0.5, Pose(9.0, 9.0, 0.0), 0.01, 0.01)).verdict is Verdict.TOO_OLD
    assert run.estimator.update(reading(run.now_s, run.odometry), 0.0)[0].tolist() == pose
