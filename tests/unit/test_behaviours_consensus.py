"""Consensus and average consensus: the mean, the rate of the second-smallest eigenvalue, lost broadcasts."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fullswarm import Lab
from fullswarm.agent.behaviours import average_consensus, consensus
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array

from .points import DT_S, Points

AGREE = {"rate": 1.0, "wait_s": 1e3, "gain": 1.0}


def path(count: int) -> Array:
    """Return points 1 m apart, each of which has the one before and the one after within 1.2 m."""
    return np.stack([np.arange(float(count)), np.zeros(count)], axis=1)


def laplacian(near: Array) -> Array:
    """Return the Laplacian with Metropolis weights, by its definition."""
    degree = near.sum(axis=1)
    weights = near / (1.0 + np.maximum(degree[:, None], degree))
    found: Array = np.diag(weights.sum(axis=1)) - weights
    return found


@pytest.mark.parametrize("seed", [1, 2])
def test_estimates_keep_their_mean_and_converge_at_the_rate_of_lambda_2(seed: int) -> None:
    position = path(5)
    position[:, 1] = np.random.default_rng(seed).uniform(-0.3, 0.3, 5)
    near = np.linalg.norm(position[:, None] - position, axis=2) < 1.3
    values, modes = np.linalg.eigh(laplacian(near - np.eye(5)))
    points = Points(consensus, position, AGREE, reach_m=1.3)
    points.step(2)  # nothing is heard in the first step
    points.memory.estimate_m = position
    points.step()
    start = points.memory.estimate_m[:, 0].copy()
    for _ in range(600):
        points.step()
    error = points.memory.estimate_m[:, 0] - position[:, 0].mean()
    assert points.memory.estimate_m.mean(axis=0) == pytest.approx(position.mean(axis=0), abs=0.02)
    slowest = float(modes[:, 1] @ start) * math.exp(-values[1] * 600 * DT_S)
    assert float(modes[:, 1] @ error) == pytest.approx(slowest, rel=0.08)
    assert (points.moved == 0.0).all()


def test_robots_meet_at_the_point_they_have_agreed_on() -> None:
    points = Points(consensus, path(4), {**AGREE, "rate": 3.0, "wait_s": 10.0}, reach_m=1.2)
    points.step(1500)
    assert points.position == pytest.approx(np.tile([1.5, 0.0], (4, 1)), abs=0.03)


def test_the_mean_is_exact_on_a_path_and_becomes_the_result() -> None:
    position = path(9) ** 1.5
    points = Points(average_consensus, position, {"quantity": "x", "wait_s": 20.0}, reach_m=4.5, dt_s=0.1)
    points.step(199)
    assert points.memory.mean == pytest.approx(np.full(9, position[:, 0].mean()), rel=1e-3)
    assert (points.position == position).all()
    points.step(3)
    assert points.ended == dict.fromkeys(range(9), f"mean x: {position[:, 0].mean():.4g}")


def test_more_robots_than_fit_into_a_broadcast_are_refused() -> None:
    points = Points(average_consensus, path(32), {"quantity": "x", "wait_s": 20.0})
    with pytest.raises(ConfigError, match="32 robots are too many"):
        points.step()


@pytest.mark.parametrize("behaviour", ["average_consensus_bc", "consensus_bc"])
def test_a_network_that_loses_a_third_still_agrees(behaviour: str) -> None:
    starts = [[2.0 * k + 1.0, 2.0 + 3.0 * (k % 2), 0.0] for k in range(4)]
    settings = {"network.conditions": "loss=30%,delay=30ms±20"}
    with Lab(starts=starts, bounds=(0, 0, 9, 7), settings=settings) as lab:
        request = lab.request(behaviour, wait_s=7.0, says_m=3.8)
        lab.run(10.0)
        if behaviour == "average_consensus_bc":
            assert request.status is not None
            texts = [each.text for each in request.status.results]
            assert [float(text.removeprefix("mean x: ")) for text in texts] == pytest.approx([4.0] * 4, abs=0.02)
            return
        lab.run(8.0)
        places = lab.poses[:, :2]
        assert (lab.contacts == 0).all()
    assert np.linalg.norm(places - places.mean(axis=0), axis=1).max() < 1.2
    assert places.mean(axis=0) == pytest.approx([4.0, 3.5], abs=0.6)
