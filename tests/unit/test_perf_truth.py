"""What the true bodies did: integrals with closed forms, contact onsets, coverage against shapely."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.kernels import Array
from fullswarm.perf import shape
from fullswarm.perf.calculators import GRAVITY_M_S2, ROLLING, WHEEL_RADII, CoverageCalculator
from fullswarm.perf.truth import Truth

ARENA = (0.0, 0.0, 8.0, 5.0)
DT_S = 0.004
RADIUS_M = 0.17
seeds = st.integers(0, 2**32 - 1)


def truth_of(n: int, goals: Array | None = None, cell_m: float = 0.1) -> Truth:
    goals = np.full((n, 2), math.nan) if goals is None else goals
    return Truth([f"r{row}" for row in range(n)], np.full(n, RADIUS_M), goals, 0.5, ARENA, cell_m, mass_kg=2.0)


def wander(seed: int, n: int, steps: int) -> tuple[Array, Array]:
    """Return poses (t, n, 3) and twists (t, n, 2) of robots that stroll through the arena."""
    rng = np.random.default_rng(seed)
    twist = np.empty((steps, n, 2))
    twist[:, :, 0] = rng.uniform(0.0, 3.0, (1, n))
    twist[:, :, 1] = np.cumsum(rng.normal(0.0, 0.5, (steps, n)), axis=0)
    pose = np.empty((steps, n, 3))
    pose[:, :, 2] = np.cumsum(DT_S * twist[:, :, 1], axis=0)
    ahead = np.stack((np.cos(pose[:, :, 2]), np.sin(pose[:, :, 2])), axis=2)
    pose[:, :, :2] = rng.uniform((2.0, 2.0), (6.0, 3.0), (n, 2)) + np.cumsum(DT_S * twist[:, :, :1] * ahead, axis=0)
    return pose, twist


def watch(truth: Truth, pose: Array, twist: Array) -> Truth:
    for step, (each, moving) in enumerate(zip(pose, twist, strict=True), start=1):
        truth.sample(step * DT_S, each, moving, DT_S)
    return truth


@given(seeds, st.integers(1, 5))
@settings(max_examples=15, deadline=None)
def test_work_is_the_integral_of_the_speed(seed: int, n: int) -> None:
    pose, twist = wander(seed, n, 120)
    values = watch(truth_of(n), pose, twist).values()
    way_m = (DT_S * np.abs(twist[1:, :, 0])).sum(axis=0)  # the first sample has no position before it
    assert values["work.total_m"] == pytest.approx(way_m.sum())
    assert values["work.mean_m"] == pytest.approx(way_m.mean())
    assert values["work.max_m"] == pytest.approx(way_m.max())


@given(seeds, st.integers(2, 5))
@settings(max_examples=15, deadline=None)
def test_the_smallest_gap_is_what_looking_at_all_pairs_at_all_times_finds(seed: int, n: int) -> None:
    pose, twist = wander(seed, n, 120)
    gaps = [
        np.hypot(*(pose[:, a, :2] - pose[:, b, :2]).T) - 2.0 * RADIUS_M for a, b in itertools.combinations(range(n), 2)
    ]
    assert watch(truth_of(n), pose, twist).values()["separation.min_m"] == pytest.approx(np.min(gaps))


def test_one_robot_has_no_gap_and_without_goals_nobody_arrives() -> None:
    pose, twist = wander(1, 1, 10)
    values = watch(truth_of(1), pose, twist).values()
    assert not [name for name in values if name.startswith(("separation", "arrival", "formation", "collisions"))]


def test_arrival_is_the_last_entry_into_the_disc() -> None:
    """r0 drives through its goal's disc, r1 into it and stays, r2 drives through and comes back."""
    truth = truth_of(3, np.array([[2.0, 1.0], [2.0, 2.0], [2.0, 3.0]]))
    y = np.array([1.0, 2.0, 3.0])
    for step in range(1, 1001):
        time_s = step * DT_S
        x = [time_s, min(time_s, 2.0), time_s if time_s < 3.0 else 6.0 - time_s]
        truth.sample(10.0 + time_s, np.column_stack([x, y, np.zeros(3)]), np.zeros((3, 2)), DT_S)
    values, arrived_s = truth.values(), truth.per_robot()["arrival.arrived_s"]
    assert arrived_s == {"r1": pytest.approx(1.5, abs=2 * DT_S), "r2": pytest.approx(3.5, abs=2 * DT_S)}
    assert values["arrival.fraction"] == pytest.approx(2 / 3)
    assert values["arrival.last_s"] == arrived_s["r2"]
    assert values["arrival.mean_s"] == pytest.approx(2.5, abs=2 * DT_S)
    assert values["formation.error_m"] == pytest.approx(math.sqrt((2.0**2 + 0.0 + 0.0) / 3.0), abs=0.01)


