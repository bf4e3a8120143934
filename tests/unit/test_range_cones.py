"""Ranges of sensors with a wide field of view: what they say of the arc that they measure, and of what is before it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm import Lab
from fullswarm.agent.mapping.sense import CORE, RangeSense, spread
from fullswarm.agent.pose.map_poses import MapPoses
from fullswarm.config import RangesConfig, SwarmConfig
from fullswarm.drivers.base import NO_OBSTACLES, Description, FleetReading, Limits, Pose, RangeScan
from fullswarm.kernels import Array
from fullswarm.maps.tiles import FREE, OCCUPIED
from fullswarm.messages import PoseFix
from fullswarm.simulation.ranges import SimulatedSensor
from tests.unit.test_agent_objects import RADIUS, receive, table

CONE, MAX_M, CELL_M = math.radians(27.0), 1.3, 0.05
TOF = Description("sim", "", RADIUS, Limits(0.5, 4.0, 2.0, 20.0), ranges_max_m=MAX_M)
HERE, EXACT, STANDS = np.zeros((1, 3)), np.zeros((1, 2)), np.zeros((1, 2))


def beam(distance_m: float, stamp_s: float, towards: float = 0.0) -> tuple[tuple[int, RangeScan], ...]:
    angle, distance = np.zeros(1), np.array([distance_m])
    return ((0, RangeScan(stamp_s, angle, distance, MAX_M, Pose(0.0, 0.0, towards), cone_rad=CONE)),)


def sensed(*robots: tuple[str, float, float]) -> RangeSense:
    return RangeSense([TOF], table(*robots), (-5.0, -5.0, 5.0, 5.0), CELL_M, np.array([RADIUS]))


def look(sense: RangeSense, distance_m: float, first_s: float, times: int = 6) -> None:
    for number in range(times):
        sense.update(first_s + 0.05 * number, HERE, EXACT, STANDS, beam(distance_m, first_s + 0.05 * number))


def state(sense: RangeSense, distance_m: float, angle: float) -> int:
    cell = sense.grid.place.cells(np.array([[distance_m * math.cos(angle), distance_m * math.sin(angle)]]))
    return int(sense.grid.states().reshape(-1)[cell[0]])


@given(st.floats(0.05, 1.5), st.floats(0.2, 4.0), st.floats(0.02, 0.2), st.integers(1, 4))
@settings(max_examples=60, deadline=None)
def test_a_cone_is_rays_without_gaps_at_its_distance(cone: float, max_m: float, cell_m: float, count: int) -> None:
    distances_m = np.array([0.5 * max_m, math.inf, math.nan, 0.0][:count])
    one = RangeScan(0.0, np.arange(count, dtype=np.float64), distances_m, max_m, cone_rad=cone)
    many, core = spread(one, cell_m)
    assert core is not None
    angles, distances = many.angles_rad.reshape(count, -1), many.distances_m.reshape(count, -1)
    np.testing.assert_array_equal(distances, np.repeat(distances_m[:, None], distances.shape[1], axis=1))
    assert np.diff(angles, axis=1).max() * max_m <= cell_m + 1e-9
    assert angles[:, 0] == pytest.approx(one.angles_rad - 0.5 * cone)
    assert angles[:, -1] == pytest.approx(one.angles_rad + 0.5 * cone)
    assert 0.0 < core.mean() <= CORE + 1.0 / core.reshape(count, -1).shape[1]


def test_the_whole_arc_is_an_obstacle_at_once_and_only_the_middle_of_the_cone_is_free() -> None:
    sense = sensed()
    look(sense, 1.0, 0.0, times=1)
    for angle in (-0.99 * CONE / 2.0, 0.0, 0.99 * CONE / 2.0):
        assert state(sense, 1.0, angle) == OCCUPIED
    spans = [(x - half_x, x + half_x, y - half_y, y + half_y) for x, y, half_x, half_y, _, _ in sense.obstacles]
    assert min(low for _, _, low, _ in spans) <= -math.sin(CONE / 2.0) <= -0.2
    assert max(high for _, _, _, high in spans) >= math.sin(CONE / 2.0)
    look(sense, 1.0, 1.0)
    assert state(sense, 0.7, 0.0) == FREE
    assert state(sense, 0.7, 0.9 * CONE / 2.0) != FREE, "what covers little of the field of view may be missed"


def test_an_arc_is_forgotten_where_the_middle_of_a_cone_sees_past_it() -> None:
    sense = sensed()
    look(sense, 0.8, 0.0)
    look(sense, math.inf, 1.0, times=12)
    assert state(sense, 0.8, 0.0) == FREE
    assert state(sense, 0.8, 0.95 * CONE / 2.0) == OCCUPIED
    look(sense, math.nan, 2.0, times=12)
    assert state(sense, 0.8, 0.95 * CONE / 2.0) == OCCUPIED, "nothing follows of what was not measured"
    for number in range(12):  # the robot turns: the axis points there now
        sense.update(3.0 + number, HERE, EXACT, STANDS, beam(math.inf, 3.0 + number, 0.95 * CONE / 2.0))
    assert state(sense, 0.8, 0.95 * CONE / 2.0) == FREE


def test_an_arc_is_no_moving_body_and_that_of_a_received_robot_no_obstacle() -> None:
    sense = sensed()
    look(sense, math.inf, 0.0, times=20)
    for number in range(20):
        sense.update(2.0 + 0.1 * number, HERE, EXACT, STANDS, beam(1.2 - 0.03 * number, 2.0 + 0.1 * number))
        assert len(sense.bodies) == 0
    sense = sensed(("other", 1.0, 0.2))
    look(sense, 1.0 - RADIUS + 0.02, 0.0, times=1)  # at the edge of the cone: the other end of the arc is none of it
    assert len(sense.obstacles) == 0
    receive(sense._neighbours, "other", 3.0, 0.0, 1.0)
    look(sense, 0.8, 1.0, times=1)
    assert len(sense.obstacles) > 0


@given(st.floats(-1.5, 1.5), st.floats(0.1, 1.2))
@settings(max_examples=40, deadline=None)
def test_a_simulated_cone_measures_the_nearest_thing_in_it(towards: float, across_m: float) -> None:
    """A long wall across: the nearest point of it in the cone lies on the ray that is nearest to its normal."""
    sensor = SimulatedSensor(
        RangesConfig(count=1, max_m=MAX_M, sigma_m=0.0, dropout=0.0, fov_rad=0.1, cone_rad=CONE), 0,
        np.random.default_rng(0),
    )  # fmt: skip
    wall = np.array([[across_m + 0.5, 0.0, 0.5, 50.0, 1.0, 0.0, 0.0, 60.0]])
    found = sensor.scan(np.array([0.0, 0.0, towards]), np.array([[0.0, 0.0, 0.1]]), 1, wall)
    nearest = across_m / math.cos(max(0.0, abs(towards) - CONE / 2.0))
    assert found.shape == (1,)
    assert float(found[0]) == pytest.approx(nearest, rel=1e-4) if nearest <= MAX_M else math.isinf(found[0])


def test_no_place_on_a_map_follows_from_a_cone() -> None:
    config = SwarmConfig.model_validate({"robot": [{"id": "r1", "pose": (0.0, 0.0, 0.0)}]})
    row = np.zeros(1)
    reading = FleetReading(
        row, HERE, HERE, STANDS, np.zeros(1, np.uint8), np.zeros(1, np.int64), row, NO_OBSTACLES, row
    )
    wall = np.array([[1.5, 0.0, 0.5, 5.0, 0.0, 0.0]])
    for cone_rad, located in ((0.0, True), (CONE, False)):
        fixes: list[PoseFix] = []
        poses = MapPoses(config, ("r1",), wall, np.array([RADIUS]), HERE, fixes.append)
        angles = np.linspace(-0.5, 0.5, 40)
        for number in range(5):
            scan = RangeScan(0.1 * number, angles, 1.0 / np.cos(angles), 4.0, cone_rad=cone_rad)
            reading.ranges = ((0, scan),)
            poses.update(reading, HERE)
        assert bool(fixes) is located


FIVE = {"count": 5, "fov_rad": math.pi, "cone_rad": CONE, "max_m": MAX_M, "rate_hz": 20.0, "dropout": 0.0}


def east(view: object, _params: object) -> Array:
    return np.tile([0.3, 0.0], (len(view.position), 1))  # type: ignore[attr-defined]


@pytest.mark.parametrize("heading", [0.0, 0.5])
def test_five_cones_keep_a_robot_off_a_wall_that_it_is_sent_into(heading: float) -> None:
    with Lab(
        starts=[[2.0, 4.0, heading]], bounds=(0.0, 0.0, 8.0, 8.0), obstacles=[(4.5, 4.0, 1.0, 6.0)],
        settings={"world.ranges": FIVE}, seed=1,
    ) as lab:  # fmt: skip
        lab.request(east, filtered=True)
        nearest_m = math.inf
        for _ in range(100):
            lab.run(0.1)
            nearest_m = min(nearest_m, 4.0 - float(lab.poses[0, 0]) - RADIUS)
        assert nearest_m > 0.02
        assert float(lab.poses[0, 0]) > 3.2, "it has driven to the wall"


def test_five_cones_let_a_robot_through_a_corridor_of_twice_its_width() -> None:
    walls = [(4.0, 4.0 + side * 0.85, 3.0, 1.0) for side in (-1, 1)]
    with Lab(
        starts=[[1.0, 4.05, 0.0]], bounds=(0.0, 0.0, 8.0, 8.0), obstacles=walls, settings={"world.ranges": FIVE}, seed=1
    ) as lab:
        lab.request(east, filtered=True)
        lab.run(25.0, until=lambda lab: bool(lab.poses[0, 0] > 6.0))
        assert lab.poses[0, 0] > 6.0
        assert abs(lab.poses[0, 1] - 4.0) < 0.3
