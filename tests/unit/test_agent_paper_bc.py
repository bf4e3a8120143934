"""The paper's own filter: right for bodies that move in any direction, wrong for unicycles, never on real robots."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import osqp
import pytest
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.agent.behaviours import paper_bc
from fullswarm.agent.view import Params, View
from fullswarm.evaluate.experiment import load_experiment
from fullswarm.evaluate.experiment.plan import Trial, plan
from fullswarm.evaluate.lockstep_swarm import run_trial
from tests.unit.agent_bench import Bench

RADIUS_M, MARGIN_M, GAIN = 0.17, 0.03, 2.0
BOUNDS = (0.0, 0.0, 6.0, 6.0)
PARAMETERS: dict[str, Any] = {
    "goal": [4.0, 4.0], "gain": 1.0, "arrive_radius_m": 0.05, "safety_margin_m": MARGIN_M, "barrier_gain_per_s": GAIN,
}  # fmt: skip


def view(position: np.ndarray, speed_limit_m_s: float, obstacles: np.ndarray) -> View:
    """Return what robots sense that all sense each other."""
    n = len(position)
    other = np.array([j for i in range(n) for j in range(n) if j != i], np.int64)
    states = np.column_stack((position, np.zeros((n, 3)), np.full(n, RADIUS_M)))
    return View(
        position, np.zeros(n), np.full(n, RADIUS_M), lambda: (np.arange(n + 1) * (n - 1), other), position, states,
        BOUNDS, lambda _row, _source: obstacles, np.full(n, speed_limit_m_s),
    )  # fmt: skip


def law(position: np.ndarray, speed_limit_m_s: float = 0.5, obstacles: np.ndarray | None = None) -> np.ndarray:
    seen = np.zeros((0, 6)) if obstacles is None else obstacles
    return paper_bc.velocity(view(position, speed_limit_m_s, seen), Params([dict(PARAMETERS)] * len(position)))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_it_is_the_nearest_velocity_that_osqp_finds_within_the_certificate(seed: int) -> None:
    rng = np.random.default_rng(seed)
    position = rng.uniform(0.5, 5.5, (5, 2))
    found = law(position)
    for i in range(5):
        wanted = np.array(PARAMETERS["goal"]) - position[i]
        wanted *= min(1.0, 0.5 / np.hypot(*wanted))
        rows, limits = [], []
        for j in range(5):
            if j != i:
                offset = position[j] - position[i]
                rows.append(offset / np.hypot(*offset))
                limits.append(max(0.0, 0.5 * GAIN * (np.hypot(*offset) - 2 * RADIUS_M - MARGIN_M)))
        for axis in range(2):
            for sign, edge in ((-1.0, 0.0), (1.0, 6.0)):
                rows.append(sign * np.eye(2)[axis])
                limits.append(max(0.0, GAIN * (sign * (edge - position[i, axis]) - RADIUS_M - MARGIN_M)))
        solver = osqp.OSQP()
        matrix = scipy.sparse.csc_matrix(np.array(rows))
        low = np.full(len(limits), -np.inf)
        solver.setup(
            scipy.sparse.eye(2, format="csc"), -wanted, matrix, low, np.array(limits), verbose=False, eps_abs=1e-8,
            eps_rel=1e-8, max_iter=20_000,
        )  # fmt: skip
        assert found[i] == pytest.approx(solver.solve(raise_error=True).x, abs=1e-4)


def test_bodies_that_move_in_any_direction_keep_apart_with_it() -> None:
    """As the paper says: the guarantee is one for holonomic robots."""
    rng, least = np.random.default_rng(3), math.inf
    position = np.array([[1.0 + 0.6 * (k % 4), 1.0 + 0.6 * (k // 4)] for k in range(12)]) + rng.uniform(
        -0.1, 0.1, (12, 2)
    )
    box = np.array([[3.2, 3.4, 0.2, 0.2, 0.5, 0.0]])
    for _ in range(500):
        position = position + 0.02 * law(position, obstacles=box)
        apart = np.hypot(*(position[:, None] - position[None]).transpose(2, 0, 1)) + 10.0 * np.eye(12)
        least = min(least, float(apart.min()) - 2 * RADIUS_M)
    assert MARGIN_M - 1e-3 <= least < 0.2


def trial(behaviour: str) -> Trial:
    filters = ("move_to_goal_bc", "scenario=empty_dense", "robots=16", "limits=paper", "engine=kinematic")
    (one,) = plan(load_experiment("safety"), (0,), filters)
    return replace(one, cell=replace(one.cell, behaviour=behaviour))


def test_unicycles_collide_with_it_where_those_behind_the_filter_do_not() -> None:
    papers, ours = (run_trial(trial(name)).outcome for name in ("paper_bc", "move_to_goal_bc"))
    assert papers is not None
    assert ours is not None
    assert papers.robot_events > 0
    assert ours.robot_events == 0


def test_a_robot_that_is_not_simulated_refuses_it_with_a_reason() -> None:
    bench = Bench([(1.0, 1.0, 0.0), (3.0, 1.0, 0.0)])
    fleet = bench.agent.fleet
    fleet.descriptions = (fleet.descriptions[0], replace(fleet.descriptions[1], make="create"))
    bench.enable("paper_bc", PARAMETERS)
    bench.run(0.2)
    assert [(ack.robot, ack.accepted, ack.code) for ack in bench.acks] == [
        ("r1", True, ""), ("r2", False, "simulated_only"),
    ]  # fmt: skip
    assert "move_to_goal_bc" in bench.acks[1].reason
    assert bench.commanded.any(axis=1).tolist() == [True, False]
