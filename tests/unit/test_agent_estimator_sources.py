"""Several sources at once: an oblique camera, radio distances and late fixes make one honest estimate."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fullswarm.agent.pose.estimator import EkfEstimator
from fullswarm.agent.pose.pose_filter import Distance, Fix, Verdict
from fullswarm.drivers.base import Pose
from fullswarm.geometry import wrap
from tests.unit.estimator_run import MAKES, Run

ALONG_M, ACROSS_M, VIEW_RAD = 0.06, 0.01, 0.6
"""A camera that looks aslant: its error along the line of sight and across it, and that line's direction."""
TURN = np.array([[math.cos(VIEW_RAD), -math.sin(VIEW_RAD)], [math.sin(VIEW_RAD), math.cos(VIEW_RAD)]])
COVARIANCE = TURN @ np.diag([ALONG_M**2, ACROSS_M**2]) @ TURN.T
ANCHORS = ((-6.0, -6.0, 1.8), (8.0, -5.0, 2.0), (7.0, 8.0, 2.2), (-5.0, 7.0, 1.9))
RANGE_M = 0.05


def seen_aslant(run: Run, late_ticks: int = 0, heading: bool = True) -> Verdict:
    """Take a fix of the camera."""
    at_s, truth = run.past[-1 - late_ticks]
    noise = run.rng.multivariate_normal((0.0, 0.0), COVARIANCE)
    turned = truth[2] + run.rng.normal(0.0, 0.03)
    fix = Fix(
        at_s, Pose(truth[0] + noise[0], truth[1] + noise[1], wrap(turned)), ALONG_M, 0.03 if heading else math.pi,
        (COVARIANCE[0, 0], COVARIANCE[0, 1], COVARIANCE[1, 1]), "camera",
    )  # fmt: skip
    return run.estimator.take(0, fix).verdict


def ranged(run: Run, number: int, late_ticks: int = 0) -> Verdict:
    """Take the distance to an anchor."""
    at_s, truth = run.past[-1 - late_ticks]
    x, y, up = ANCHORS[number % len(ANCHORS)]
    away = math.sqrt((truth[0] - x) ** 2 + (truth[1] - y) ** 2 + up * up) + run.rng.normal(0.0, RANGE_M)
    return run.estimator.take_distance(0, Distance(at_s, x, y, up, away, RANGE_M)).verdict


def follow(seed: int, camera: int, ranges: int, late_ticks: int = 0) -> tuple[list[float], list[float]]:
    """Drive 10 s with a fix each `camera` ticks and a distance each `ranges` (0: none); return errors (m) and squares.

    The squares are normalised by the filter's own covariance: 3 on average if it is honest.
    """
    run = Run(MAKES[1](), seed)
    run.find()
    assert isinstance(run.estimator, EkfEstimator)
    errors, squares = [], []
    for tick in range(1, 501):
        run.tick()
        if camera and tick % camera == 0 and tick > late_ticks:
            seen_aslant(run, late_ticks)
        if ranges and tick % ranges == 0 and tick > late_ticks:
            ranged(run, tick // ranges, late_ticks)
        if tick > 150:
            errors.append(run.error_m())
        if tick > 150 and tick % 50 == 0:
            run.tick()
            error = run.error()
            covariance = run.estimator._filters[0].estimate.covariance()
            squares.append(float(error @ np.linalg.solve(covariance, error)))
    return errors, squares


@pytest.mark.parametrize(
    ("camera", "ranges", "late_ticks"), [(5, 0, 0), (5, 0, 4), (0, 3, 0), (0, 3, 4), (5, 3, 0), (10, 3, 6)]
)
def test_any_mixture_is_as_certain_as_it_is_right(camera: int, ranges: int, late_ticks: int) -> None:
    squares = [each for seed in range(30) for each in follow(seed, camera, ranges, late_ticks)[1]]
    assert 2.3 < np.mean(squares) < 3.7


def test_both_sources_together_are_better_than_each_alone() -> None:
    alone, other, both = (
        np.mean([each for seed in range(12) for each in follow(seed, camera, ranges)[0]])
        for camera, ranges in ((10, 0), (0, 5), (10, 5))
    )
    assert both < 0.9 * min(alone, other)


def test_a_camera_aslant_counts_by_its_ellipse_and_not_by_its_worse_axis() -> None:
    across = []
    for seed in range(20):
        run = Run(MAKES[1](), seed)
        run.find()
        for tick in range(1, 301):
            run.tick()
            if tick % 5 == 0:
                seen_aslant(run)
            if tick > 100:
                error = run.error()
                across.append(-math.sin(VIEW_RAD) * error[0] + math.cos(VIEW_RAD) * error[1])
    assert np.std(across) < 1.2 * ACROSS_M


def test_positions_without_a_heading_find_it_when_the_robot_drives() -> None:
    errors = []
    for seed in range(10):
        run = Run(EkfEstimator(np.zeros((1, 3)), np.full((1, 2), 0.05), placed=[False], top_speed_m_s=[0.5]), seed)
        for tick in range(1, 1001):
            run.tick()
            if tick % 5 == 0:
                seen_aslant(run, heading=False)
        errors.append(abs(run.error()[2]))
    assert max(errors) < 0.2
