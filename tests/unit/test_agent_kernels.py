"""The kernels of the agent against slower or well-known references, and against their compiled selves."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import osqp
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from msgspec import structs
from scipy import sparse

from fullswarm import kernels
from fullswarm.agent.behaviours import voronoi_coverage
from fullswarm.agent.motion.robot_controller import decide
from fullswarm.agent.neighbours import estimates
from fullswarm.agent.neighbours.objects import no_objects
from fullswarm.agent.safety import barrier
from fullswarm.agent.safety.dead_time import Underway
from fullswarm.agent.safety.filter import (
    FACING_RAD,
    HELD_SHARE,
    RELEASED_SHARE,
    Filtered,
    Measured,
    Requested,
    RobotParams,
    Tuning,
    guard,
    steer,
)
from fullswarm.messages import RobotStates

seeds = st.integers(0, 2**32 - 1)


def _heard(rng: np.random.Generator, count: int, span_m: float) -> np.ndarray:
    predicted = rng.uniform(0.0, span_m, (count, 2))
    predicted[rng.random(count) < 0.1] = math.nan
    return predicted


@given(seeds, st.integers(1, 60), st.floats(1.0, 60.0), st.floats(0.5, 5.0))
@settings(max_examples=60, deadline=None)
def test_cells_find_the_pairs_that_trying_all_finds(seed: int, count: int, span_m: float, reach_m: float) -> None:
    rng = np.random.default_rng(seed)
    predicted = _heard(rng, count, span_m)
    position = rng.uniform(-2.0, span_m + 2.0, (5, 2))
    own_row = np.array([0, min(1, count - 1), -1, -1, -1])
    results = []
    for search in (estimates.all_pairs, estimates.cell_pairs):
        start, other = np.zeros(6, np.int64), np.zeros(5 * count, np.int64)
        found = search(position, own_row, predicted, count, reach_m, start, other)
        assert start[-1] == found
        results.append([sorted(other[start[i] : start[i + 1]]) for i in range(5)])
    assert results[0] == results[1]


def test_a_list_that_is_too_short_says_how_many_there_are() -> None:
    predicted = np.zeros((10, 2))
    start, other = np.zeros(2, np.int64), np.zeros(3, np.int64)
    assert estimates.all_pairs(np.zeros((1, 2)), np.array([-1]), predicted, 10, 1.0, start, other) == 10
    assert start[-1] == 3


@given(seeds, st.integers(1, 14))
@settings(max_examples=40, deadline=None)
def test_projection_equals_osqp(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-math.pi, math.pi, count)
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    limits = np.maximum(rng.uniform(-0.3, 1.0, count), 0.0)
    wish = rng.uniform(-1.0, 1.0, 2)
    planes = barrier.HalfPlanes(normals[:, 0], normals[:, 1], limits, np.zeros(count), np.zeros(count))
    x, y = barrier.project(wish[0], wish[1], planes, count)
    assert (normals @ [x, y] <= limits + 1e-9).all()
    solver = osqp.OSQP()
    solver.setup(
        sparse.eye(2, format="csc"), -wish, sparse.csc_matrix(normals), np.full(count, -np.inf), limits,
        eps_abs=1e-8, eps_rel=1e-8, max_iter=200_000, polishing=True, verbose=False,
    )  # fmt: skip
    answer = solver.solve(raise_error=False)
    assume(answer.info.status == "solved")  # now and then it gives up on near-parallel rows; ours must not
    assert [x, y] == pytest.approx(answer.x, abs=2e-4)


@given(seeds, st.integers(0, 8))
@settings(max_examples=40, deadline=None)
def test_a_cell_equals_shapelys(seed: int, neighbours: int) -> None:
    rng = np.random.default_rng(seed)
    sites = rng.uniform(0.5, 9.5, (neighbours + 1, 2))
    offset = sites[1:] - sites[0]
    centroid = np.zeros((1, 2))
    voronoi_coverage.centroids(
        sites[:1], np.array([0, neighbours]), offset, np.array([0.0, 0.0, 10.0, 10.0]), np.array([50.0]), centroid
    )
    arena = shapely.box(0, 0, 10, 10)
    if neighbours == 0:
        expected = arena.centroid
    else:
        cells = shapely.voronoi_polygons(shapely.MultiPoint(sites), extend_to=shapely.box(-100, -100, 110, 110))
        mine = next(cell for cell in cells.geoms if cell.contains(shapely.Point(sites[0])))
        expected = mine.intersection(arena).centroid
    assert centroid[0] == pytest.approx([expected.x, expected.y], abs=1e-6)


@given(seeds)
@settings(max_examples=60, deadline=None)
def test_the_gap_to_a_box_equals_shapelys(seed: int) -> None:
    rng = np.random.default_rng(seed)
    half, yaw, corner = rng.uniform(0.1, 1.0, 2), rng.uniform(-3, 3), rng.uniform(0, 0.3)
    obstacles = np.array([[1.0, 2.0, half[0], half[1], yaw, corner]])
    x, y = rng.uniform(-3, 6, 2)
    gap, nx, ny = barrier.box_gap(x, y, obstacles, 0)
    box = shapely.affinity.translate(
        shapely.affinity.rotate(
            shapely.box(-half[0], -half[1], half[0], half[1]), yaw, origin=(0, 0), use_radians=True
        ),
        1.0,
        2.0,
    )
    point = shapely.Point(x, y)
    if not box.contains(point):
        assert gap == pytest.approx(box.distance(point) - corner, abs=1e-9)
        assert box.distance(shapely.Point(x + 0.01 * nx, y + 0.01 * ny)) <= box.distance(point)
    assert math.hypot(nx, ny) == pytest.approx(1.0)


def _guard(seed: int, run: Callable[..., int], stall_s: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    count = 6
    pose = np.concatenate([rng.uniform(0.5, 4.5, (count, 2)), rng.uniform(-3, 3, (count, 1))], axis=1)
    heard = np.concatenate([pose, rng.uniform(-0.5, 0.5, (count, 2)), np.full((count, 1), 0.17)], axis=1)
    places = np.ascontiguousarray(pose[:, :2])
    start, other = np.zeros(count + 1, np.int64), np.zeros(count * count, np.int64)
    estimates.all_pairs(places, np.arange(count), places, count, 3.0, start, other)
    twists, deviation, zeros = np.zeros((count, 2)), np.zeros((count, 4)), np.zeros(count)
    moving = no_objects()
    moving.rows[0], moving.used[0], moving.limits[:] = (1.0, 1.0, 0.5, 0.5, 0.3, 0.1), 1, (2.0, 2.0)
    run(
        Tuning(period_s=0.02, reach_m=3.0, speed_gain=1.0, turn_gain_per_s=3.0),
        RobotParams(*(np.full(count, each) for each in (0.17, 0.5, -0.5, 4.0, 2.0, 20.0, 0.0, 0.0, 0.0))),
        Underway(*np.zeros((len(Underway._fields), count))),
        Requested(rng.uniform(-1, 1, (count, 2)), np.ones(count, bool), np.full(count, 2.0), np.full(count, 0.03)),
        estimates.Nearby(start, other, places, heard, zeros, zeros, zeros),
        barrier.Arena(np.array([[2.5, 2.5, 0.5, 0.2, 0.7, 0.0]]), np.array([0.0, 0.0, 5.0, 5.0])),
        moving,
        Filtered(twists, deviation, np.zeros(count, np.int64), np.zeros(count, bool)),
        barrier.HalfPlanes(*np.empty((5, barrier.MAX_ROWS))),
        Measured(pose, np.zeros((count, 2)), zeros, np.zeros((count, 2))), 0.0, 0.02, stall_s,
    )  # fmt: skip
    return np.hstack([twists, deviation])


@given(seeds)
@settings(max_examples=30, deadline=None)
def test_filtered_twists_close_no_gap_faster_than_allowed(seed: int) -> None:
    twists = _guard(seed, guard)[:, :2]
    rng = np.random.default_rng(seed)
    pose = np.concatenate([rng.uniform(0.5, 4.5, (6, 2)), rng.uniform(-3, 3, (6, 1))], axis=1)
    velocity = twists[:, :1] * np.stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])], axis=1)
    assert (np.abs(twists[:, 0]) <= 0.5 + 1e-9).all()
    for i in range(6):
        for j in range(6):
            offset = pose[j, :2] - pose[i, :2]
            distance = np.hypot(*offset)
            if i != j and distance <= 3.0:
                allowed = max(0.0, 2.0 / 2 * (distance - 0.34 - 0.03))
                assert velocity[i] @ offset / distance <= allowed + 1e-9


def test_compiled_and_plain_agree() -> None:
    kernels.compile_all()
    for kernel, call in ((guard, _guard),):
        for seed in range(5):
            for stall_s in (0.0, 0.2):
                np.testing.assert_allclose(call(seed, kernel, stall_s), call(seed, kernel.plain, stall_s), atol=1e-12)
    assert decide.run is not decide.plain


few = st.sampled_from([0.1, 0.2])
pairs = st.tuples(few, few)
unstated = st.just(())


@st.composite
def host_states(draw: st.DrawFn) -> RobotStates:
    limits = draw(st.booleans())
    aims = draw(st.booleans())
    return RobotStates(
        host="h", sequence=1, stamp_s=draw(few), robots=("a", "b"), x_m=draw(pairs), y_m=draw(pairs),
        heading_rad=draw(pairs), speed_m_s=draw(pairs), turn_rad_s=draw(pairs), radius_m=draw(pairs),
        teams=draw(unstated | st.sampled_from([(1, 1), (1, 2)])),
        speed_limit_m_s=draw(pairs) if limits else (), turn_limit_rad_s=draw(pairs) if limits else (),
        accel_m_s2=draw(pairs) if limits else (), sigma_m=draw(unstated | pairs), sigma_rad=draw(unstated | pairs),
        aim_x_m=draw(pairs) if aims else (), aim_y_m=draw(pairs) if aims else (),
    )  # fmt: skip


@given(st.lists(host_states(), min_size=1, max_size=6))
@settings(max_examples=200, deadline=None)
def test_only_the_last_states_of_a_host_count_whatever_came_before(messages: list[RobotStates]) -> None:
    def received(some: list[RobotStates]) -> list[np.ndarray]:
        known = estimates.Neighbours(("own",), 0.5)
        known.delay_of = lambda states, now_s: now_s - states.stamp_s
        for states in some:
            known.receive(structs.replace(states, sequence=len(messages)), 1.0)
        return [known.states, known.limits, known.teams, known.sigma, known.aims, known.delay_s, known.arrival_s]

    for whole, last in zip(received(messages), received(messages[-1:]), strict=True):
        np.testing.assert_array_equal(whole[:2], last[:2])


@given(st.floats(-math.pi, math.pi), st.floats(0.0, 2 * math.pi), st.floats(0.0, 0.09))
@settings(max_examples=50, deadline=None)
def test_a_held_robot_turns_to_where_it_wants_to_go_whatever_little_is_allowed(
    heading: float, direction: float, share: float
) -> None:
    assume(abs(abs(heading) - FACING_RAD) > 1e-9)  # either is right there
    allowed = share * math.cos(direction), share * math.sin(direction)
    speed, turn, held = steer.plain(*allowed, 1.0, 0.0, heading, False, 1.0, 3.0)
    assert held
    assert speed >= 0.0, "it does not reverse"
    assert turn == pytest.approx(-3.0 * heading if abs(heading) > FACING_RAD else 0.0, abs=1e-9)
    assert steer.plain(*allowed, 1.0, 0.0, heading, True, 1.0, 3.0) == (speed, turn, True)


def test_a_robot_is_released_by_more_than_by_what_it_is_held() -> None:
    allowed = 0.5 * (HELD_SHARE + RELEASED_SHARE)
    for before in (False, True):
        assert steer.plain(0.0, allowed, 1.0, 0.0, 0.0, before, 1.0, 3.0)[2] == before
        assert not steer.plain(0.0, 1.1 * RELEASED_SHARE, 1.0, 0.0, 0.0, before, 1.0, 3.0)[2]
