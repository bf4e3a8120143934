"""Beliefs: how they move, widen and are corrected."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.agent.pose.pose_filter import (
    CREEP_M,
    CREEP_RAD,
    Displacement,
    PoseEstimate,
    PoseFilter,
    between,
    distance,
    fuse,
)
from fullswarm.geometry import wrap
from tests.unit.estimator_run import CONFIG, NOISE, moved, poses, steps


@given(poses, steps)
def test_the_motion_between_two_poses_leads_from_one_to_the_other(
    pose: tuple[float, ...], step: tuple[float, ...]
) -> None:
    before = list(pose)
    after = moved(before, *step)
    motion = between(before, after, 1.0)
    assert (motion.ahead_m, motion.left_m, motion.turn_rad) == pytest.approx(step, abs=1e-9)
    estimate = PoseEstimate.around(before, 0.1, 0.1)
    estimate.move(motion)
    assert estimate.mean[:2] == pytest.approx(after[:2], abs=1e-9)
    assert wrap(estimate.heading_rad - after[2]) == pytest.approx(0.0, abs=1e-9)


@given(poses, st.lists(steps, min_size=1, max_size=20))
def test_the_covariance_is_that_of_the_linearised_motion_and_stays_one(
    pose: tuple[float, ...], path: list[tuple[float, ...]]
) -> None:
    estimate = PoseEstimate.around(list(pose), 0.05, 0.1)
    expected = estimate.covariance()
    for step in path:
        before, motion = estimate.mean, Displacement(step[0], step[1], step[2], 0.1)
        position, heading = NOISE.variances(motion)
        estimate.move(motion)
        estimate.widen(position, heading)
        dx, dy = estimate.x_m - before[0], estimate.y_m - before[1]
        jacobian = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
        expected = jacobian @ expected @ jacobian.T + np.diag([position, position, heading])
    assert estimate.covariance() == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert np.linalg.eigvalsh(estimate.covariance()).min() > 0.0
    assert estimate.sound
    assert estimate.position_sigma_m == pytest.approx(math.sqrt(np.linalg.eigvalsh(expected[:2, :2]).max()))


@given(poses, st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6))
def test_a_covariance_is_sound_when_all_its_axes_are(pose: tuple[float, ...], numbers: list[float]) -> None:
    estimate = PoseEstimate(*pose, *numbers)
    least = np.linalg.eigvalsh(estimate.covariance()).min()
    if abs(least) > 1e-6:
        assert estimate.sound == (least > 0.0)


def test_the_distance_counts_standard_deviations() -> None:
    one, other = PoseEstimate.around([0.0, 0.0, math.pi], 0.3, 0.1), PoseEstimate.around([1.0, 0.0, -math.pi], 0.4, 0.1)
    assert distance(one, other) == pytest.approx(2.0)


@given(poses, poses)
def test_a_correction_lies_between_what_was_believed_and_what_was_seen(
    pose: tuple[float, ...], other: tuple[float, ...]
) -> None:
    estimate, seen = PoseEstimate.around(list(pose), 0.1, 0.1), PoseEstimate.around(list(other), 0.1, 0.1)
    turn = wrap(other[2] - pose[2])
    fuse(estimate, seen)
    assert estimate.mean[:2] == pytest.approx([(pose[0] + other[0]) / 2, (pose[1] + other[1]) / 2])
    assert wrap(estimate.heading_rad - pose[2] - turn / 2) == pytest.approx(0.0, abs=1e-9)
    assert estimate.xx == pytest.approx(0.005)


factors = st.lists(st.floats(-1.0, 1.0), min_size=9, max_size=9)


@given(poses, factors, poses, factors)
def test_a_correction_is_that_of_the_kalman_filter_in_matrices(
    pose: tuple[float, ...], spread: list[float], other: tuple[float, ...], noise: list[float]
) -> None:
    def around(mean: tuple[float, ...], numbers: list[float]) -> PoseEstimate:
        root = np.array(numbers).reshape(3, 3)
        estimate = PoseEstimate.around(list(mean), 1.0, 1.0)
        estimate.set(np.array(mean), root @ root.T + 0.01 * np.eye(3))
        return estimate

    estimate, seen = around(pose, spread), around(other, noise)
    before, measured = estimate.covariance(), seen.covariance()
    gain = before @ np.linalg.inv(before + measured)
    change = gain @ [other[0] - pose[0], other[1] - pose[1], wrap(other[2] - pose[2])]
    fuse(estimate, seen)
    assert estimate.mean[:2] == pytest.approx([pose[0] + change[0], pose[1] + change[1]], abs=1e-6)
    assert wrap(estimate.heading_rad - pose[2] - change[2]) == pytest.approx(0.0, abs=1e-6)
    assert estimate.covariance() == pytest.approx((np.eye(3) - gain) @ before, abs=1e-6)
    assert estimate.sound


def test_creep_alone_widens_a_belief() -> None:
    pose_filter = PoseFilter([0.0, 0.0, 0.0], True, 0.5, CONFIG, fuse)
    pose_filter.follow(0.0, [0.0, 0.0, 0.0], [0.0, 0.0])
    pose_filter.follow(1.0, [0.0, 0.0, 0.0], [0.0, 0.0])
    assert pose_filter.sigma == pytest.approx((math.hypot(0.05, CREEP_M), math.hypot(0.05, CREEP_RAD)))
