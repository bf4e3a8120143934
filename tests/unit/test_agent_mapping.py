"""From scans to the filter's obstacles, to moving bodies, and to a grid that robots share."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.agent.mapping.clusters import disc_around, merged, moving_bodies
from fullswarm.agent.mapping.grid import OccupancyGrid
from fullswarm.agent.mapping.sense import RangeSense, points_of
from fullswarm.agent.mapping.sharing import GridSharing, planning_boxes
from fullswarm.agent.neighbours.obstacle_map import OWN, SHARED, ObstacleMap
from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.drivers.base import Description, Limits, Pose, RangeScan
from fullswarm.errors import MessageError
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.maps.boxes import boxes, rectangles
from fullswarm.maps.tiles import FREE, OCCUPIED, SIDE, GridPlace, pack, unpack
from fullswarm.messages import GridTiles
from fullswarm.runtime import Mailbox, Runtime
from tests.unit.test_agent_objects import RADIUS, receive, table

BOUNDS = (-5.0, -5.0, 5.0, 5.0)
LIDAR = Description("sim", "", RADIUS, Limits(0.5, 4.0, 2.0, 20.0), ranges_max_m=6.0)
ANGLES = np.linspace(-math.pi, math.pi, 360, endpoint=False)
KEYS = Keys()


def circle(x: float, y: float, radius: float, eye: tuple[float, float] = (0.0, 0.0)) -> Array:
    """Distances of a lidar at `eye`, heading 0, to one disc."""
    found = np.full(len(ANGLES), math.inf)
    dx, dy = x - eye[0], y - eye[1]
    along = dx * np.cos(ANGLES) + dy * np.sin(ANGLES)
    inside = radius**2 - (dx**2 + dy**2 - along**2)
    hit = (inside > 0.0) & (along > 0.0)
    found[hit] = along[hit] - np.sqrt(inside[hit])
    return found


def scan(distances: Array, stamp_s: float) -> tuple[tuple[int, RangeScan], ...]:
    return ((0, RangeScan(stamp_s, ANGLES, distances, 6.0)),)


HERE, EXACT, STANDS = np.zeros((1, 3)), np.zeros((1, 2)), np.zeros((1, 2))


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 9))
@settings(max_examples=60, deadline=None)
def test_boxes_cover_the_occupied_cells_and_nothing_else(seed: int, rows: int, columns: int) -> None:
    occupied = np.random.default_rng(seed).random((rows, columns)) < 0.5
    covered = np.zeros((rows, columns), int)
    for low, left, high, right in rectangles(occupied).tolist():
        covered[low:high, left:right] += 1
    assert np.array_equal(covered, occupied.astype(int))
    assert (4.0 * boxes(occupied, 0.0, 0.0, 1.0)[:, 2] * boxes(occupied, 0.0, 0.0, 1.0)[:, 3]).sum() == occupied.sum()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30, deadline=None)
def test_tiles_come_back_as_they_were_sent(seed: int) -> None:
    rng = np.random.default_rng(seed)
    place = GridPlace.over(BOUNDS, 0.1)
    states = rng.integers(0, 3, (place.rows, place.columns)).astype(np.uint8)
    chosen = rng.choice(place.tiles, 4, replace=False).tolist()
    for number, tile in unpack(pack(place, states, chosen, "r1", 1.0)):
        assert np.array_equal(tile, place.tile(states, number))


@given(st.binary(max_size=300), st.lists(st.integers(0, 2000), min_size=1, max_size=3))
@settings(max_examples=100, deadline=None)
def test_damaged_tiles_are_refused(cells: bytes, tiles: list[int]) -> None:
    message = GridTiles(
        host="r1", x_min_m=0.0, y_min_m=0.0, cell_m=0.1, rows=2 * SIDE, columns=SIDE, tiles=tuple(tiles), cells=cells,
        stamp_s=0.0,
    )  # fmt: skip
    with pytest.raises(MessageError):
        unpack(message)


def test_rays_free_what_they_pass_and_what_has_gone_is_forgotten() -> None:
    grid = OccupancyGrid(GridPlace.over(BOUNDS, 0.05))
    end = np.array([[2.0, 0.0]])
    for _ in range(5):
        grid.add(np.zeros(2), end, np.array([True]), np.array([False]))
    on, before = grid.place.cells(np.array([[2.0, 0.0], [1.0, 0.0]])).tolist()
    states = grid.states().reshape(-1)
    assert (states[on], states[before]) == (OCCUPIED, FREE)
    for _ in range(8):
        grid.add(np.zeros(2), 2.0 * end, np.array([False]), np.array([False]))
    assert grid.states().reshape(-1)[on] == FREE


def test_what_is_near_is_an_obstacle_at_once_and_a_received_robot_never() -> None:
    sense = RangeSense([LIDAR], table(("other", 1.0, 0.0)), BOUNDS, 0.05, np.array([RADIUS]))
    assert sense.update(0.0, HERE, EXACT, STANDS, scan(circle(1.0, 0.0, RADIUS), 0.0))
    assert len(sense.obstacles) == 0
    assert not sense.occupied().any()
    both = np.minimum(circle(1.0, 0.0, RADIUS), circle(0.0, 0.8, 0.1))
    receive(sense._neighbours, "other", 1.0, 0.0, 0.1)
    sense.update(0.1, HERE, EXACT, STANDS, scan(both, 0.1))
    nearest = min(
        math.hypot(max(abs(x) - half_x, 0.0), max(abs(y) - half_y, 0.0))
        for x, y, half_x, half_y, _, _ in sense.obstacles.tolist()
    )
    assert nearest == pytest.approx(0.7, abs=0.06)
    assert not sense.update(0.12, HERE, EXACT, STANDS, sense._last)


def test_robots_of_the_same_agent_are_no_obstacles_to_each_other_and_leave_nothing_behind() -> None:
    """As in lockstep, where one agent has them all and receives none."""
    sense = RangeSense([LIDAR, LIDAR], table(), BOUNDS, 0.05, np.array([RADIUS, RADIUS]))
    pose, still = np.zeros((2, 3)), np.zeros((2, 2))
    pose[1, 0] = 1.0
    for number in range(5):
        (seen,) = scan(circle(1.0, 0.0, RADIUS), 0.1 * number)
        assert sense.update(0.1 * number, pose, still, still, (seen,))
    assert len(sense.obstacles) == 0
    assert not sense.occupied().any()
    assert len(sense.bodies) == 0
    wall = np.abs(np.divide(RADIUS + 0.04, np.cos(ANGLES)))
    wall[np.abs(ANGLES) > 1.0] = math.inf
    (seen,) = scan(np.minimum(wall, 6.0), 1.0)
    sense.update(1.0, pose, still, still, (seen,))
    assert len(sense.obstacles) > 0, "a wall 4 cm from its own rim is none of its kind"


def test_a_scan_from_an_unknown_pose_is_left_out() -> None:
    sense = RangeSense([LIDAR], table(), BOUNDS, 0.05, np.array([RADIUS]))
    assert not sense.update(0.0, np.full((1, 3), math.nan), EXACT, STANDS, scan(circle(0.0, 0.8, 0.1), 0.0))


def test_of_a_scan_that_measured_nothing_at_all_nothing_follows() -> None:
    sense = RangeSense([LIDAR], table(), BOUNDS, 0.05, np.array([RADIUS]))
    sense.update(0.0, HERE, EXACT, STANDS, scan(circle(0.0, 0.8, 0.1), 0.0))
    before = sense.grid.odds.copy()
    assert sense.update(0.1, HERE, EXACT, STANDS, scan(np.full(len(ANGLES), math.nan), 0.1))
    assert np.array_equal(sense.grid.odds, before)
    assert len(sense.obstacles) > 0


def test_what_moves_through_free_space_is_a_body_and_a_wall_is_none() -> None:
    sense = RangeSense([LIDAR], table(), BOUNDS, 0.05, np.array([RADIUS]))
    rng = np.random.default_rng(1)
    wall = 2.5 / np.maximum(np.sin(ANGLES), 1e-3)
    wall[(wall > 6.0) | (np.sin(ANGLES) <= 0.0)] = math.inf
    seen = []
    for step in range(40):
        now_s = 0.1 * step
        person = circle(2.0 - 0.5 * now_s, -1.0, 0.25) if step >= 5 else np.full(len(ANGLES), math.inf)
        distances = np.minimum(wall, person) + rng.normal(0.0, 0.01, len(ANGLES))
        sense.update(now_s, HERE, EXACT, STANDS, scan(distances, now_s))
        if step >= 8:
            seen.append(len(sense.bodies))
            if len(sense.bodies):
                assert sense.bodies[0] == pytest.approx([2.0 - 0.5 * now_s, -1.0, 0.25], abs=0.1)
    assert max(seen) == 1
    assert np.mean(seen) > 0.9


@pytest.mark.parametrize("speed_m_s", [0.25, 0.5, 1.0])
def test_what_comes_straight_on_from_out_of_range_is_a_body_wherever_it_is_within_range(speed_m_s: float) -> None:
    sense = RangeSense([LIDAR], table(), (-5.0, -5.0, 7.0, 5.0), 0.05, np.array([RADIUS]))
    noise = np.random.default_rng(1)
    for step in range(200):
        away_m = 5.5 - speed_m_s * 0.1 * step
        if away_m < 0.8:
            break
        wall = circle(-3.0, -3.0, 0.5)
        distances = np.minimum(circle(away_m, 0.0, 0.25), wall) + noise.normal(0.0, 0.01, len(ANGLES))
        sense.update(0.1 * step, HERE, EXACT, STANDS, scan(distances, 0.1 * step))
        if away_m < 3.5:
            assert len(sense.bodies) == 1, away_m
            assert math.hypot(sense.bodies[0, 0] - away_m, sense.bodies[0, 1]) < 0.15


@pytest.mark.parametrize("away_m", [0.6, 1.5, 3.0])
def test_a_disc_is_found_from_the_side_that_is_seen(away_m: float) -> None:
    rng = np.random.default_rng(2)
    distances = circle(away_m, 0.4, 0.25) + rng.normal(0.0, 0.01, len(ANGLES))
    hit = np.isfinite(distances)
    points = distances[hit, None] * np.column_stack([np.cos(ANGLES[hit]), np.sin(ANGLES[hit])])
    assert disc_around(np.zeros(2), points) == pytest.approx((away_m, 0.4, 0.25), abs=0.06)
    count, numbers = len(points), np.arange(len(points), dtype=np.int64)
    assert len(moving_bodies(np.zeros(2), points, numbers, np.ones(count, bool))[0]) == 1
    assert not len(moving_bodies(np.zeros(2), points, numbers, np.zeros(count, bool))[0])


def test_one_body_seen_by_two_robots_is_one() -> None:
    assert merged(np.array([[0.0, 0.0, 0.2], [0.1, 0.0, 0.25], [2.0, 0.0, 0.3]])).tolist() == [
        [0.05, 0.0, 0.25], [2.0, 0.0, 0.3],
    ]  # fmt: skip


def test_a_scan_of_a_turning_robot_is_laid_out_as_it_was_measured() -> None:
    angles = np.linspace(-math.pi, math.pi, 100, endpoint=False)
    # A robot that turns by 1 rad while its sensor turns once sees one point from each heading that it had.
    heading = 0.3 + np.linspace(-1.0, 0.0, 100)
    bearing = np.arctan2(np.sin(angles + heading), np.cos(angles + heading))
    found = RangeScan(5.0, angles, 2.0 + 0.1 * np.cos(bearing), 6.0, Pose(0.0, 0.0, 0.0), duration_s=0.1)
    _, ends, _, _ = points_of(found, np.array([0.0, 0.0, 0.3]), np.array([0.0, 10.0]), 5.0)
    away, towards = np.hypot(*ends.T), np.arctan2(ends[:, 1], ends[:, 0])
    assert away == pytest.approx(2.0 + 0.1 * np.cos(towards), abs=2e-3)


def shared(bus: LocalBus, runtime: Runtime, host: str) -> tuple[RangeSense, GridSharing, ObstacleMap]:
    sense = RangeSense([LIDAR], table(), BOUNDS, 0.05, np.array([RADIUS]))
    known = ObstacleMap(1, np.zeros((0, 6)))
    return sense, GridSharing(bus, KEYS, runtime, host, sense, known, BOUNDS, ("r1", "r2")), known


def test_what_one_robot_has_measured_others_plan_with_and_a_stranger_is_not_believed() -> None:
    mailbox = Mailbox()
    bus, runtime = LocalBus(mailbox), Runtime(SimClock(), mailbox)
    one, sending, _ = shared(bus, runtime, "r1")
    _, taking, known = shared(bus, runtime, "r2")
    _, strange, _ = shared(bus, runtime, "r9")
    one.update(0.0, HERE, EXACT, STANDS, scan(circle(2.0, 1.0, 0.3), 0.0))
    sizes: list[int] = []
    bus.subscribe(KEYS.grid(), GridTiles, lambda message: sizes.append(len(message.cells)))
    sending.update(0.0)
    mailbox.drain()
    taking.update(0.1)
    assert 0 < sizes[0] < 3000
    assert len(known.known(0, OWN)) == 0
    assert 0 < len(known.known(0, SHARED)) < 12
    assert np.abs(known.known(0, SHARED)[:, :2] - (1.8, 0.9)).max() < 0.5
    strange._sense.grid.odds[:] = 2.0
    strange._sense.grid.changed[:] = True
    before = taking.others.copy()
    strange.update(0.2)
    mailbox.drain()
    assert np.array_equal(taking.others, before)


def test_a_planner_gets_few_boxes_without_gaps_and_without_the_arenas_edge() -> None:
    place = GridPlace.over(BOUNDS, 0.05)
    occupied = np.zeros((place.rows, place.columns), bool)
    x = place.x_min + (np.arange(place.columns) + 0.5) * 0.05
    y = place.y_min + (np.arange(place.rows) + 0.5) * 0.05
    ring = (
        (np.abs(x[None, :]) < 0.5)
        & (np.abs(y[:, None]) < 0.5)
        & ~((np.abs(x[None, :]) < 0.4) & (np.abs(y[:, None]) < 0.4))
    )
    occupied |= ring & (np.random.default_rng(3).random(ring.shape) < 0.7)
    occupied |= x[None, :] < -4.97
    found = planning_boxes(occupied, place, BOUNDS)
    assert len(found) <= 6
    assert np.abs(found[:, :2]).max() < 1.0
    assert (4.0 * found[:, 2] * found[:, 3]).sum() == pytest.approx(1.0, abs=0.3)


def test_a_robot_is_blind_before_its_first_scan_and_when_any_sensor_is_silent() -> None:
    seeing = Description("x", "", 0.2, Limits(0.5, 4.0, 2.0, 20.0), ranges_max_m=6.0)
    without = Description("x", "", 0.2, Limits(0.5, 4.0, 2.0, 20.0))
    sense = RangeSense([seeing, without], table(), (-5.0, -5.0, 5.0, 5.0), 0.05, np.array([0.2, 0.2]))

    def look(now_s: float, *stamps_s: float) -> list[bool]:
        angles = np.linspace(-3.0, 3.0, 60)
        scans = tuple(
            (0, RangeScan(stamp_s, angles, np.full(60, 2.0), 6.0, name=str(place)))
            for place, stamp_s in enumerate(stamps_s)
        )
        sense.update(now_s, np.array([[math.nan] * 3, [0.0, 0.0, 0.0]]), np.zeros((2, 2)), np.zeros((2, 2)), scans)
        return list(sense.blind.tolist())

    assert look(0.0) == [True, False]
    assert look(1.0, 1.0) == [False, False]  # although where it is is not known
    assert look(1.5, 1.0) == [False, False]
    assert look(1.51, 1.0) == [True, False]
    assert look(2.0, 1.9, 1.9) == [False, False]
    assert look(2.5, 2.4, 1.9) == [True, False]
