"""Outliers, and robots that were carried or pushed: nobody's mistake moves a pose for long."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.agent.pose.estimator import Estimator
from fullswarm.agent.pose.pose_filter import Fix, Verdict
from fullswarm.drivers.base import Pose
from tests.unit.estimator_run import CONFIG, TICK_S, Run, both, reading


@both
@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_outliers_do_not_move_it(make: Callable[[], Estimator], seed: int) -> None:
    run = Run(make(), seed)
    run.find()
    verdicts: list[Verdict] = []
    for tick in range(1, 201):
        run.tick()
        if tick % 3 == 0:
            angle, far = run.rng.uniform(-math.pi, math.pi), run.rng.uniform(1.0, 5.0)
            verdicts.append(run.fix(off=(far * math.cos(angle), far * math.sin(angle), 0.0)))
            before = run.estimator.update(reading(run.now_s, run.odometry), 0.0)[0].tolist()
            assert before == run.pose  # a refused fix has changed nothing
        elif tick % 3 == 1:
            run.fix()
        assert run.error_m() < 0.2
    assert set(verdicts) == {Verdict.OUTLIER}


@both
def test_a_robot_that_was_carried_is_found_after_enough_fixes_that_agree(make: Callable[[], Estimator]) -> None:
    run = Run(make(), 5, speed_m_s=0.0)
    run.find()
    for _ in range(50):
        run.tick()
        assert run.fix() is Verdict.ACCEPTED
    run.truth = [5.0, 5.0, -1.0]
    carried_s = run.now_s
    verdicts: list[Verdict] = []
    while not verdicts or verdicts[-1] is Verdict.OUTLIER:
        run.tick()
        verdicts.append(run.fix())
    assert verdicts[-1] is Verdict.REANCHORED
    assert CONFIG.fix_reanchor_s <= run.now_s - carried_s < CONFIG.fix_reanchor_s + 0.1
    run.tick()
    assert run.error_m() < 0.1
    assert run.fix() is Verdict.ACCEPTED


@both
def test_it_takes_a_number_of_fixes_too_not_only_a_time(make: Callable[[], Estimator]) -> None:
    run = Run(make(), 6, speed_m_s=0.0)
    run.find()
    run.truth = [5.0, 5.0, -1.0]
    verdicts = []
    for _ in range(CONFIG.fix_reanchor_count):
        for _ in range(20):  # 0.4 s
            run.tick()
        verdicts.append(run.fix())
    assert verdicts == [Verdict.OUTLIER] * (CONFIG.fix_reanchor_count - 1) + [Verdict.REANCHORED]


@both
def test_fixes_that_disagree_with_each_other_never_win(make: Callable[[], Estimator]) -> None:
    run = Run(make(), 7, speed_m_s=0.0)
    run.find()
    for number in range(60):
        run.tick()
        assert run.fix(off=(3.0, 3.0 if number % 2 else -3.0, 0.0)) is Verdict.OUTLIER
    assert run.error_m() < 0.1


@both
@pytest.mark.parametrize("rate_ticks", [1, 2, 3, 10])
@pytest.mark.parametrize("sigma_m", [0.002, 0.05])
@pytest.mark.parametrize("pushed_m_s", [0.0, -0.4])
def test_it_stays_with_a_robot_whose_wheels_slip_or_that_is_pushed(
    make: Callable[[], Estimator], rate_ticks: int, sigma_m: float, pushed_m_s: float
) -> None:
    estimator, rng = make(), np.random.default_rng(11)
    odometry_m = truth_m = worst_m = 0.0
    refused = []
    for tick in range(1, 301):
        slips = tick > 100
        odometry_m += 0.5 * TICK_S * (not slips or pushed_m_s == 0.0)
        truth_m += (pushed_m_s if slips else 0.5) * TICK_S
        pose = estimator.update(reading(tick * TICK_S, [odometry_m, 0.0, 0.0], (0.5, 0.0)), TICK_S)[0]
        worst_m = max(worst_m, abs(pose[0] - truth_m))
        if tick % rate_ticks == 0:
            x_m, y_m = rng.normal([truth_m, 0.0], sigma_m)
            verdict = estimator.take(0, Fix(tick * TICK_S, Pose(x_m, y_m, 0.0), sigma_m, 0.02)).verdict
            refused.append(verdict is Verdict.OUTLIER)
    # Cameras of 2 mm are followed at once. Those of 5 cm are weighed against the odometry, which is all wrong here.
    if sigma_m < 0.01:
        assert np.mean(refused) < 0.1
        assert worst_m < 0.03 + 0.5 * TICK_S * rate_ticks
    else:
        assert worst_m < 0.7


# ---------------------------------------------------------------- the first fixes
@both
def test_one_wrong_first_fix_is_not_believed_and_does_not_keep_out_true_ones(make: Callable[[], Estimator]) -> None:
    run = Run(make(), 8, speed_m_s=0.0)  # put 2 m from where the file says
    assert run.fix(off=(2.0, 0.0, 0.0)) is Verdict.PENDING
    assert run.tick() == pytest.approx([0.0, 0.0, 0.0], abs=1e-3)
    verdicts = [run.fix() for _ in range(CONFIG.fix_first_count)]
    assert verdicts == [Verdict.PENDING] * (CONFIG.fix_first_count - 1) + [Verdict.ACCEPTED]
    run.tick()
    assert run.error_m() < 0.1


@both
def test_a_first_fix_that_fits_the_start_pose_counts_at_once(make: Callable[[], Estimator]) -> None:
    run = Run(make(), 9, speed_m_s=0.0)
    run.truth, run.past = [0.1, -0.1, 0.05], [(run.now_s, [0.1, -0.1, 0.05])]
    assert run.fix() is Verdict.ACCEPTED


@both
def test_a_wrong_first_cluster_is_left_again(make: Callable[[], Estimator]) -> None:
    run = Run(make(), 10, speed_m_s=0.0)
    for _ in range(CONFIG.fix_first_count):
        last = run.fix(off=(4.0, 1.0, 0.0))
    assert last is Verdict.ACCEPTED
    began_s = run.now_s
    while run.fix() is not Verdict.REANCHORED:
        run.tick()
    run.tick()
    assert run.error_m() < 0.1
    assert run.now_s - began_s < CONFIG.fix_reanchor_s + 0.2
