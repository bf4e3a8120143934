"""Narrow passages: who drives, who waits where, and neighbours that stand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.agent.behaviours import navigate
from fullswarm.agent.navigation.right_of_way import CLEAR_AHEAD_M, EXIT_M, RING_M, Traffic, give_way
from fullswarm.agent.neighbours.estimates import Neighbours
from fullswarm.agent.neighbours.objects import no_objects
from fullswarm.agent.neighbours.standing import FORGET_S, STANDING_S, Standing
from fullswarm.agent.view import Params, View
from fullswarm.config import SwarmConfig
from fullswarm.evaluate.scenarios import boxes_for, load_scenario, spawn
from fullswarm.kernels import Array
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import HealthReport, RobotStates
from fullswarm.operator.client import Operator
from fullswarm.reasons import Code

RADIUS_M, MARGIN_M, SPEED_M_S = 0.17, 0.03, 0.5
DOOR = np.array([[0.0, 0.0, 1.0, 0.0, 0.1, 0.5]])  # its axis is the x axis, its mouths are at x = ±0.1
EAST, WEST = 1, -1


def neighbour(x: float, y: float, going: int, speed_m_s: float = 0.0, heading: float = 0.0) -> list[float]:
    """Return x, y, heading, speed and aim of a robot that says that it drives through the door."""
    return [x, y, heading, speed_m_s, going * (0.1 + EXIT_M), 0.0] if going else [x, y, heading, speed_m_s, x, y]


def driven(x: float, y: float, going: int, *others: list[float], door: Array = DOOR, yaw: float = 0.0) -> Array:
    """Return the velocity of a robot on its way, which alone would be 0.5 m/s along the axis; all turned by `yaw`."""
    table = np.array(others).reshape(-1, 6)
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array([[c, s], [-s, c]])
    states = np.zeros((len(table), 6))
    states[:, :2], states[:, 2], states[:, 3] = table[:, :2] @ turn, table[:, 2] + yaw, table[:, 3]
    states[:, 5] = RADIUS_M
    traffic = Traffic(np.arange(len(table)), states[:, :2].copy(), states, table[:, 4:] @ turn)
    passage = door.copy()
    passage[:, 2:4] = door[:, 2:4] @ turn
    here, velocity = np.array([x, y]) @ turn, np.array([SPEED_M_S * going, 0.0]) @ turn
    answer = give_way(
        float(here[0]), float(here[1]), float(velocity[0]), float(velocity[1]), RADIUS_M, MARGIN_M, going, 0,
        len(table), passage, traffic,
    )  # fmt: skip
    found: Array = np.array(answer) @ turn.T
    return found


places = st.tuples(st.floats(-2.5, -0.4), st.floats(-1.5, 1.5))


@given(places, places, st.floats(-math.pi, math.pi))
def test_of_two_on_one_side_exactly_one_drives_on(
    one: tuple[float, float], other: tuple[float, float], yaw: float
) -> None:
    first = driven(*one, EAST, neighbour(*other, EAST), yaw=yaw)
    second = driven(*other, EAST, neighbour(*one, EAST), yaw=yaw)
    drive = [bool(each[0] == pytest.approx(SPEED_M_S) and abs(each[1]) < 1e-9) for each in (first, second)]
    near = [math.hypot(each[0] + 0.1, each[1]) for each in (one, other)]
    if abs(near[0] - near[1]) > 1e-6 and max(near) < RING_M:
        assert drive == [near[0] < near[1], near[1] < near[0]]
    else:
        assert any(drive)


@given(places, places, st.floats(-0.1, 0.1), st.floats(-0.1, 0.1))
def test_two_that_know_a_door_a_little_differently_agree_on_who_is_first(
    one: tuple[float, float], other: tuple[float, float], along_m: float, across_m: float
) -> None:
    mine, its = DOOR, DOOR + np.array([[along_m, across_m, 0.0, 0.0, 0.0, 0.0]])
    first = driven(*one, EAST, [*other, 0.0, 0.0, along_m + 0.1 + EXIT_M, across_m], door=mine)
    second = driven(*other, EAST, neighbour(*one, EAST), door=its)
    drive = [bool(each[0] == pytest.approx(SPEED_M_S) and abs(each[1]) < 1e-9) for each in (first, second)]
    near = [math.hypot(one[0] + 0.1, one[1]), math.hypot(other[0] + 0.1 - along_m, other[1] - across_m)]
    if max(near) < RING_M and abs(near[0] - near[1]) > 1e-6:
        assert drive == [near[0] < near[1], near[1] < near[0]]


def test_one_that_waits_leaves_the_first_one_its_way_along_the_wall() -> None:
    first, beside = (-0.3, -0.6), (-0.68, -0.56)  # the wall's face is at x = -0.1
    velocity = driven(*beside, EAST, neighbour(*first, EAST))
    assert velocity @ (np.array(first) - beside) < -0.01, "it drives off"
    assert driven(*first, EAST, neighbour(*beside, EAST)).tolist() == [SPEED_M_S, 0.0]


@given(places, places, st.floats(-math.pi, math.pi))
def test_of_two_sides_at_most_one_enters(one: tuple[float, float], other: tuple[float, float], yaw: float) -> None:
    here, there = one, (-other[0], other[1])
    first = driven(*here, EAST, neighbour(*there, WEST), yaw=yaw)
    second = driven(*there, WEST, neighbour(*here, EAST), yaw=yaw)
    close = all(math.hypot(each[0] + 0.1, each[1]) < CLEAR_AHEAD_M for each in (one, other))
    if close:
        assert (first[0] > 1e-9) + (second[0] < -1e-9) == 1


@given(st.floats(-1.2, -0.3), st.floats(-0.3, 0.3))
def test_a_robot_in_front_of_the_mouth_moves_beside_it_for_one_that_comes_out(x: float, y: float) -> None:
    velocity = driven(x, y, EAST, neighbour(0.0, 0.0, WEST, 0.4, math.pi))
    assert velocity[0] <= 0.0
    assert velocity[1] * (1.0 if y > 0.0 else -1.0) > 0.0


def test_a_robot_beside_the_mouth_waits_there_for_one_that_comes_out() -> None:
    assert driven(-0.5, 1.18, EAST, neighbour(0.0, 0.0, WEST, 0.4, math.pi)).tolist() == [0.0, 0.0]


def test_robots_inside_drive_on_whoever_waits() -> None:
    assert driven(0.0, 0.0, EAST, neighbour(0.6, 0.0, WEST)).tolist() == [SPEED_M_S, 0.0]


def test_of_two_that_meet_inside_the_one_that_has_come_less_far_goes_back() -> None:
    corridor = np.array([[0.0, 0.0, 1.0, 0.0, 2.0, 0.7]])
    ahead = [0.5, 0.0, math.pi, 0.3, -2.3, 0.0]
    assert driven(-0.5, 0.0, EAST, ahead, door=corridor)[0] == SPEED_M_S, "the same way: the sign decides"
    assert driven(-1.0, 0.0, EAST, ahead, door=corridor)[0] == -SPEED_M_S
    assert driven(0.0, 0.0, EAST, ahead, door=corridor)[0] == SPEED_M_S


def test_a_parked_robot_beside_a_door_bars_nobody() -> None:
    assert driven(-0.9, 0.0, EAST, neighbour(-0.3, 0.6, 0)).tolist() == [SPEED_M_S, 0.0]


def test_a_wide_passage_is_driven_on_the_right_only_when_robots_come_towards() -> None:
    wide = np.array([[0.0, 0.0, 1.0, 0.0, 1.5, 1.6]])
    assert driven(-1.8, 0.0, EAST, door=wide).tolist() == [SPEED_M_S, 0.0]
    towards = [1.0, 0.0, math.pi, 0.3, -1.8, 0.0]
    velocity = driven(-1.0, 0.0, EAST, towards, door=wide)
    assert velocity[1] < 0.0 < velocity[0]
    assert np.hypot(*velocity) == pytest.approx(SPEED_M_S)


# ---------------------------------------------------------------- neighbours that stand
def heard(x_m: float, stamp_s: float, aim_x_m: float | None) -> RobotStates:
    aims = ((aim_x_m,), (0.0,)) if aim_x_m is not None else ((), ())
    return RobotStates(
        host="r2", sequence=round(100 * stamp_s), stamp_s=stamp_s, robots=("r2",), x_m=(x_m,), y_m=(0.0,),
        heading_rad=(0.0,), speed_m_s=(0.0,), turn_rad_s=(0.0,), radius_m=(0.2,), aim_x_m=aims[0], aim_y_m=aims[1],
    )  # fmt: skip


def watched(until_s: float, x_of: dict[float, float], aim_x_m: float | None, silent_from_s: float = math.inf) -> int:
    """Return how many robots stand at `until_s`; one is heard five times a second."""
    neighbours = Neighbours(("r1",), 1.0)
    standing, found = Standing(neighbours, no_objects()), 0
    for k in range(round(until_s / 0.2) + 1):
        now_s = 0.2 * k
        x_m = next(x for since_s, x in reversed(x_of.items()) if since_s <= now_s + 1e-9)
        if now_s < silent_from_s:
            neighbours.receive(heard(x_m, now_s, aim_x_m), now_s)
        neighbours.set_time(now_s)
        found = len(standing.around(0))
    return found


def test_a_robot_that_stands_without_an_aim_is_an_obstacle_until_it_moves() -> None:
    assert watched(STANDING_S - 0.5, {0.0: 1.0}, None) == 0
    assert watched(STANDING_S + 1.0, {0.0: 1.0}, None) == 1
    assert watched(STANDING_S + 1.0, {0.0: 1.0}, 1.0) == 1, "it states its own place: it drives nowhere"
    assert watched(STANDING_S + 3.0, {0.0: 1.0, 5.0: 1.3}, None) == 0


def test_an_object_that_stands_is_an_obstacle_until_it_moves() -> None:
    objects = no_objects()
    objects.used[0] = 2
    neighbours = Neighbours(("r1",), 1.0)
    standing = Standing(neighbours, objects)
    found = []
    for k in range(40):
        now_s = 0.25 * k
        objects.rows[0, :5] = 1.0, 2.0, 0.0, 0.0, 0.17
        objects.rows[1, :5] = 0.2 * now_s, 0.0, 0.2, 0.0, 0.3
        if now_s > 7.0:
            objects.rows[0, 0] = 1.3
        neighbours.set_time(now_s)
        found.append(standing.around(0).copy())
    assert len(found[8]) == 0
    assert found[20][:, :2].tolist() == [[1.0, 2.0]]
    assert 0.17 <= found[20][0, 5] < 0.2
    assert len(found[32]) == 0


def test_one_that_waits_on_its_way_is_no_obstacle_until_it_is_silent() -> None:
    assert watched(STANDING_S + 2.0, {0.0: 1.0}, 4.0) == 0
    assert watched(STANDING_S + FORGET_S + 2.0, {0.0: 1.0}, 4.0, silent_from_s=1.0) == 1


def test_a_way_leads_around_a_robot_that_stands_in_a_door_and_waits_where_it_closes_it() -> None:
    def velocity(door_m: float, *discs: list[float]) -> Array:
        half = 0.5 * (4.0 - 0.5 * door_m)
        walls = np.array([[5.0, half, 0.1, half, 0.0, 0.0], [5.0, 8.0 - half, 0.1, half, 0.0, 0.0]])
        nobody = np.zeros(2, np.int64), np.zeros(0, np.int64)
        view = View(
            np.array([[4.0, 4.0]]), np.zeros(1), np.full(1, RADIUS_M), lambda: nobody, np.zeros((0, 2)),
            np.zeros((0, 6)), (0.0, 0.0, 10.0, 8.0), lambda _row, _source: walls, None, None, np.full(1, MARGIN_M),
            lambda _row: np.array(discs).reshape(-1, 6),
        )  # fmt: skip
        params = Params([{"goal": [8.0, 4.0], "gain": 1.0, "arrive_radius_m": 0.1, "map": "given"}])
        answer: Array = navigate.velocity(view, params)[0]
        return answer

    disc = [5.0, 3.9, 0.0, 0.0, 0.0, 0.17]
    assert velocity(1.6)[1] == pytest.approx(0.0, abs=1e-6)
    assert velocity(1.6, disc)[1] > 0.3
    assert velocity(0.7, disc)[0] > 0.0, "the door is closed: it goes there and waits"


# ---------------------------------------------------------------- the whole stack
def test_a_robot_without_a_way_reports_it_at_once_and_drives_on_when_there_is_one() -> None:
    wall = (5.0, 5.0, 0.2, 10.0, 0.0)
    config = SwarmConfig.model_validate(
        {
            "world": {"engine": "kinematic", "bounds_m": (0.0, 0.0, 10.0, 10.0), "boxes": (wall,)},
            "robot": [{"id": "r1", "pose": (2.0, 5.0, 0.0)}],
        }
    )
    swarm = Lockstep(config)
    operator = Operator(swarm.bus, swarm.keys, swarm.runtime, "test")
    reports: list[HealthReport] = []
    try:
        swarm.bus.subscribe(swarm.keys.health(), HealthReport, reports.append)
        swarm.run(0.51)
        operator.request("navigate_bc", (), {"goal": [8.0, 5.0], "map": "given"})
        swarm.run(0.2)
        robot = reports[-1].robots[0]
        assert (robot.stop_code, robot.stop_parameters["widest_m"]) == (Code.NO_WAY, "0.00")
        assert not robot.moving
        swarm.agent.obstacle_map.given = np.zeros((0, 6))
        swarm.run(1.0)
        assert reports[-1].robots[0].stop_code == Code.NONE
        assert swarm.world.pose[0, 0] > 2.1
    finally:
        operator.close()
        swarm.close()


# ---------------------------------------------------------------- scenarios
def test_the_seed_draws_where_a_door_lies_and_it_is_as_wide_as_the_file_says() -> None:
    scenario = load_scenario("door_42cm")
    walls = [boxes_for(scenario, seed) for seed in range(3)]
    assert len({tuple(each) for each in walls}) == 3
    for left, right in walls:
        apart_m = math.dist(left[:2], right[:2])
        assert apart_m - 0.5 * (left[3] + right[3]) == pytest.approx(0.42)


def test_mirrored_robots_start_on_both_sides() -> None:
    poses = spawn(load_scenario("opposing_80cm"), 8, 0, RADIUS_M)
    assert (poses[::2, 0] < 3.0).all()
    assert (poses[1::2, 0] > 9.0).all()
