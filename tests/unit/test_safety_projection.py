"""The exact projection against OSQP, on many and on degenerate sets of half-planes; and that zero is always allowed."""

from __future__ import annotations

import math

import numpy as np
import osqp
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import sparse

from fullswarm.agent.safety import barrier
from fullswarm.kernels import Array

SHAPES = ("random", "tight", "parallel", "opposed", "repeated", "axes")


def half_planes(rng: np.random.Generator, count: int, shape: str) -> tuple[Array, Array]:
    """Return normals (count, 2) and limits (count,) >= 0 of one of the `SHAPES`."""
    angle: Array = rng.uniform(-math.pi, math.pi, count)
    limits = np.maximum(rng.uniform(-0.3, 1.0, count), 0.0)
    if shape == "tight":  # the borders meet in zero, or nearly
        limits *= rng.choice([0.0, 1e-3], count)
    elif shape == "parallel":  # 1e-4 rad apart
        angle = angle[0] + rng.normal(0.0, 1e-4, count)
    elif shape == "opposed":  # strips, some of no width
        angle = np.asarray(angle[0] + math.pi * rng.integers(0, 2, count), float)
        limits *= rng.integers(0, 2, count)
    elif shape == "repeated":
        angle, limits = np.repeat(angle[:1], count), np.repeat(limits[:1], count)
    elif shape == "axes":
        angle = np.asarray(0.5 * math.pi * rng.integers(0, 4, count), float)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1), limits


def by_osqp(wish: Array, normals: Array, limits: Array) -> Array | None:
    """Solve the same problem; None when OSQP gives up."""
    solver = osqp.OSQP()
    solver.setup(
        sparse.eye(2, format="csc"), -wish, sparse.csc_matrix(normals), np.full(len(limits), -np.inf), limits,
        eps_abs=1e-9, eps_rel=1e-9, max_iter=100_000, polishing=True, verbose=False,
    )  # fmt: skip
    answer = solver.solve(raise_error=False)
    return np.asarray(answer.x, float) if answer.info.status == "solved" else None


def planes(normals: np.ndarray, limits: np.ndarray, blur: float = 0.0) -> barrier.HalfPlanes:
    return barrier.HalfPlanes(normals[:, 0], normals[:, 1], limits, np.full(len(limits), blur), np.zeros(len(limits)))


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.sampled_from(SHAPES))
@settings(max_examples=300, deadline=None)
def test_the_projection_is_osqps_answer(seed: int, count: int, shape: str) -> None:
    rng = np.random.default_rng(seed)
    normals, limits = half_planes(rng, count, shape)
    wish = rng.uniform(-1.0, 1.0, 2)
    found = np.array(barrier.project(wish[0], wish[1], planes(normals, limits), count))
    assert (normals @ found <= limits + 1e-9).all()
    assert np.hypot(*found) <= np.hypot(*wish) + 1e-9  # zero is allowed, so no answer is longer than the wish
    reference = by_osqp(wish, normals, limits)
    if reference is None:  # it gives up on some near-parallel sets; ours must not, and must be no worse than zero
        assert np.hypot(*(found - wish)) <= np.hypot(*wish) + 1e-9
        return
    assert found == pytest.approx(reference, abs=1e-4)
    # Not merely near OSQP's: no worse than it. What it takes outside the set it may gain on us.
    outside = max(float((normals @ reference - limits).max()), 0.0)
    assert np.hypot(*(found - wish)) <= np.hypot(*(reference - wish)) + 1e2 * outside + 1e-7


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.sampled_from(SHAPES))
@settings(max_examples=200, deadline=None)
def test_the_answer_satisfies_the_conditions_of_optimality(seed: int, count: int, shape: str) -> None:
    rng = np.random.default_rng(seed)
    normals, limits = half_planes(rng, count, shape)
    wish = rng.uniform(-1.0, 1.0, 2)
    found = np.array(barrier.project(wish[0], wish[1], planes(normals, limits), count))
    # The variational inequality: nothing allowed lies further along the rest of the wish.
    rest = wish - found
    for scale in (0.0, 0.3, 1.0):
        for angle in np.linspace(-math.pi, math.pi, 60):
            other = scale * np.array([math.cos(angle), math.sin(angle)])
            if (normals @ other <= limits).all():
                assert rest @ (other - found) <= 1e-6


def test_what_is_allowed_is_not_touched() -> None:
    normals, limits = np.array([[1.0, 0.0], [0.0, 1.0]]), np.array([0.5, 0.5])
    assert barrier.project(0.3, -0.9, planes(normals, limits), 2) == (0.3, -0.9)


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.sampled_from(SHAPES), st.floats(0.0, 2.0))
@settings(max_examples=200, deadline=None)
def test_standing_is_always_in_the_interval(seed: int, count: int, shape: str, blur: float) -> None:
    rng = np.random.default_rng(seed)
    normals, limits = half_planes(rng, count, shape)
    heading = rng.uniform(-math.pi, math.pi)
    ahead = np.array([math.cos(heading), math.sin(heading)])
    low, high = barrier.interval(ahead[0], ahead[1], -0.5, 0.5, planes(normals, limits, blur), count)
    assert -0.5 <= low <= 0.0 <= high <= 0.5
    for speed in (low, high):
        assert (normals @ ahead * speed + abs(speed) * blur <= limits + 1e-9).all()
