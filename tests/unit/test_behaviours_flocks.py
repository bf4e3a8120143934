"""Flocks that lose no robot, and pursuit and evasion: against their papers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import shapely

from fullswarm import Lab
from fullswarm.agent.behaviours import flocking_adaptive, flocking_velocity, pursuit_evasion
from fullswarm.kernels import Array

from .points import DT_S, Points
from .test_law_closed_forms import nearer_side

ADAPTIVE: dict[str, Any] = {
    "repulsion_radius_m": 0.8, "alignment_radius_m": 2.0, "attraction_radius_m": 2.7, "edge_m": 1.5, "separation": 1.5,
    "alignment": 1.0, "cohesion": 0.5, "cruise_m_s": 0.2,
}  # fmt: skip
LATTICE: dict[str, Any] = {
    "destination": [6.0, 3.0], "spacing_m": 1.0, "speed_m_s": 0.25, "stiffness": 1.0, "matching": 0.6,
    "navigation": 0.5,
}  # fmt: skip


def connectivity(position: Array, reach_m: float) -> float:
    """Return the second-smallest eigenvalue of the Laplacian of who is within reach: 0 if some robot is lost."""
    near = (np.linalg.norm(position[:, None] - position, axis=2) < reach_m) - np.eye(len(position))
    return float(np.linalg.eigvalsh(np.diag(near.sum(axis=1)) - near)[1])


def edge_of_a_flock(seed: int, count: int) -> Array:
    """Return the start of a flock that is barely connected: each robot has another one almost at 2.7 m."""
    rng = np.random.default_rng(seed)
    places = [np.array([8.0, 8.0])]
    while len(places) < count:
        angle = rng.uniform(0.0, math.tau)
        new = places[rng.integers(len(places))] + 2.6 * np.array([math.cos(angle), math.sin(angle)])
        clear = all(np.linalg.norm(new - each) > 0.6 for each in places)
        if clear and (np.abs(new - 8.0) < 7.3).all():
            places.append(new)
    return np.column_stack([places, rng.uniform(-math.pi, math.pi, count)])


@pytest.mark.parametrize("behaviour", ["flocking_adaptive_bc", "flocking_adaptive"])
def test_the_adaptive_flock_never_loses_a_robot(behaviour: str) -> None:
    for seed in (0, 1, 3) if behaviour == "flocking_adaptive_bc" else (3,):
        with Lab(
            starts=edge_of_a_flock(seed, 7), bounds=(0, 0, 16, 16), seed=seed,
            settings={"world.noise.position_m": 0.01} if seed % 2 else {},
        ) as lab:  # fmt: skip
            lab.request(behaviour)
            for _ in range(35):
                lab.run(1.0)
                assert connectivity(lab.poses[:, :2], 3.0) > 1e-9, (seed, lab.time_s)
                assert behaviour == "flocking_adaptive" or (lab.contacts == 0).all()
            spread = np.exp(1j * lab.poses[:, 2]).mean()
        assert abs(spread) > 0.7, seed  # they go one way


def test_the_paper_s_flock_loses_a_robot_from_one_of_these_starts() -> None:
    """Why the adaptive one exists; the original is unchanged."""
    with Lab(starts=edge_of_a_flock(3, 7), bounds=(0, 0, 16, 16), seed=3) as lab:
        lab.request("flocking_bc", attraction_radius_m=2.7)
        lab.run(35.0)
        assert connectivity(lab.poses[:, :2], 3.0) < 1e-9


def test_tension_grows_without_limit_towards_the_range() -> None:
    share = np.array([0.1, 0.5, 0.75, 0.9, 0.98])
    expected = [1.0, 1.0, 4.0, 25.0, 625.0]
    assert flocking_adaptive.tension(2.0 * share, np.full(5, 2.0)) == pytest.approx(expected)


def test_relative_neighbours_are_those_without_a_third_robot_nearer_to_both() -> None:
    position = np.random.default_rng(5).uniform(0.0, 4.0, (12, 2))
    points = Points(flocking_adaptive, position, ADAPTIVE, reach_m=2.7)
    view = points.view()
    kept = flocking_adaptive.relative_neighbours(view)
    apart = np.linalg.norm(position[:, None] - position, axis=2)
    for i, j, found in zip(view.of, view.other, kept, strict=True):
        third = np.maximum(apart[i], apart[j]) < apart[i, j]
        third[[i, j]] = False
        assert found == (not third.any())
    graph = np.zeros((12, 12))
    graph[view.of[kept], view.other[kept]] = 1.0
    assert (graph == graph.T).all()
    near = (apart < 2.7) - np.eye(12)
    parts = [np.linalg.matrix_rank(np.diag(each.sum(axis=1)) - each) for each in (graph, near)]
    assert parts[0] == parts[1]  # as many parts as with all pairs


# ------------------------------------------------------------------ velocity matching
def test_matching_alone_brings_all_velocities_to_their_mean_at_the_rate_n_k() -> None:
    n, gain = 5, 0.3
    start = np.random.default_rng(2).uniform(-0.2, 0.2, (n, 2))
    position = 0.02 * np.random.default_rng(3).uniform(-1.0, 1.0, (n, 2))
    only = {**LATTICE, "stiffness": 0.0, "navigation": 0.0, "matching": gain, "spacing_m": 5.0, "speed_m_s": 1.0}
    points = Points(flocking_velocity, position, only)
    points.memory.velocity_m_s = start
    points.moved, points.heading = start, np.arctan2(*start.T[::-1])
    for step in range(1, 200):
        moved = points.step()
        assert moved.mean(axis=0) == pytest.approx(start.mean(axis=0), abs=1e-6)
        exact = start.mean(axis=0) + (start - start.mean(axis=0)) * (1.0 - n * gain * DT_S) ** step
        assert moved == pytest.approx(exact, abs=1e-6)
        assert (1.0 - n * gain * DT_S) ** step == pytest.approx(math.exp(-n * gain * step * DT_S), abs=0.01)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_flock_becomes_a_lattice_and_arrives_together(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = Points(flocking_velocity, rng.uniform(0.0, 2.5, (9, 2)), LATTICE)
    points.step(2000)
    on_the_way = np.linalg.norm(points.moved - points.moved.mean(axis=0), axis=1).max()
    assert on_the_way < 0.03
    points.step(1500)
    assert np.linalg.norm(points.position.mean(axis=0) - [6.0, 3.0]) < 0.1
    assert np.linalg.norm(points.moved, axis=1).max() < 0.02
    apart = np.linalg.norm(points.position[:, None] - points.position, axis=2)[np.triu_indices(9, 1)]
    neighbours = apart[apart < 1.2]
    assert len(neighbours) >= 12  # of a triangular lattice of nine
    assert np.abs(neighbours - 1.0).max() < 0.2
    assert connectivity(points.position, 1.2) > 0.0


# ------------------------------------------------------------------ pursuit and evasion
GAME: dict[str, Any] = {"evaders": 1, "speed_m_s": 0.4, "evader_m_s": 0.4, "capture_m": 0.3}
ARENA = (0.0, 0.0, 8.0, 6.0)


def cell_area(position: Array) -> float:
    """Return the area of the first point's Voronoi cell, by polygons."""
    cell = shapely.box(*ARENA)
    for x, y in position[1:]:
        cell = cell.intersection(nearer_side(position[0, 0], position[0, 1], x, y))
    return float(cell.area)


