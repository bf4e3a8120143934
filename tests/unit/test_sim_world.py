"""The world around an engine: limits, ramps, watchdog, odometry, noise, starts; and the lockstep fleet."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from fullswarm.clock import SimClock
from fullswarm.config import AgentConfig, NoiseConfig, WorldConfig
from fullswarm.drivers.base import Fleet, Hazard, Lifecycle, Limits
from fullswarm.errors import ConfigError
from fullswarm.simulation.fleet import SimFleet
from fullswarm.simulation.starts import default_starts
from fullswarm.simulation.world import World

KINEMATIC = WorldConfig(engine="kinematic")


@pytest.fixture
def world() -> Iterator[World]:
    world = World(KINEMATIC, ("a", "b"), [(2.0, 2.0, math.pi / 2), (6.0, 6.0, 0.0)])
    yield world
    world.close()


def test_acceleration_and_speed_are_limited(world: World) -> None:
    world.set_limits(1, Limits(0.2, 1.0, 1.0, 5.0))
    speeds = []
    for _ in range(20):
        world.set_twists(np.array([[9.0, -9.0], [-9.0, 9.0]]))
        world.step()
        speeds.append(world.twist.copy())
    assert speeds[0] == pytest.approx(np.array([[0.04, -0.4], [-0.02, 0.1]]))
    assert speeds[-1] == pytest.approx(np.array([[0.5, -4.25], [-0.2, 1.0]]))


def test_a_silent_driver_ramps_to_zero_after_the_watchdog(world: World) -> None:
    for _ in range(20):
        world.set_twists(np.array([[0.5, 0.0], [0.5, 0.0]]))
        world.step()
    moving = []
    for _ in range(30):
        world.set_twists(np.array([0.5, 0.0]), 1)
        world.step()
        moving.append(world.twist[:, 0].copy())
    # The last command of row 0 is from 0.02 s before the loop: 0.28 s more, then 0.5 m/s at 2 m/s².
    assert [row[0] for row in moving[:15]] == pytest.approx([0.5] * 15)
    assert moving[15][0] == pytest.approx(0.46)
    assert moving[27][0] == pytest.approx(0.0)
    assert moving[29][1] == pytest.approx(0.5)


def test_a_twist_that_is_no_number_stops(world: World) -> None:
    world.set_twists(np.full((2, 2), 0.3))
    with pytest.raises(ValueError, match="finite"):
        world.set_twists(np.array([math.nan, 0.0]), 0)
    assert world.target.tolist() == [[0.0, 0.0], [0.3, 0.3]]


def test_odometry_is_in_the_start_frame(world: World) -> None:
    for _ in range(100):
        world.set_twists(np.array([[0.4, 0.5], [0.4, 0.0]]))
        world.step()
    assert world.time_s == pytest.approx(2.0)
    x, y, heading = world.odometry[0]
    # Row 0 started at (2, 2) facing +y: the start frame turned by 90 degrees.
    assert world.pose[0] == pytest.approx([2.0 - y, 2.0 + x, heading + math.pi / 2])
    assert world.odometry[1] == pytest.approx([*(world.pose[1, :2] - 6.0), 0.0])
    assert world.odometry[1, 0] > 0.7


@pytest.mark.parametrize("seed", [0, 7])
def test_noise_has_its_sigma_and_repeats(seed: int) -> None:
    config = KINEMATIC.model_copy(update={"noise": NoiseConfig(position_m=0.03, heading_rad=0.1), "seed": seed})
    runs = []
    for _ in range(2):
        world = World(config, ("a",), [(5.0, 5.0, 3.1)])
        sensed = []
        for _ in range(400):
            world.step()
            sensed.append(world.sensed_pose[0].copy())
        runs.append(np.array(sensed))
        assert world.pose[0].tolist() == [5.0, 5.0, 3.1]
        world.close()
    assert runs[0].tobytes() == runs[1].tobytes()
    assert np.std(runs[0][:, 0]) == pytest.approx(0.03, rel=0.2)
    assert np.std(np.remainder(runs[0][:, 2], 2 * math.pi)) == pytest.approx(0.1, rel=0.2)
    assert np.abs(runs[0][:, 2]).max() <= math.pi


def test_only_near_obstacles_are_sensed() -> None:
    config = KINEMATIC.model_copy(update={"boxes": ((5.0, 2.0, 1.0, 1.0, 0.0), (9.0, 9.0, 1.0, 1.0, 0.0))})
    world = World(config, ("a",), [(2.0, 4.0, 0.0)])
    assert world.obstacles.shape == (6, 6)
    # 2.92 m to the first box, 2 m to the west wall; the south wall is 4 m away.
    assert world.sensed_obstacles(0, 3.0)[:, :2].tolist() == [[5.0, 2.0], [-0.5, 10.0]]
    assert world.sensed_obstacles(0, 2.9)[:, :2].tolist() == [[-0.5, 10.0]]
    assert world.sensed_obstacles(0, 4.1)[:, 1].tolist() == [2.0, 10.0, -0.5]
    world.close()


@pytest.mark.parametrize("backwards", [False, True])
def test_the_bumper_is_in_front(backwards: bool) -> None:
    world = World(KINEMATIC, ("a", "b"), [(2.0, 2.0, math.pi if backwards else 0.0), (2.5, 2.0, 0.0)])
    for _ in range(40):
        world.set_twists(np.array([[-0.5 if backwards else 0.5, 0.0], [0.0, 0.0]]))
        world.step()
    assert world.contacts.tolist() == [1, 1]
    assert world.hazards.tolist() == [0 if backwards else Hazard.BUMP, 0]
    for _ in range(20):
        world.set_twists(np.array([[0.5 if backwards else -0.5, 0.0], [0.0, 0.0]]))
        world.step()
    assert world.hazards.tolist() == [0, 0]
    world.close()


def test_bad_starts_are_named_all_at_once() -> None:
    config = KINEMATIC.model_copy(update={"boxes": ((5.0, 5.0, 1.0, 1.0, 0.0),)})
    starts = [(1.0, 1.0, 0.0), (1.2, 1.0, 0.0), (5.6, 5.0, 0.0), (0.1, 9.0, 0.0), (-3.0, 1.0, 0.0)]
    with pytest.raises(ConfigError) as caught:
        World(config, ("a", "b", "c", "d", "e"), starts)
    for words in ("a and b overlap", "c at (5.60, 5.00) overlaps box 0", "d at (0.10, 9.00) overlaps a wall", "e at"):
        assert words in str(caught.value)
    with pytest.raises(ConfigError, match="repeat"):
        World(KINEMATIC, ("a", "a"))


@pytest.mark.parametrize("n", [1, 100, 700])
def test_default_starts_are_apart_and_repeat(n: int) -> None:
    config = KINEMATIC.model_copy(update={"boxes": ((2.0, 2.0, 1.0, 1.0, 0.5),)})
    starts = default_starts(config, n)
    assert starts.shape == (n, 3)
    assert starts.tobytes() == default_starts(config, n).tobytes()
    if n <= 100:
        assert starts[:, :2].max() < 10.0
    World(config, tuple(map(str, range(n))), starts).close()


@pytest.mark.parametrize("seed", range(5))
def test_default_starts_leave_the_filters_margin_to_walls_boxes_and_robots(seed: int) -> None:
    box = (2.0, 2.0, 1.0, 1.0, 0.0)
    config = KINEMATIC.model_copy(update={"boxes": (box,), "seed": seed})
    given = (0.6, 1.4, 0.0)
    x, y, _ = default_starts(config, 60, [given]).T
    radius_m = config.radius_m
    least_m = radius_m + AgentConfig().safety_margin_m
    assert min(x.min(), y.min(), 10.0 - x.max(), 10.0 - y.max()) >= least_m
    outside = np.hypot(np.maximum(np.abs(x - 2.0) - 0.5, 0.0), np.maximum(np.abs(y - 2.0) - 0.5, 0.0))
    assert outside.min() >= least_m
    assert np.hypot(x - given[0], y - given[1]).min() >= radius_m + least_m
    apart = np.hypot(x[:, None] - x, y[:, None] - y) + 10.0 * np.eye(len(x))
    assert apart.min() >= radius_m + least_m


def test_robots_without_a_pose_stand_beside_the_others() -> None:
    world = World(KINEMATIC, ("a", "b", "c"), [None, (0.4, 0.4, 1.0), None])
    assert world.pose[1].tolist() == [0.4, 0.4, 1.0]
    world.close()
    with pytest.raises(ConfigError, match="no room for 5000"):
        default_starts(KINEMATIC, 5000)


def test_fleet_reads_and_commands_as_arrays(world: World) -> None:
    clock = SimClock(100.0)
    fleet: Fleet = SimFleet(world, clock.now_s)
    twists, both = np.array([[0.3, 9.0], [0.2, 0.0]]), np.array([True, True])
    assert fleet.lifecycle(0) is Lifecycle.CLOSED
    assert fleet.read().stamp_s.tolist() == [-math.inf, -math.inf]
    assert fleet.command(twists, both).tolist() == [[0.0, 0.0], [0.0, 0.0]]
    fleet.open()
    assert fleet.lifecycle(0) is Lifecycle.READY
    assert fleet.command(twists, np.array([True, False])).tolist() == [[0.3, 4.25], [0.0, 0.0]]
    assert [fleet.lifecycle(row) for row in (0, 1)] == [Lifecycle.ACTIVE, Lifecycle.READY]
    for _ in range(3):
        world.step()
    reading = fleet.read()
    assert reading.stamp_s.tolist() == [100.0, 100.0]
    assert reading.twist[0] == pytest.approx([0.12, 1.2])
    assert reading.twist[1].tolist() == [0.0, 0.0]
    assert np.shares_memory(reading.pose, world.sensed_pose)
    # a sees the west and the south wall, b none
    assert reading.obstacles[:, :2].tolist() == [[-0.5, 10.0], [10.0, -0.5]]
    with pytest.raises(ValueError, match="b: a twist must be finite"):
        fleet.command(np.array([[0.1, 0.0], [math.inf, 0.0]]), both)
    assert world.target.tolist() == [[0.1, 0.0], [0.0, 0.0]]
    assert fleet.urls == ("sim://a", "sim://b")
    assert (fleet.descriptions[0].make, fleet.descriptions[0].model) == ("sim", "kinematic disc")
    assert fleet.firmware(0).startswith("kinematic ")
    fleet.close()
    assert fleet.lifecycle(0) is Lifecycle.CLOSED
    assert not world.target.any()


def test_a_fleet_of_one_row_sees_and_moves_that_body_alone(world: World) -> None:
    fleet: Fleet = SimFleet(world, SimClock(100.0).now_s, row=1)
    assert (fleet.ids, fleet.urls, len(fleet.descriptions)) == (("b",), ("sim://b",), 1)
    fleet.open()
    world.target[0] = 0.2, 0.0  # another agent's
    world.commanded_s[0] = world.time_s
    assert fleet.command(np.array([[0.3, 9.0]]), np.array([True])).tolist() == [[0.3, 4.25]]
    assert world.target.tolist() == [[0.2, 0.0], [0.3, 4.25]]
    world.step()
    reading = fleet.read()
    assert reading.pose.tolist() == world.sensed_pose[1:].tolist()
    assert reading.twist.tolist() == world.twist[1:].tolist() != [[0.0, 0.0]]
    assert len(reading.obstacles) == 0  # a, not b, is near walls
    with pytest.raises(ValueError, match="b: a twist must be finite"):
        fleet.command(np.array([[math.nan, 0.0]]), np.array([True]))
    fleet.command(np.array([[0.3, 0.0]]), np.array([True]))
    fleet.close()
    assert world.target.tolist() == [[0.2, 0.0], [0.0, 0.0]]
