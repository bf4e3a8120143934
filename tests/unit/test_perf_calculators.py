"""Calculators: known distances, contact hysteresis, coverage against brute force, compiled against plain."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from fullswarm.bus.local import LocalBus
from fullswarm.clock import SimClock
from fullswarm.errors import ConfigError, MessageError
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.messages import CoverageMeasurement
from fullswarm.perf import calculators
from fullswarm.perf.calculators import (
    Calculators,
    CollisionCalculator,
    CoverageCalculator,
    SmoothnessCalculator,
    WorkCalculator,
)
from fullswarm.perf.coverage import GridFrame, count_bits, pack, unpack_bits
from fullswarm.perf.metrics import COLUMNS
from fullswarm.runtime import Runtime

DT_S = 0.02


# ---------------------------------------------------------------- work
def drive(work: WorkCalculator, path: list[tuple[float, float]], dt_s: float = DT_S) -> float:
    for tick, point in enumerate(path):
        work.update(tick * dt_s, np.array([point]), dt_s)
    return float(work.distance_m[0])


def test_a_square_of_one_metre_is_four_metres() -> None:
    steps = np.arange(0.0, 1.0, 0.01)
    square = [(s, 0.0) for s in steps] + [(1.0, s) for s in steps]
    square += [(1.0 - s, 1.0) for s in steps] + [(0.0, 1.0 - s) for s in steps] + [(0.0, 0.0)]
    assert drive(WorkCalculator(1, 0.5), square) == pytest.approx(4.0)


def test_each_robot_has_its_own_distance() -> None:
    work = WorkCalculator(3, [0.5, 1.0, 0.5])
    for tick in range(51):
        work.update(tick * DT_S, np.array([[tick * 0.01, 0.0], [5.0, tick * -0.02], [1.0, 1.0]]), DT_S)
    assert work.distance_m == pytest.approx([0.5, 1.0, 0.0])


def test_a_jump_is_not_travel_and_does_not_hide_what_follows() -> None:
    path = [(0.0, 0.0), (0.01, 0.0), (5.0, 5.0), (5.01, 5.0)]
    assert drive(WorkCalculator(1, 0.5), path) == pytest.approx(0.02)


def test_twice_the_top_speed_is_the_most_that_counts() -> None:
    assert drive(WorkCalculator(1, 0.5), [(0.0, 0.0), (0.0199, 0.0)]) == pytest.approx(0.0199)
    assert drive(WorkCalculator(1, 0.5), [(0.0, 0.0), (0.0201, 0.0)]) == 0.0


def test_readings_slower_than_the_loop_lose_nothing() -> None:
    path = [(0.05 * (tick // 5), 0.0) for tick in range(101)]  # 0.5 m/s, told at 10 Hz to a 50 Hz loop
    assert drive(WorkCalculator(1, 0.5), path) == pytest.approx(1.0)


def test_a_gap_in_the_positions_is_bridged() -> None:
    unknown = (math.nan, math.nan)
    path = [(0.0, 0.0), *[unknown] * 9, (0.1, 0.0), (math.inf, 0.0), (0.11, 0.0)]
    assert drive(WorkCalculator(1, 0.5), path) == pytest.approx(0.11)


def test_a_teleport_after_a_long_stand_is_a_jump() -> None:
    assert drive(WorkCalculator(1, 0.5), [(0.0, 0.0)] * 500 + [(3.0, 0.0)]) == 0.0


# ---------------------------------------------------------------- collisions
def events_of(contacts: str, dt_s: float = 0.05) -> int:
    """Run one robot through contacts such as ``"..##.."``."""
    collision = CollisionCalculator(1)
    for tick, sign in enumerate(contacts):
        collision.update(tick * dt_s, np.array([2 if sign == "#" else 0]))
    return int(collision.events[0])


@pytest.mark.parametrize(
    ("contacts", "events"),
    [
        (".....", 0),
        ("#", 1),  # touching from the start
        ("..####################", 1),  # one long contact
        ("#.#.#.#.#", 1),  # rattling
        ("#....#", 2),  # 0.25 s from the last touch to the next
        ("#...#", 1),  # 0.20 s
        ("#...#...#....#", 2),
    ],
)
def test_a_contact_counts_anew_after_a_quarter_second_without(contacts: str, events: int) -> None:
    assert events_of(contacts) == events


def test_a_loop_that_hung_during_a_contact_counts_it_once() -> None:
    assert events_of("####", dt_s=0.6) == 1


def test_contacts_are_counted_per_robot() -> None:
    collision = CollisionCalculator(3)
    collision.update(0.0, np.array([1, 0, 0]))
    collision.update(0.3, np.array([0, 0, 1]))
    collision.update(0.6, np.array([1, 0, 1]))
    assert collision.events.tolist() == [2, 0, 1]


# ---------------------------------------------------------------- coverage
BOUNDS = (-1.0, 2.0, 3.0, 5.0)


def brute_force(points: list[tuple[float, float]], radius_m: float, frame: GridFrame, slack_m: float) -> Array:
    x = frame.origin_x_m + (np.arange(frame.columns) + 0.5) * frame.cell_m
    y = frame.origin_y_m + (np.arange(frame.rows) + 0.5) * frame.cell_m
    covered = np.zeros((frame.rows, frame.columns), bool)
    for px, py in points:
        covered |= np.hypot(x[None, :] - px, y[:, None] - py) <= radius_m + slack_m
    return covered.astype(float)


coordinate = st.floats(-3.0, 7.0)


@given(
    points=st.lists(st.tuples(coordinate, coordinate), min_size=1, max_size=5),
    radius_m=st.floats(0.01, 1.5),
    cell_m=st.floats(0.07, 0.9),
)
@settings(max_examples=60, deadline=None)
def test_coverage_is_what_brute_force_finds(points: list[tuple[float, float]], radius_m: float, cell_m: float) -> None:
    coverage = CoverageCalculator(BOUNDS, cell_m, [radius_m])
    marks: list[tuple[float, float]] = []
    for point in points:
        coverage.update(np.array([point]))
        if not marks or math.dist(point, marks[-1]) >= 0.25 * cell_m:
            marks.append(point)
    # A centre exactly on the rim may go either way.
    at_least = brute_force(marks, radius_m, coverage.frame, -1e-9)
    at_most = brute_force(marks, radius_m, coverage.frame, 1e-9)
    assert np.all(at_least <= coverage.grid)
    assert np.all(coverage.grid <= at_most)
    assert coverage.covered == coverage.grid.sum()


def test_robots_of_a_host_share_the_grid() -> None:
    coverage = CoverageCalculator((0.0, 0.0, 4.0, 2.0), 0.1, [0.5, 0.5])
    coverage.update(np.array([[1.0, 1.0], [3.0, 1.0]]))
    assert coverage.covered * 0.01 == pytest.approx(2 * math.pi * 0.25, rel=0.03)
    before = coverage.covered
    coverage.update(np.array([[3.0, 1.0], [1.0, 1.0]]))  # where the other one was
    assert coverage.covered == before


def test_a_move_below_a_quarter_cell_is_not_marked_but_such_moves_add_up() -> None:
    coverage = CoverageCalculator((0.0, 0.0, 1.0, 1.0), 0.1, [0.05])
    for x in (0.5, 0.51, 0.52):
        coverage.update(np.array([[x, 0.5]]))
        assert coverage.marked[0, 0] == 0.5
    coverage.update(np.array([[0.53, 0.5]]))
    assert coverage.marked[0, 0] == 0.53


@pytest.mark.parametrize("x", [-1e300, -50.0, 50.0, 1e300, math.nan, math.inf])
def test_a_robot_out_of_the_arena_covers_nothing(x: float) -> None:
    coverage = CoverageCalculator((0.0, 0.0, 1.0, 1.0), 0.1, [0.2])
    coverage.update(np.array([[x, 0.5]]))
    assert coverage.covered == 0


def test_an_arena_of_20_m_has_200_cells_of_10_cm_each_way() -> None:
    frame = GridFrame.over((0.0, 0.0, 20.0, 20.0), 0.1)
    assert (frame.rows, frame.columns) == (200, 200)
    assert GridFrame.over((0.0, 0.0, 1.0, 0.55), 0.1).rows == 6


@pytest.mark.parametrize(
    ("bounds", "cell_m", "message"),
    [((0.0, 0.0, 0.0, 1.0), 0.1, "no coverage grid"), ((0.0, 0.0, 20.0, 20.0), 0.001, "too large")],
)
def test_an_impossible_grid_is_refused(bounds: tuple[float, float, float, float], cell_m: float, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        GridFrame.over(bounds, cell_m)
    assert caught.value.hint


@given(arrays(np.uint8, st.tuples(st.integers(1, 20), st.integers(1, 20)), elements=st.integers(0, 1)))
@settings(deadline=None)
def test_a_packed_grid_comes_back(grid: NDArray[np.uint8]) -> None:
    frame = GridFrame(0.0, 0.0, 0.1, *grid.shape)
    bits = unpack_bits(pack(grid), frame)
    assert np.unpackbits(bits, count=grid.size).reshape(grid.shape).tolist() == grid.tolist()
    assert count_bits(bits) == grid.sum()


def test_a_grid_that_does_not_unpack_is_refused() -> None:
    frame = GridFrame(0.0, 0.0, 0.1, 10, 10)
    good = pack(np.ones((10, 10), np.uint8))
    bombs = [b"", b"nonsense", good[:-9], pack(np.ones((10, 20), np.uint8)), pack(np.zeros((2000, 2000), np.uint8))]
    for data in bombs:
        with pytest.raises(MessageError):
            unpack_bits(data, frame)


# ---------------------------------------------------------------- all three
def wander(n: int, ticks: int, seed: int = 1) -> tuple[Array, NDArray[np.int64]]:
    rng = np.random.default_rng(seed)
    poses = np.empty((ticks, n, 3))
    poses[:, :, 2] = np.cumsum(rng.normal(0.0, 0.1, (ticks, n)), axis=0)
    steps = 0.08 * np.stack((np.cos(poses[:, :, 2]), np.sin(poses[:, :, 2])), axis=2)
    poses[:, :, :2] = rng.uniform(2.0, 18.0, (1, n, 2)) + np.cumsum(steps, axis=0)
    poses[rng.random((ticks, n)) < 0.02] = math.nan
    return poses, (rng.random((ticks, n)) < 0.1).astype(np.int64)


def calculate(n: int, poses: Array, contacts: NDArray[np.int64]) -> Calculators:
    bounds = (0.0, 0.0, 20.0, 20.0)
    result = Calculators([f"r{row}" for row in range(n)], bounds, 0.1, np.full(n, 0.17), 4.0)
    for tick in range(len(poses)):
        result.update(tick * DT_S, poses[tick], contacts[tick], DT_S)
    return result


@pytest.fixture
def compiled() -> Iterator[None]:
    """Compile the kernels of this package only, for one test only."""
    pytest.importorskip("numba")
    kernels = (calculators.travel, calculators.touch, calculators.cover, calculators.measure)
    calculators.measure.compile()
    assert all(each.run is not each.plain for each in kernels)
    yield
    for each in kernels:
        each.run = each.plain


def test_together_they_give_what_each_gives_alone() -> None:
    poses, contacts = wander(4, 60)
    together = calculate(4, poses, contacts)
    work, collision = WorkCalculator(4, 4.0), CollisionCalculator(4)
    coverage = CoverageCalculator((0.0, 0.0, 20.0, 20.0), 0.1, np.full(4, 0.17))
    for tick in range(60):
        work.update(tick * DT_S, poses[tick], DT_S)
        collision.update(tick * DT_S, contacts[tick])
        coverage.update(poses[tick])
    assert together.distance_m.tolist() == work.distance_m.tolist()
    assert together.collisions.tolist() == collision.events.tolist()
    assert together.coverage.grid.tolist() == coverage.grid.tolist()
    assert together.distance_m.min() > 3.0
    assert together.collisions.sum() > 4


def test_compiled_and_plain_agree(request: pytest.FixtureRequest) -> None:
    poses, contacts = wander(5, 80)
    plain = calculate(5, poses, contacts)
    request.getfixturevalue("compiled")
    fast = calculate(5, poses, contacts)
    assert fast.distance_m == pytest.approx(plain.distance_m, rel=1e-12)
    assert fast.collisions.tolist() == plain.collisions.tolist()
    assert fast.coverage.grid.tolist() == plain.coverage.grid.tolist()
    assert fast.coverage.covered == plain.coverage.covered == plain.coverage.grid.sum()


def test_distance_is_taken_from_odometry_where_given() -> None:
    one = Calculators(["r1"], (0.0, 0.0, 5.0, 5.0), 0.1, [0.17], 0.5)
    rng = np.random.default_rng(0)
    for tick in range(101):
        noisy = np.array([[1.0 + tick * 0.01, 1.0, 0.0]]) + rng.normal(0.0, 0.03, (1, 3))
        one.update(tick * DT_S, noisy, np.zeros(1, np.int64), DT_S, odometry=np.array([[tick * 0.01, 0.0, 0.0]]))
    assert one.distance_m[0] == pytest.approx(1.0)
    assert one.coverage.covered > 20


def test_they_publish_what_they_counted() -> None:
    poses, contacts = wander(3, 40)
    counted = calculate(3, poses, contacts)
    runtime = Runtime(SimClock())
    bus, keys = LocalBus(runtime.mailbox), Keys("lab")
    got: list[CoverageMeasurement] = []
    bus.subscribe("lab/measurement/coverage/h1", CoverageMeasurement, got.append)
    counted.publish(bus, keys, "h1", 7.0)
    runtime.mailbox.drain()
    (coverage,) = got
    columns = counted.columns()
    assert columns["distance_m"].tolist() == counted.work.distance_m.tolist()
    assert columns["events"].tolist() == counted.collision.events.tolist()
    assert max(columns["events"]) > 0
    assert columns["energy_j"].tolist() == counted.energy.energy_j.tolist()
    assert columns.keys() <= COLUMNS.keys()
    bits = unpack_bits(coverage.cells, GridFrame.of(coverage))
    assert count_bits(bits) == counted.coverage.covered > 0
    assert coverage.stamp_s == 7.0
    assert coverage.robots == ("r0", "r1", "r2")


def wheel_signs(setpoints: np.ndarray, radius_m: float) -> int:
    """Count, by strings and not by the kernel's way, how often the two wheels reverse."""
    count = 0
    for side in (-1.0, 1.0):
        wheel = setpoints[:, 0] + side * 0.75 * radius_m * setpoints[:, 1]
        text = "".join("+" if each > 1e-3 else "-" if each < -1e-3 else "" for each in wheel)
        count += text.count("+-") + text.count("-+")
    return count


