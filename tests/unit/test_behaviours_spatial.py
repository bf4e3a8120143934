"""Dispersion, aggregation, leader and followers, cyclic pursuit, perimeter, area sweep: against their closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from fullswarm.agent.behaviours import (
    aggregation,
    area_sweep,
    cyclic_pursuit,
    dispersion,
    leader_follower,
    perimeter,
)  # fmt: skip
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array

from .points import DT_S, Points


def scattered(seed: int, count: int, size_m: float = 8.0) -> Array:
    return np.random.default_rng(seed).uniform(0.0, size_m, (count, 2))


def gaps(position: Array) -> Array:
    """Return all distances between two points."""
    apart = np.linalg.norm(position[:, None] - position, axis=2)
    found: Array = apart[np.triu_indices(len(position), 1)]
    return found


# ------------------------------------------------------------------ dispersion
def test_two_robots_approach_the_spacing_exponentially() -> None:
    points = Points(dispersion, np.array([[0.0, 0.0], [0.4, 0.3]]), {"spacing_m": 2.0, "gain": 0.6})
    for step in range(1, 200):
        points.step()
        assert 2.0 - gaps(points.position)[0] == pytest.approx(1.5 * math.exp(-1.2 * step * DT_S), abs=0.02)


@pytest.mark.parametrize(("seed", "count"), [(1, 2), (2, 7), (3, 12)])
def test_dispersion_ends_with_the_spacing_where_there_is_room(seed: int, count: int) -> None:
    bounds = (0.0, 0.0, 12.0, 12.0)
    points = Points(dispersion, 4.0 + 0.4 * scattered(seed, count), {"spacing_m": 1.5, "gain": 1.0}, bounds=bounds)
    points.step(1500)
    assert gaps(points.position).min() > 0.98 * 1.5
    assert (np.abs(points.position - 6.0) < 6.0).all()


# ------------------------------------------------------------------ aggregation
def test_a_robot_stays_in_a_group_for_a_time_that_grows_with_the_group() -> None:
    """The time until it leaves is exponential with the mean ``(1 + N)² / rate``."""
    rate, group = 0.5, 2
    corners = np.array([[0.0, 0.0], [0.5, 0.0], [0.25, 0.4]])
    places = np.concatenate([corners + 20.0 * np.array([k % 20, k // 20]) for k in range(200)])
    parameters = {"gap_m": 0.6, "speed_m_s": 0.4, "turns_per_s": 0.1, "leave_per_s": rate, "away_s": 1e3}
    points = Points(aggregation, places, parameters, reach_m=3.0, dt_s=0.1, bounds=(-500.0, -500.0, 900.0, 900.0))
    left_s: dict[int, float] = {}
    for _ in range(40):  # the first robot of each group counts, until it or a neighbour leaves
        points.step()
        leaving = np.flatnonzero(points.memory.away_until_s > 0.0)
        for row in leaving.tolist():
            left_s.setdefault(row // 3, points.time_s)
    expected = 200 * (1.0 - math.exp(-3 * rate / (1 + group) ** 2 * 4.0))
    assert len(left_s) == pytest.approx(expected, abs=4.0 * math.sqrt(expected))


def test_robots_that_see_others_come_together_and_stay() -> None:
    parameters = {"gap_m": 0.6, "speed_m_s": 0.4, "turns_per_s": 0.1, "leave_per_s": 0.0, "away_s": 10.0}
    points = Points(aggregation, scattered(1, 8, 3.0), parameters, reach_m=5.0)
    points.step(1000)
    assert (np.linalg.norm(points.step(), axis=1) == 0.0).all()
    near = np.linalg.norm(points.position[:, None] - points.position, axis=2) + np.eye(8) * 9.0
    assert near.min(axis=1).max() <= aggregation.LOOSE * 0.6


# ------------------------------------------------------------------ leader and followers
FOLLOW: dict[str, Any] = {"leader_goal": [30.0, 0.0], "spacing_m": 1.0, "speed_m_s": 0.5, "gain": 1.0}


@pytest.mark.parametrize(
    ("shape", "places"),
    [
        ("column", [(-1, 0), (-2, 0), (-3, 0), (-4, 0)]),
        ("line", [(0, 1), (0, -1), (0, 2), (0, -2)]),
        (
            "wedge",
            [(-(0.5**0.5), 0.5**0.5), (-(0.5**0.5), -(0.5**0.5)), (-2 * 0.5**0.5, 2**0.5), (-2 * 0.5**0.5, -(2**0.5))],
        ),
    ],
)
def test_followers_keep_their_places_without_error_while_the_leader_drives(
    shape: str, places: list[tuple[float, float]]
) -> None:
    points = Points(leader_follower, 1.5 * scattered(4, 5, 1.0), {**FOLLOW, "shape": shape})
    points.step(1500)
    assert points.moved == pytest.approx(np.tile(points.moved[0], (5, 1)), abs=1e-3)
    (c, s) = points.moved[0] / np.linalg.norm(points.moved[0])
    turned = (points.position[1:] - points.position[0]) @ np.array([[c, -s], [s, c]])
    assert turned == pytest.approx(np.array(places), abs=0.02)


def test_the_next_robot_leads_when_the_leader_is_lost_and_all_end_at_the_goal() -> None:
    points = Points(leader_follower, scattered(4, 4, 2.0), {**FOLLOW, "leader_goal": [6.0, 2.0], "shape": "column"})
    points.step(300)
    points.lost = [0]
    points.step(2500)
    assert np.linalg.norm(points.position[1] - [6.0, 2.0]) < 0.1
    assert gaps(points.position[1:])[[0, 2]] == pytest.approx([1.0, 1.0], abs=0.25)
    assert {1, 2, 3} <= points.ended.keys()


# ------------------------------------------------------------------ cyclic pursuit
PURSUIT = {"radius_m": 2.0, "speed_m_s": 0.3, "gain": 0.5}


@pytest.mark.parametrize(("seed", "n", "way"), [(1, 2, 1.0), (2, 3, -1.0), (3, 5, 1.0), (4, 6, -1.0)])
def test_pursuers_form_the_regular_polygon_of_the_radius_and_turn_at_its_rate(seed: int, n: int, way: float) -> None:
    """Radius r, side ``2 r sin(π/n)``, rate ``v / r``, in the order of the request."""
    direction = {1.0: "counterclockwise", -1.0: "clockwise"}[way]
    points = Points(cyclic_pursuit, scattered(seed, n), {**PURSUIT, "direction": direction}, dt_s=0.1)
    points.step(3000)
    before = points.position - points.position.mean(axis=0)
    points.step(10)
    after = points.position - points.position.mean(axis=0)
    assert np.linalg.norm(after, axis=1) == pytest.approx(np.full(n, 2.0), rel=0.02)
    sides = np.linalg.norm(np.roll(after, -1, axis=0) - after, axis=1)
    assert sides == pytest.approx(np.full(n, 4.0 * math.sin(math.pi / n)), rel=0.02)
    turned = [
        math.atan2(x0 * y1 - y0 * x1, x0 * x1 + y0 * y1) for (x0, y0), (x1, y1) in zip(before, after, strict=True)
    ]
    assert turned == pytest.approx([way * 0.3 / 2.0 * 10 * 0.1] * n, rel=0.02)


def test_pursuers_close_the_gap_of_one_that_is_lost() -> None:
    points = Points(cyclic_pursuit, scattered(2, 5), {**PURSUIT, "direction": "clockwise"}, dt_s=0.1)
    points.step(1500)
    points.lost = [2]
    points.step(2500)
    left = np.delete(points.position, 2, axis=0)
    assert np.linalg.norm(np.roll(left, -1, axis=0) - left, axis=1) == pytest.approx([2.0 * 2**0.5] * 4, rel=0.03)


# ------------------------------------------------------------------ perimeter
def circle(corners: int, radius_m: float) -> list[list[float]]:
    turn = [math.tau * k / corners for k in range(corners)]
    return [[radius_m * math.cos(angle), radius_m * math.sin(angle)] for angle in turn]


def test_the_slowest_mode_on_a_ring_decays_at_the_rate_of_its_laplacian() -> None:
    """A disturbance ``sin 2πi/n`` of the places decays as ``exp(-K (1 - cos 2π/n) t)``."""
    n, gain = 6, 0.5
    angle = math.tau * np.arange(n) / n
    line = {"corners": circle(720, 5.0), "speed_m_s": 0.0, "gain": gain}
    start = angle + 0.1 * np.sin(angle) + 0.3
    points = Points(perimeter, 5.0 * np.stack([np.cos(start), np.sin(start)], axis=1), line)
    for step in range(1, 301):
        points.step()
        now = np.unwrap(np.arctan2(*points.position.T[::-1]))
        size = 2.0 / n * float((now - now.mean()) @ np.sin(angle))
        straight = 2.0 / n * float((angle - angle.mean()) @ np.sin(angle))
        rate = gain * (1.0 - math.cos(math.tau / n))
        assert size - straight == pytest.approx(0.1 * math.exp(-rate * step * DT_S), abs=0.004)


@pytest.mark.parametrize(("seed", "n", "speed"), [(1, 1, 0.3), (2, 4, 0.0), (3, 5, -0.3), (4, 7, 0.3)])
def test_guards_are_equally_spaced_along_the_line(seed: int, n: int, speed: float) -> None:
    corners = [[1.0, 1.0], [7.0, 1.0], [7.0, 5.0], [4.0, 7.0], [1.0, 5.0]]
    points = Points(perimeter, scattered(seed, n), {"corners": corners, "speed_m_s": speed, "gain": 1.0}, dt_s=0.1)
    points.step(900)
    line = perimeter.closed_line(tuple(map(tuple, corners)))
    s, off = perimeter.place_on(line, points.position)
    assert off.max() < (0.15 if speed else 0.01)  # the corners are cut by less than v / K
    length = sum(math.dist(a, b) for a, b in zip(corners, [*corners[1:], corners[0]], strict=True))
    assert np.diff(np.sort(s), append=np.sort(s)[0] + length) == pytest.approx(np.full(n, length / n), abs=0.1)
    assert np.linalg.norm(points.moved, axis=1) == pytest.approx(np.full(n, abs(speed)), abs=0.05)


def test_a_line_needs_three_corners() -> None:
    with pytest.raises(ConfigError, match="three different corners"):
        perimeter.closed_line(((0.0, 0.0), (1.0, 0.0), (1.0, 0.0)))


# ------------------------------------------------------------------ area sweep
@pytest.mark.parametrize(
    ("seed", "n", "width", "height", "lane"), [(1, 1, 3.0, 4.0, 0.7), (2, 3, 9.0, 4.0, 0.5), (3, 5, 4.0, 9.0, 1.2)]
)
def test_a_sweep_covers_the_area_with_a_way_of_about_its_size_by_the_lane(
    seed: int, n: int, width: float, height: float, lane: float
) -> None:
    parameters = {"area": [[1.0, 2.0], [1.0 + width, 2.0 + height]], "lane_m": lane, "speed_m_s": 0.5}
    points = Points(area_sweep, scattered(seed, n), parameters, dt_s=0.1)
    x, y = np.meshgrid(np.arange(1.05, 1.0 + width, 0.1), np.arange(2.05, 2.0 + height, 0.1))
    missed, way_m = np.column_stack([x.ravel(), y.ravel()]), 0.0
    for _ in range(4000):
        points.step()
        if len(points.ended) == n:
            break
        way_m += float(np.linalg.norm(points.moved, axis=1).sum()) * points.dt_s
        nearest = np.linalg.norm(missed[:, None] - points.position, axis=2).min(axis=1)
        missed = missed[nearest > 0.5 * lane + 0.05]
    assert len(points.ended) == n
    assert len(missed) <= 0.06 * x.size  # the corners of the outer lanes
    longest = n * 15.0  # to the first lanes
    assert way_m <= (1.0 + lane / min(width, height)) * width * height / lane + width + height + longest


def test_an_area_is_a_rectangle() -> None:
    with pytest.raises(ConfigError, match="no rectangle"):
        area_sweep.way(np.array([[1.0, 1.0], [1.0, 5.0]]), 0.5, 1, 0)