def test_energy_is_that_of_speeding_up_and_of_rolling() -> None:
    truth, pose = truth_of(1), np.zeros((1, 3))
    for step, speed in enumerate((0.0, 0.5, 1.0, 0.5, 0.0, 0.5, 0.5)):
        truth.sample(step * 0.1, pose, np.array([[speed, 0.0]]), 0.1)
    kinetic_j = 0.5 * 2.0 * (1.0**2 + 0.5**2)  # sped up to 1 m/s and later to 0.5 m/s; brakes give nothing back
    rolling_j = ROLLING * GRAVITY_M_S2 * 2.0 * 0.1 * (0.5 + 1.0 + 0.5 + 0.5 + 0.5)
    assert truth.values()["energy.total_j"] == pytest.approx(kinetic_j + rolling_j)


def test_turning_on_the_spot_costs_the_way_of_the_wheels() -> None:
    truth, pose = truth_of(1), np.zeros((1, 3))
    for step in range(11):
        truth.sample(step * 0.1, pose, np.array([[0.0, 2.0]]), 0.1)
    wheels_m = 11 * 0.1 * 2.0 * WHEEL_RADII * RADIUS_M
    assert truth.values()["energy.total_j"] == pytest.approx(ROLLING * GRAVITY_M_S2 * 2.0 * wheels_m)


@pytest.mark.parametrize(
    ("gap_s", "events"),
    [(0.1, 1), (0.24, 1), (0.26, 2), (1.0, 2)],
)
def test_collisions_count_onsets_a_quarter_second_apart(gap_s: float, events: int) -> None:
    """Two robots touch for half a second, part for `gap_s`, and touch again; the third touches nobody."""
    truth, pose, twist = truth_of(3), np.zeros((3, 3)), np.zeros((3, 2))
    for step in range(1, 500):
        time_s = step * DT_S
        touching = int(0.2 <= time_s <= 0.7 or 0.7 + gap_s <= time_s <= 1.8)
        truth.sample(time_s, pose, twist, DT_S, np.array([touching, touching, 0]))
    assert truth.per_robot()["collisions.events"] == {"r0": events, "r1": events, "r2": 0}
    assert truth.values()["collisions.events"] == 2 * events
    assert truth.values()["collisions.robots_touched"] == 2


@given(st.lists(st.tuples(st.floats(0.0, 8.0), st.floats(0.0, 5.0), st.floats(0.1, 1.5)), min_size=1, max_size=6))
@settings(max_examples=25, deadline=None)
def test_coverage_converges_to_the_area_of_the_union_of_discs(discs: list[tuple[float, float, float]]) -> None:
    """A cell counts by its middle: the area is off by less than the rim's length times half a cell's diagonal."""
    union = shapely.union_all([shapely.Point(x, y).buffer(r, 256) for x, y, r in discs])
    union = union.intersection(shapely.box(*ARENA))
    for cell_m in (0.1, 0.05, 0.025):
        coverage = CoverageCalculator(ARENA, cell_m, [r for *_, r in discs])
        coverage.update(np.array([(x, y) for x, y, _ in discs]))
        area_m2 = coverage.covered * coverage.frame.cell_area_m2
        assert abs(area_m2 - union.area) <= 0.75 * cell_m * union.length + 3.0 * cell_m**2


def test_coverage_of_a_way_converges_to_the_swept_area() -> None:
    pose, twist = wander(3, 2, 600)
    swept = shapely.union_all([shapely.LineString(pose[:, row, :2]).buffer(RADIUS_M, 64) for row in range(2)])
    swept = swept.intersection(shapely.box(*ARENA))
    errors = []
    for cell_m in (0.2, 0.1, 0.05, 0.02):
        area_m2 = watch(truth_of(2, cell_m=cell_m), pose, twist).values()["coverage.area_m2"]
        assert abs(area_m2 - swept.area) <= cell_m * swept.length
        errors.append(abs(area_m2 - swept.area))
    assert errors[-1] < 0.01 * swept.area


def test_the_shape_of_four_robots_at_the_corners_of_a_square() -> None:
    x, y = np.array([0.0, 2.0, 2.0, 0.0]), np.array([0.0, 0.0, 2.0, 2.0])
    values = shape.values(x, y, np.array([0.0, 0.0, math.pi, math.pi]), (0.0, 0.0, 2.0, 2.0))
    assert values == {
        "order": pytest.approx(0.0, abs=1e-12),
        "spacing_m": pytest.approx(2.0),
        "diameter_m": pytest.approx(math.sqrt(8.0)),
        "voronoi_m2": pytest.approx(2.0 / 3.0, rel=0.01),  # the mean of x² + y² over a unit square
    }
    assert shape.values(x[:0], y[:0], x[:0], ARENA) == {}
    assert shape.values(x[:1], y[:1], x[:1], ARENA).keys() == {"order", "voronoi_m2"}


@given(seeds, st.integers(2, 12))
@settings(max_examples=20, deadline=None)
def test_with_and_without_a_table_the_distances_are_the_same(seed: int, n: int) -> None:
    position = np.random.default_rng(seed).uniform(0.0, 5.0, (n, 2))
    for ours, among in ((position, True), (position[:1] + 0.3, False)):
        least = np.empty(len(ours))
        most = shape.scan.plain(ours, position, among, least)
        apart = np.sum((ours[:, None] - position[None]) ** 2, axis=2)
        assert most == pytest.approx(apart.max())
        if among:
            np.fill_diagonal(apart, np.inf)
        assert least == pytest.approx(apart.min(axis=1))
