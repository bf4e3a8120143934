"""Ways on maps: exact clearances, passages wherever they lie, and what is said where there is no way."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from shapely import affinity
from shapely.geometry import LineString, Point, box
from shapely.geometry.base import BaseGeometry

from fullswarm import kernels
from fullswarm.agent.behaviours.navigate import LOOK_M, PASSAGE_M
from fullswarm.agent.navigation import passages, planner
from fullswarm.agent.navigation.geometry import free_ways, gap_to, gaps, is_free, way_gaps, with_edges
from fullswarm.agent.navigation.roadmap import Clearance, Field, build_field, build_roadmap
from fullswarm.agent.navigation.route import Lattice, follow
from fullswarm.reasons import Code

BOUNDS = (0.0, 0.0, 10.0, 10.0)
CLEARANCE = Clearance(0.205, 0.29)
FREE = np.zeros((0, 6))
TRAIL = np.zeros(256, np.int64)


def shape(row: np.ndarray) -> BaseGeometry:
    """Return an obstacle as Shapely sees it; arcs are drawn with 64 corners a quarter."""
    x, y, half_x, half_y, yaw, corner_m = row.tolist()
    turned = affinity.rotate(box(-half_x, -half_y, half_x, half_y), yaw, origin=(0.0, 0.0), use_radians=True)
    moved: BaseGeometry = affinity.translate(turned, x, y)
    return moved.buffer(corner_m, quad_segs=64) if corner_m > 0.0 else moved


obstacles: st.SearchStrategy[np.ndarray] = st.lists(
    st.tuples(
        st.floats(0.5, 9.5), st.floats(0.5, 9.5), st.floats(0.05, 1.5), st.floats(0.05, 1.5), st.floats(-4.0, 4.0),
        st.sampled_from([0.0, 0.2]),
    ),
    min_size=1,
    max_size=4,
).map(np.array)  # fmt: skip
points = st.tuples(st.floats(0.0, 10.0), st.floats(0.0, 10.0))


@given(obstacles, points, points, st.floats(0.05, 1.0))
@settings(max_examples=150)
def test_a_straight_way_is_as_clear_as_shapely_says(
    rows: np.ndarray, start: tuple[float, float], end: tuple[float, float], clearance_m: float
) -> None:
    way = LineString([start, end]) if start != end else Point(start)
    nearest_m = min(shape(row).distance(way) for row in rows)
    assume(abs(nearest_m - clearance_m) > 1e-3)
    one = is_free(*start, *end, clearance_m, rows)
    gap_m = float(way_gaps(np.array([start]), np.array([end]), rows, 3.0)[0])
    assert max(gap_m, 0.0) == pytest.approx(min(nearest_m, 3.0), abs=1e-3)
    many = free_ways(np.array([start]), np.array([end]), clearance_m, rows)
    assert one == bool(many[0]) == (nearest_m > clearance_m)


@given(obstacles, points)
def test_the_gap_of_a_place_is_the_same_for_one_and_for_many(rows: np.ndarray, place: tuple[float, float]) -> None:
    assert gap_to(*place, rows, 3.0) == pytest.approx(float(gaps(np.array([place]), rows, 3.0)[0]), abs=1e-9)


@given(obstacles)
def test_a_passage_is_a_free_strip_as_wide_as_the_gap(rows: np.ndarray) -> None:
    found = passages.find(rows)
    shapes = [shape(row) for row in rows]
    for x, y, axis_x, axis_y, half_m, width_m in np.column_stack(found).tolist():
        axis = LineString([(x - half_m * axis_x, y - half_m * axis_y), (x + half_m * axis_x, y + half_m * axis_y)])
        apart = sorted(each.distance(Point(x, y)) for each in shapes)
        assert apart[0] == pytest.approx(0.5 * width_m, abs=2e-3)
        assert apart[1] == pytest.approx(0.5 * width_m, abs=2e-3)
        pair = sorted(shapes, key=lambda each: each.distance(Point(x, y)))[:2]
        assert min(each.distance(axis) for each in pair) == pytest.approx(0.5 * width_m, abs=2e-3)


def wall(width_m: float, x: float, y: float, yaw: float) -> np.ndarray:
    """Return a wall with a door at (x, y) that reaches beyond the arena."""
    rows = []
    for sign in (-1.0, 1.0):
        off = sign * (0.5 * width_m + 8.0)
        rows.append((x - off * math.sin(yaw), y + off * math.cos(yaw), 0.1, 8.0, yaw, 0.0))
    return np.array(rows)


def lattice(field: Field) -> Lattice:
    return Lattice(*field.grid, field.preferred_m, LOOK_M, PASSAGE_M)


@given(st.floats(3.5, 6.5), st.floats(3.5, 6.5), st.floats(-math.pi, math.pi), st.sampled_from([0.42, 0.5, 0.7]))
@settings(max_examples=8, deadline=None)
def test_a_door_is_found_wherever_it_lies_and_driven_through_with_the_clearance_that_is_left(
    x: float, y: float, yaw: float, width_m: float
) -> None:
    rows = wall(width_m, x, y, yaw)
    ahead = np.array([math.cos(yaw), math.sin(yaw)])
    place, goal = np.array([x, y]) - 2.0 * ahead + 0.8 * ahead[::-1] * (-1, 1), np.array([x, y]) + 2.0 * ahead
    field = planner.field_of((float(goal[0]), float(goal[1])), rows, BOUNDS, CLEARANCE)
    shapes = [shape(row) for row in rows]
    gates = set()
    for _ in range(400):
        to_x, to_y, gate, length_m = follow(float(place[0]), float(place[1]), field.ways, lattice(field), TRAIL)
        assert math.isfinite(length_m)
        gates.add(gate)
        towards = np.array([to_x, to_y]) - place
        left_m = float(np.hypot(*towards))
        if left_m < 1e-9:
            break
        place = place + towards * min(1.0, 0.04 / left_m)
        assert min(each.distance(Point(place)) for each in shapes) > 0.17 + 0.03
    assert np.hypot(*(goal - place)) < 0.05
    assert len(gates - {0}) == 1, "it knew of the passage before it"


def test_a_door_narrower_than_the_robot_and_its_margin_is_no_way_and_the_reason_says_how_wide_it_is() -> None:
    rows = wall(0.4, 5.03, 5.07, 0.3)
    field = build_field(build_roadmap(rows, BOUNDS, CLEARANCE), (8.0, 5.0))
    assert follow(2.0, 5.0, field.ways, lattice(field), TRAIL)[3] == math.inf
    why = planner.no_way(2.0, 5.0, (8.0, 5.0), rows, BOUNDS, CLEARANCE.least_m)
    assert why.code == Code.NO_WAY
    assert why.parameters["needed_m"] == "0.41"
    assert why.parameters["widest_m"] == "0.40"


def test_the_widest_way_is_that_of_the_wider_of_two_doors() -> None:
    rows = np.array([
        [5.0, 1.0, 0.1, 1.0, 0.0, 0.0], [5.0, 4.2, 0.1, 2.0, 0.0, 0.0], [5.0, 8.25, 0.1, 1.75, 0.0, 0.0],
    ])  # doors of 0.2 m and 0.3 m  # fmt: skip
    assert planner.widest_way_m((2.0, 2.0), (8.0, 2.0), rows, BOUNDS) == pytest.approx(0.3, abs=1e-6)
    closed = np.array([[5.0, 5.0, 0.1, 5.0, 0.0, 0.0]])
    assert planner.widest_way_m((2.0, 2.0), (8.0, 2.0), closed, BOUNDS) == 0.0


def test_a_goal_in_an_obstacle_is_replaced_by_the_nearest_free_place() -> None:
    rows = np.array([[5.0, 5.0, 0.5, 0.5, 0.0, 0.0]])
    field = build_field(build_roadmap(rows, BOUNDS, CLEARANCE), (5.0, 4.6))
    assert 0.305 <= field.short_m < 0.305 + 0.3
    assert Point(field.goal_m).distance(shape(rows[0])) >= CLEARANCE.least_m


@given(st.tuples(st.floats(3.0, 7.0), st.floats(3.0, 7.0)), st.floats(0.5, 2.4), st.floats(-math.pi, math.pi))
@settings(max_examples=40, deadline=None)
def test_in_the_open_the_way_is_straight(start: tuple[float, float], away_m: float, bearing: float) -> None:
    roadmap = planner.roadmap_of(FREE, BOUNDS, CLEARANCE)
    goal = start[0] + away_m * math.cos(bearing), start[1] + away_m * math.sin(bearing)
    to_x, to_y, gate, length_m = follow(*start, (field := build_field(roadmap, goal)).ways, lattice(field), TRAIL)
    assert (to_x, to_y) == pytest.approx(goal)
    assert gate == 0
    assert length_m >= math.dist(start, goal) - 1e-9


@given(obstacles, points, points)
@settings(max_examples=30, deadline=None)
def test_a_straight_way_to_the_next_point_is_as_clear_as_allowed_or_as_the_robot_is_now(
    rows: np.ndarray, start: tuple[float, float], goal: tuple[float, float]
) -> None:
    field = build_field(build_roadmap(rows, BOUNDS, CLEARANCE), goal)
    assume(gap_to(*start, with_edges(rows, BOUNDS), 3.0) > CLEARANCE.least_m)
    to_x, to_y, _, length_m = follow(*start, field.ways, lattice(field), TRAIL)
    assume(math.isfinite(length_m) and math.dist(start, (to_x, to_y)) > 0.3)
    way = LineString([start, (to_x, to_y)])
    assert min(shape(row).distance(way) for row in rows) > CLEARANCE.least_m - 0.004


def test_plain_and_compiled_find_the_same_next_point() -> None:
    rows = np.vstack([wall(0.42, 5.1, 4.9, 0.7), [[2.0, 7.0, 0.3, 0.6, 0.4, 0.0]]])
    field = planner.field_of((8.0, 8.0), rows, BOUNDS, CLEARANCE)
    rng = np.random.default_rng(5)
    places = rng.uniform(0.3, 9.7, (100, 2)).tolist()
    plain = [follow.plain(x, y, field.ways, lattice(field), TRAIL) for x, y in places]
    kernels.compile_all()
    assert [follow(x, y, field.ways, lattice(field), TRAIL) for x, y in places] == plain