@given(
    st.lists(st.tuples(st.floats(-0.5, 0.5), st.floats(-4.0, 4.0)), min_size=1, max_size=40),
    st.floats(0.05, 0.5),
)
def test_reversals_and_variation_are_those_of_the_set_points(rows: list[tuple[float, float]], radius_m: float) -> None:
    setpoints = np.array(rows)
    smooth = SmoothnessCalculator(1)
    for row in setpoints:
        smooth.update(row[None], np.array([radius_m]))
        smooth.update(np.array([[math.nan, 0.0]]), np.array([radius_m]))  # not known in one period: nothing changes
    assert smooth.reversals[0] == 0.5 * wheel_signs(setpoints, radius_m)
    assert smooth.speed_variation_m_s[0] == pytest.approx(np.abs(np.diff(setpoints[:, 0])).sum())
    assert smooth.turn_variation_rad_s[0] == pytest.approx(np.abs(np.diff(setpoints[:, 1])).sum())


def test_a_robot_that_turns_to_and_fro_reverses_both_wheels_and_one_that_stops_none() -> None:
    smooth, radius_m = SmoothnessCalculator(2), np.full(2, 0.17)
    for tick in range(100):
        turn = 1.0 if tick % 2 else -1.0
        smooth.update(np.array([[0.0, turn], [0.3 if tick % 2 else 0.0, 0.0]]), radius_m)
    assert smooth.reversals.tolist() == [99.0, 0.0]
