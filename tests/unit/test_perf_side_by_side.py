"""A swarm in lockstep: what its summarizers say against what the true bodies did."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from fullswarm.config import SwarmConfig
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import RequestStatus
from fullswarm.operator.client import Operator
from fullswarm.perf.truth import SupervisorCalculator, Truth

GOALS: list[float | list[float]] = [[7.0, 3.0], [1.0, 3.2], [4.2, 5.5], [4.0, 0.6]]
STARTS = [(1.0, 3.0, 0.0), (7.0, 3.1, 3.0), (4.0, 0.5, 1.5), (4.1, 5.4, -1.5)]
REACH_M = 0.2


def run(noise_m: float, **performance: Any) -> tuple[Truth, dict[str, float], dict[str, str]]:
    """Let four robots cross; return the truth, the summaries' values and why their summarizers halted."""
    config = SwarmConfig.model_validate(
        {
            "world": {"engine": "kinematic", "bounds_m": (0.0, 0.0, 8.0, 6.0), "noise": {"position_m": noise_m}},
            "performance": {"arrive_radius_m": REACH_M, **performance},
            "robot": [{"id": f"r{row}", "pose": pose} for row, pose in enumerate(STARTS)],
        }
    )
    swarm, keys = Lockstep(config), Keys(config.swarm)
    operator = Operator(swarm.bus, keys, swarm.runtime, "test")
    answers: list[RequestStatus] = []
    try:
        swarm.run(1.0)
        operator.request("formation_bc", (), {"targets": GOALS}, answers.append)
        truth = Truth(config.robots, np.full(4, 0.17), np.array(GOALS), REACH_M, config.bounds_m, 0.1)
        world = swarm.world
        swarm.runtime.every(
            world.dt_s, lambda: truth.sample(world.time_s, world.pose, world.twist, world.dt_s, world.contacts)
        )
        supervisor = SupervisorCalculator(swarm.bus, keys, swarm.runtime, truth)
        swarm.run(40.0)
        supervisor.publish()
        for agent in swarm.agents:
            agent.publish_measurements()
        swarm.runtime.mailbox.drain()
        assert answers[-1].phase == "running"
        summaries = [each for summarizer in swarm.summarizers for each in summarizer.summaries()]
    finally:
        operator.close()
        swarm.close()
    values = {f"{each.metric}.{name}": value for each in summaries for name, value in each.values.items()}
    return truth, values, {each.metric: each.reason for each in summaries}


@pytest.mark.parametrize("noise_m", [0.0, 0.02])
def test_the_swarm_and_the_truth_agree(noise_m: float) -> None:
    truth, onboard, _ = run(noise_m)
    true = truth.values()
    assert true["arrival.fraction"] == onboard["arrival.fraction"] == 1.0
    assert true["collisions.events"] == onboard["collisions.events"] == 0.0
    # Odometry of this world is exact: what is left is the period of looking, and noise of poses.
    assert onboard["work.total_m"] == pytest.approx(true["work.total_m"], rel=0.01)
    assert onboard["energy.total_j"] == pytest.approx(true["energy.total_j"], rel=0.02)
    slack_m = 0.02 + 4.0 * noise_m
    assert onboard["coverage.area_m2"] == pytest.approx(true["coverage.area_m2"], rel=0.01 + 10.0 * noise_m)
    assert onboard["separation.min_m"] == pytest.approx(true["separation.min_m"], abs=0.05 + slack_m)
    assert onboard["arrival.mean_s"] == pytest.approx(true["arrival.mean_s"], abs=0.3 + 10.0 * noise_m)
    assert onboard["formation.error_m"] == pytest.approx(true["formation.error_m"], abs=slack_m)
    assert onboard["shape.spacing_m"] == pytest.approx(true["shape.spacing_m"], abs=slack_m)
    assert onboard["shape.diameter_m"] == pytest.approx(true["shape.diameter_m"], abs=slack_m)
    assert onboard["filter.total_m"] > 0.0  # they had to give way
    for name, value in true.items():
        metric, _, quantity = name.partition(".")
        if metric != "separation":  # the smallest gap is not published by a supervisor
            assert onboard[f"{metric}.truth_{quantity}"] == pytest.approx(value), name


def test_the_trial_is_over_when_all_have_arrived() -> None:
    truth, onboard, reasons = run(0.0, all_arrived=True, stalled_s=20.0)
    assert reasons["arrival"] == reasons["energy"] == "all_arrived"
    assert reasons["work"] == ""
    last_s = truth.values()["arrival.last_s"]
    assert onboard["arrival.elapsed_s"] == pytest.approx(last_s + 0.5, abs=0.6)  # robots tell from 0.5 s on


def test_the_trial_is_over_when_nobody_moves_any_more() -> None:
    _, onboard, reasons = run(0.0, stalled_s=5.0)
    assert reasons["arrival"] == "stalled_s"
    assert onboard["arrival.elapsed_s"] < 40.0
