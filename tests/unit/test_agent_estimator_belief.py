"""Beliefs: how they move, widen and are corrected."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.agent.belief import CREEP_M, CREEP_RAD, Belief, Motion, between, distance
from fullswarm.agent.ekf import Corrector
from fullswarm.agent.track import Track
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
    belief = Belief.around(before, 0.1, 0.1)
    belief.move(motion)
    assert belief.mean[:2] == pytest.approx(after[:2], abs=1e-9)
    assert wrap(belief.heading_rad - after[2]) == pytest.approx(0.0, abs=1e-9)


@given(poses, st.lists(steps, min_size=1, max_size=20))
def test_the_covariance_is_that_of_the_linearised_motion_and_stays_one(
    pose: tuple[float, ...], path: list[tuple[float, ...]]
) -> None:
    belief = Belief.around(list(pose), 0.05, 0.1)
    expected = belief.covariance()
    for step in path:
        before, motion = belief.mean, Motion(step[0], step[1], step[2], 0.1)
        position, heading = NOISE.variances(motion)
        belief.move(motion)
        belief.widen(position, heading)
        dx, dy = belief.x_m - before[0], belief.y_m - before[1]
        jacobian = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
        expected = jacobian @ expected @ jacobian.T + np.diag([position, position, heading])
    assert belief.covariance() == pytest.approx(expected, rel=1e-9, abs=1e-12)
    assert np.linalg.eigvalsh(belief.covariance()).min() > 0.0
    assert belief.sound
    assert belief.position_sigma_m == pytest.approx(math.sqrt(np.linalg.eigvalsh(expected[:2, :2]).max()))


@given(poses, st.lists(st.floats(-1.0, 1.0), min_size=6, max_size=6))
def test_a_covariance_is_sound_when_all_its_axes_are(pose: tuple[float, ...], numbers: list[float]) -> None:
    belief = Belief(*pose, *numbers)
    least = np.linalg.eigvalsh(belief.covariance()).min()
    if abs(least) > 1e-6:
        assert belief.sound == (least > 0.0)


def test_the_distance_counts_standard_deviations() -> None:
    one, other = Belief.around([0.0, 0.0, math.pi], 0.3, 0.1), Belief.around([1.0, 0.0, -math.pi], 0.4, 0.1)
    assert distance(one, other) == pytest.approx(2.0)


correct = Corrector()


@given(poses, poses)
def test_a_correction_lies_between_what_was_believed_and_what_was_seen(
    pose: tuple[float, ...], other: tuple[float, ...]
) -> None:
    belief, seen = Belief.around(list(pose), 0.1, 0.1), Belief.around(list(other), 0.1, 0.1)
    turn = wrap(other[2] - pose[2])
    correct(belief, seen)
    assert belief.mean[:2] == pytest.approx([(pose[0] + other[0]) / 2, (pose[1] + other[1]) / 2])
    assert wrap(belief.heading_rad - pose[2] - turn / 2) == pytest.approx(0.0, abs=1e-9)
    assert belief.xx == pytest.approx(0.005)


def test_creep_alone_widens_a_belief() -> None:
    track = Track([0.0, 0.0, 0.0], True, 0.5, CONFIG, correct)
    track.follow(0.0, [0.0, 0.0, 0.0], [0.0, 0.0])
    track.follow(1.0, [0.0, 0.0, 0.0], [0.0, 0.0])
    assert track.sigma == pytest.approx((math.hypot(0.1, CREEP_M), math.hypot(0.1, CREEP_RAD)))
