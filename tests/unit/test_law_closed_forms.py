"""The laws against their closed forms, on points that move exactly as the law wishes (paper III.A)."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.agent.behaviours import flocking, formation, move_to_goal, rendezvous, voronoi_coverage
from fullswarm.agent.view import Params, View
from fullswarm.geometry import wrap
from fullswarm.kernels import Array
from fullswarm.messages import Value
from fullswarm.perf import shape

BOUNDS = (0.0, 0.0, 10.0, 6.0)
DT_S = 0.02
seeds = st.integers(0, 2**32 - 1)
gains = st.floats(0.1, 3.0)


def sees_all(position: Array, heading: Array | None = None) -> View:
    """Return the view of robots each of which hears all others."""
    n = len(position)
    heading = np.zeros(n) if heading is None else heading
    start = np.arange(n + 1) * (n - 1)
    other = np.array([j for i in range(n) for j in range(n) if j != i], np.int64)
    heard = np.column_stack([position, heading, np.zeros((n, 2)), np.full(n, 0.17)])
    return View(position, heading, np.full(n, 0.17), lambda: (start, other), position, heard, BOUNDS)


def params(n: int, **each: Value) -> Params:
    return Params([dict(each) for _ in range(n)])


def scattered(seed: int, n: int) -> Array:
    return np.random.default_rng(seed).uniform(BOUNDS[:2], BOUNDS[2:], (n, 2))


def euler_error(gain: float, offset: Array) -> float:
    """Bound how far Euler's steps are from the exponential: ``K dt / 2 · K t e^{-K t} <= K dt / (2 e)``, and some."""
    return 0.25 * gain * DT_S * float(np.abs(offset).max()) + 1e-12


@given(seeds, gains, st.integers(1, 8))
@settings(max_examples=25, deadline=None)
def test_move_to_goal_decays_exponentially(seed: int, gain: float, n: int) -> None:
    position, goal = scattered(seed, n), scattered(seed + 1, 1)[0]
    law, offset = params(n, goal=goal.tolist(), gain=gain, arrive_radius_m=0.0), position - goal
    for step in range(1, 151):
        position = position + DT_S * move_to_goal.velocity(sees_all(position), law)
        exact = goal + offset * math.exp(-gain * step * DT_S)
        assert np.abs(position - exact).max() <= euler_error(gain, offset)


@given(seeds, gains, st.integers(1, 8))
@settings(max_examples=25, deadline=None)
def test_formation_decays_to_each_robots_own_target(seed: int, gain: float, n: int) -> None:
    position, targets = scattered(seed, n), scattered(seed + 1, n)
    law = Params([{"target": target, "gain": gain} for target in targets.tolist()])
    offset = position - targets
    for step in range(1, 151):
        position = position + DT_S * formation.velocity(sees_all(position), law)
        exact = targets + offset * math.exp(-gain * step * DT_S)
        assert np.abs(position - exact).max() <= euler_error(gain, offset)


@given(seeds, gains, st.integers(2, 8))
@settings(max_examples=25, deadline=None)
def test_rendezvous_is_a_consensus_on_the_mean(seed: int, gain: float, n: int) -> None:
    """The mean of the others is ``n / (n - 1)`` times as far away as the mean of all, which stays where it is."""
    position = scattered(seed, n)
    mean = position.mean(axis=0)
    law, offset, rate = params(n, gain=gain), position - mean, gain * n / (n - 1)
    for step in range(1, 151):
        position = position + DT_S * rendezvous.velocity(sees_all(position), law)
        assert position.mean(axis=0) == pytest.approx(mean, abs=1e-9)
        exact = mean + offset * math.exp(-rate * step * DT_S)
        assert np.abs(position - exact).max() <= euler_error(rate, offset)


def lloyd_cost(position: Array) -> float:
    """Return the integral of the squared distance to the nearest robot, exactly, by polygons."""
    total = 0.0
    for i, (x, y) in enumerate(position):
        cell = shapely.box(*BOUNDS)
        for j, (other_x, other_y) in enumerate(position):
            if j != i:
                cell = cell.intersection(nearer_side(x, y, other_x, other_y))
        if cell.is_empty:
            continue
        corners = np.array(shapely.geometry.polygon.orient(cell).exterior.coords) - (x, y)
        (x0, y0), (x1, y1) = corners[:-1].T, corners[1:].T
        inertia = (x0 * y1 - x1 * y0) * (x0 * x0 + x0 * x1 + x1 * x1 + y0 * y0 + y0 * y1 + y1 * y1) / 12.0
        total += float(inertia.sum())
    return total


def nearer_side(x: float, y: float, other_x: float, other_y: float) -> shapely.Polygon:
    """Return a large square: its edge is the bisector of the two points, the first is on its inside."""
    apart = math.hypot(other_x - x, other_y - y)
    along_x, along_y = (other_x - x) / apart, (other_y - y) / apart
    middle_x, middle_y = (x + other_x) / 2, (y + other_y) / 2
    far = 100.0
    edge = [(middle_x - side * far * along_y, middle_y + side * far * along_x) for side in (1.0, -1.0)]
    back = [(px - far * along_x, py - far * along_y) for px, py in reversed(edge)]
    return shapely.Polygon([*edge, *back])


@given(seeds, st.floats(0.1, 1.0), st.integers(1, 6))
@settings(max_examples=15, deadline=None)
def test_lloyds_cost_never_rises_under_voronoi_coverage(seed: int, gain: float, n: int) -> None:
    position, law = scattered(seed, n), params(n, gain=gain, hearing_m=30.0)
    cost = lloyd_cost(position)
    area = (BOUNDS[2] - BOUNDS[0]) * (BOUNDS[3] - BOUNDS[1])
    assert shape.voronoi_cost(position, BOUNDS, 60) * area == pytest.approx(cost, rel=0.01)
    for _ in range(12):  # whole steps of one second: a robot never goes farther than to its centroid
        position = position + voronoi_coverage.velocity(sees_all(position), law)
        before, cost = cost, lloyd_cost(position)
        assert cost <= before * (1.0 + 1e-9)


@given(seeds, st.integers(2, 8), st.floats(0.1, 1.0))
@settings(max_examples=25, deadline=None)
def test_a_flock_agrees_on_one_heading(seed: int, n: int, cruise_m_s: float) -> None:
    """Headings within a half-circle close up: each turns towards the mean of all, none leaves their range."""
    rng = np.random.default_rng(seed)
    heading, middle = rng.uniform(-1.4, 1.4, n), rng.uniform(-math.pi, math.pi)
    position = rng.uniform(0.0, 1.0, (n, 2))
    law = params(
        n, repulsion_radius_m=0.01, alignment_radius_m=100.0, attraction_radius_m=0.02, separation=0.0, alignment=1.0,
        cohesion=0.0, cruise_m_s=cruise_m_s,
    )  # fmt: skip
    spread = np.ptp(heading)
    for _ in range(300):
        wished = flocking.velocity(sees_all(position, heading + middle), law)
        assert np.hypot(*wished.T) == pytest.approx(cruise_m_s)
        aim = np.arctan2(wished[:, 1], wished[:, 0]) - middle
        heading = heading + DT_S * 3.0 * np.array([wrap(turn) for turn in aim - heading])
        before, spread = spread, np.ptp(heading)
        assert spread <= before + 1e-12
    assert shape.order(heading) == pytest.approx(1.0, abs=1e-6)