@pytest.mark.parametrize(("seed", "pursuers"), [(1, 2), (2, 3), (3, 4), (4, 3)])
def test_the_evader_s_cell_never_grows_and_it_is_caught_though_it_is_as_fast(seed: int, pursuers: int) -> None:
    start = np.random.default_rng(seed).uniform((0.3, 0.3), (7.7, 5.7), (1 + pursuers, 2))
    points = Points(pursuit_evasion, start, GAME, bounds=ARENA, dt_s=0.05)
    area = cell_area(points.position)
    for _ in range(1500):
        points.step()
        if points.ended:
            break
        before, area = area, cell_area(points.position)
        assert area <= before + 0.02
    assert points.ended[0].startswith("caught by r")
    points.step(60)
    assert len(points.ended) == 1 + pursuers
    assert points.ended[1] == "all evaders are caught"


def test_several_evaders_are_caught_one_after_another() -> None:
    start = np.random.default_rng(9).uniform((0.3, 0.3), (7.7, 5.7), (6, 2))
    points = Points(pursuit_evasion, start, {**GAME, "evaders": 2, "evader_m_s": 0.3}, bounds=ARENA, dt_s=0.05)
    points.step(2500)
    assert len(points.ended) == 6
    assert sum(text.startswith("caught") for text in points.ended.values()) == 2
