"""When a trial has come to rest, by trajectories that are made up."""

from __future__ import annotations

import numpy as np
import pytest

from fullswarm.evaluate.quiet import QUIET_S, Rest, quiet_after_s
from fullswarm.evaluate.trial_folder import Trajectory

STEP_S = 0.2


def run_of(x_m: np.ndarray, heading_rad: np.ndarray | None = None) -> Trajectory:
    """Return the trajectory of one robot that drives along x to a goal at 10 m."""
    pose = np.zeros((len(x_m), 1, 3), np.float32)
    pose[:, 0, 0] = x_m
    if heading_rad is not None:
        pose[:, 0, 2] = heading_rad
    return Trajectory(
        ids=("r1",), time_s=np.array([STEP_S * k for k in range(len(x_m))]), pose=pose,
        touching=np.zeros((len(x_m), 1), bool),
        goals=np.array([[10.0, 0.0]]), goal_radius_m=0.5, radius_m=np.array([0.17]), boxes=np.zeros((0, 5)),
        bounds_m=np.array([0.0, 0.0, 20.0, 20.0]),
    )  # fmt: skip


DRIVES = 0.1 * np.arange(51)  # 10 s, up to 5 m
STANDS = np.full(50, 5.0)


def test_motion_after_the_last_progress_counts_until_it_ends() -> None:
    turns = np.concatenate([np.zeros(51), 0.1 * np.arange(20), np.full(30, 1.9)])
    assert quiet_after_s(run_of(np.concatenate([DRIVES, STANDS]))) == pytest.approx(0.0)
    assert quiet_after_s(run_of(np.concatenate([DRIVES, STANDS]), turns)) == pytest.approx(20 * STEP_S, abs=STEP_S)


def test_who_moves_to_and_fro_to_the_end_is_never_quiet_and_who_arrives_is_not_asked() -> None:
    restless = STANDS + 0.005 * (np.arange(50) % 2)
    assert quiet_after_s(run_of(np.concatenate([DRIVES, restless]))) is None
    assert quiet_after_s(run_of(np.concatenate([DRIVES, DRIVES + 5.0]))) is None
    assert quiet_after_s(run_of(np.concatenate([DRIVES, STANDS[: round(QUIET_S / STEP_S) - 2]]))) is None


def test_rest_lasts_from_the_last_motion_whatever_the_noise() -> None:
    rest, noise = Rest(), np.random.default_rng(1)
    for k in range(50):
        assert rest.lasts_s(0.1 * k, np.array([[0.1 * k, 0.0, 0.0]])) == 0.0
    for k in range(50, 100):
        at = np.array([[4.9, 0.0, 0.0]]) + np.array([[*noise.normal(0.0, 0.001, 2), 0.0]])
        assert rest.lasts_s(0.1 * k, at) == pytest.approx(0.1 * (k - 49), abs=1e-9)
    assert rest.lasts_s(10.0, np.array([[4.9, 0.0, 0.2]])) == 0.0
