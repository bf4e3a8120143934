"""What a simulated range sensor measures, compared with distances found by walking along each ray."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from fullswarm.config import RangesConfig, WorldConfig
from fullswarm.drivers.sim.settings import describe, parse_url, url_for
from fullswarm.kernels import Array
from fullswarm.simulation.fleet import SimFleet
from fullswarm.simulation.world import World

EXACT = {"count": 48, "max_m": 4.0, "sigma_m": 0.0, "dropout": 0.0}


def world(boxes: Sequence[tuple[float, ...]], starts: Array, ranges: dict[str, float]) -> World:
    config = WorldConfig.model_validate(
        {"engine": "kinematic", "bounds_m": (0.0, 0.0, 10.0, 8.0), "boxes": boxes, "ranges": ranges,
         "movers": [{"waypoints": [(2.0, 6.5)], "radius_m": 0.3}]}
    )  # fmt: skip
    return World(config, [f"r{row}" for row in range(len(starts))], starts)


def gap(x: float, y: float, made: World, own: int) -> float:
    """Distance to the nearest thing, written down anew."""
    found = [min(x, y, 10.0 - x, 8.0 - y), math.hypot(x - 2.0, y - 6.5) - 0.3]
    for box_x, box_y, wide, high, yaw in made.config.boxes:
        c, s = math.cos(yaw), math.sin(yaw)
        along, across = c * (x - box_x) + s * (y - box_y), c * (y - box_y) - s * (x - box_x)
        out_x, out_y = abs(along) - wide / 2, abs(across) - high / 2
        found.append(math.hypot(max(out_x, 0.0), max(out_y, 0.0)) + min(max(out_x, out_y), 0.0))
    found += [
        math.hypot(x - float(each[0]), y - float(each[1])) - 0.17
        for row, each in enumerate(made.pose) if row != own
    ]  # fmt: skip
    return min(found)


def walked(x: float, y: float, towards: float, made: World, own: int) -> float:
    gone = 0.0
    while gone <= 4.0:
        step = gap(x + gone * math.cos(towards), y + gone * math.sin(towards), made, own)
        if step < 1e-5:
            return gone
        gone += step
    return math.inf


@pytest.mark.parametrize("seed", range(3))
def test_rays_end_where_walking_along_them_ends(seed: int) -> None:
    rng = np.random.default_rng(seed)
    boxes = [(4.0, 3.0, 1.0, 0.5, float(rng.uniform(-3, 3))), (7.0, 5.0, 0.4, 2.0, float(rng.uniform(-3, 3)))]
    starts = np.array([[1.5, 1.5, rng.uniform(-3, 3)], [2.5, 3.5, 0.0], [5.5, 6.5, rng.uniform(-3, 3)]])
    made = world(boxes, starts, {**EXACT, "x_m": 0.1, "y_m": -0.05, "yaw_rad": 0.7})
    for row in range(3):
        found = made.scan(row)
        sensor = made.sensors[row]
        assert found is not None
        assert sensor is not None
        x, y, heading = made.pose[row].tolist()
        c, s = math.cos(heading), math.sin(heading)
        at_x, at_y = x + 0.1 * c + 0.05 * s, y + 0.1 * s - 0.05 * c
        true = [walked(at_x, at_y, heading + 0.7 + angle, made, row) for angle in sensor.angles_rad.tolist()]
        assert found.tolist() == pytest.approx(true, abs=1e-3)


def test_noise_and_dropouts_are_as_stated_and_repeat() -> None:
    starts = np.array([[5.0, 4.0, 0.0]])
    noisy = {"count": 2000, "max_m": 20.0, "sigma_m": 0.05, "dropout": 0.1}
    made, again = world([], starts, noisy), world([], starts, noisy)
    exact = world([], starts, {**noisy, "sigma_m": 0.0, "dropout": 0.0}).scan(0)
    found = made.scan(0)
    assert found is not None
    assert exact is not None
    missing = np.isnan(found)
    assert missing.mean() == pytest.approx(0.1, abs=0.03)
    assert (found - exact)[~missing].std() == pytest.approx(0.05, rel=0.1)
    repeated = again.scan(0)
    assert repeated is not None
    assert np.array_equal(found, repeated, equal_nan=True)


def test_with_ranges_robots_have_no_other_sense_of_what_is_around_them() -> None:
    made = world([(2.0, 1.5, 0.4, 0.4, 0.0)], np.array([[1.5, 1.5, 0.0], [2.5, 3.0, 0.0]]), EXACT)
    now = [0.0]
    fleet = SimFleet(made, lambda: now[0])
    fleet.open()
    first = fleet.read()
    assert len(first.obstacles) == 0
    assert first.bodies is None or len(first.bodies) == 0
    assert [row for row, _ in first.ranges] == [0, 1]
    ranges = first.ranges
    now[0] = 0.05
    assert fleet.read().ranges is ranges  # ten scans a second
    now[0] = 0.11
    assert fleet.read().ranges is not ranges
    described = describe(made.config)
    assert (described.senses_obstacles, described.bodies_range_m, described.ranges_max_m) == (False, 0.0, 4.0)
    assert "ranges" in described.capabilities


def test_the_url_of_a_simulated_robot_says_what_it_senses() -> None:
    config = WorldConfig.model_validate({"ranges": {"max_m": 5.0}, "sight": {"pose": False}})
    url = url_for(config, "r1")
    described = parse_url(url).description
    assert (described.ranges_max_m, described.senses_obstacles, described.senses_pose) == (5.0, False, False)
    assert RangesConfig().max_m == 6.0
