"""Ways around obstacles, what is known of them, and robots that step aside."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.agent.behaviours import navigate
from fullswarm.agent.navigation import planner
from fullswarm.agent.navigation.geometry import Bounds
from fullswarm.agent.navigation.roadmap import Clearance, Roadmap, build_roadmap
from fullswarm.agent.neighbours.obstacle_map import GIVEN, MOST, OWN, SHARED, ObstacleMap
from fullswarm.agent.safety.deadlock import ANGLE_RAD, BLOCKED_S, Deadlocks, chance
from fullswarm.agent.view import Params, View
from tests.unit.agent_bench import Bench

BOUNDS = (0.0, 0.0, 10.0, 10.0)
WALL = np.array([[5.0, 4.0, 0.5, 4.0, 0.0, 0.0]])  # x 4.5 to 5.5, y 0 to 8: the way leads around its north end
NOBODY = np.zeros(2, np.int64), np.zeros(0, np.int64)


def wish(x: float, y: float, known: np.ndarray, goal: tuple[float, float] = (8.0, 2.0)) -> np.ndarray:
    view = View(
        np.array([[x, y]]), np.zeros(1), np.full(1, 0.17), lambda: NOBODY, np.zeros((0, 2)), np.zeros((0, 6)), BOUNDS,
        lambda _row, _source: known,
    )  # fmt: skip
    params = Params([{"goal": list(goal), "gain": 1.0, "arrive_radius_m": 0.1, "map": "given"}])
    answer: np.ndarray = navigate.velocity(view, params)[0]
    return answer


def test_without_obstacles_the_way_is_straight() -> None:
    assert wish(2.0, 2.0, np.zeros((0, 6))) == pytest.approx([6.0, 0.0])


def test_a_wall_in_the_way_is_gone_around() -> None:
    x, y = 2.0, 2.0
    for _ in range(2000):
        velocity = wish(x, y, WALL)
        speed = float(np.hypot(*velocity))
        if speed == 0.0:
            break
        step = min(0.05, 0.05 * speed) / speed
        x, y = x + step * velocity[0], y + step * velocity[1]
        out_x, out_y = max(abs(x - 5.0) - 0.5, 0.0), max(abs(y - 4.0) - 4.0, 0.0)
        assert math.hypot(out_x, out_y) > 0.17, f"the robot would touch the wall at {x:.2f}, {y:.2f}"
    assert math.hypot(x - 8.0, y - 2.0) < 0.11


def test_where_no_way_leads_it_stands() -> None:
    closed = np.array([[5.0, 5.0, 0.5, 5.0, 0.0, 0.0]])
    assert wish(2.0, 2.0, closed) == pytest.approx([0.0, 0.0])


def test_a_robot_too_close_to_a_box_first_gets_away() -> None:
    velocity = wish(4.4, 4.0, WALL)
    assert velocity[0] < 0.0


# ---------------------------------------------------------------- what is known
BOXES = np.array([[2.0, 2.0, 0.5, 0.5, 0.0, 0.0], [8.0, 8.0, 0.5, 0.5, 0.0, 0.0]])


def test_the_ways_of_a_given_map_are_built_before_a_robot_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    """Building takes longer than a control period."""
    planner._roadmaps.clear()
    built: list[Clearance] = []

    def build(obstacles: np.ndarray, bounds_m: Bounds, clearance: Clearance) -> Roadmap:
        built.append(clearance)
        return build_roadmap(obstacles, bounds_m, clearance)

    monkeypatch.setattr(planner, "build_roadmap", build)
    bench = Bench([(2.0, 2.0, 0.0)], world={"boxes": [(5.0, 2.0, 0.5, 3.0, 0.0)]})
    assert len(built) == 1
    bench.enable("navigate", {"goal": [8.0, 2.0], "map": "given", "gain": 1.0, "arrive_radius_m": 0.1})
    bench.run(1.0)
    assert np.hypot(*bench.agent.setpoints[0]) > 0.0
    assert len(built) == 1
    bench.run(24.0)
    assert math.dist(bench.agent.pose[0, :2], (8.0, 2.0)) < 0.5


def test_each_knows_what_it_has_seen_and_all_what_anybody_has() -> None:
    obstacle_map = ObstacleMap(2, BOXES)
    assert obstacle_map.add_sensed(np.array([[1.0, 1.0], [9.0, 9.0]]), BOXES, 3.0) == 2
    assert obstacle_map.known(0, OWN).tolist() == BOXES[:1].tolist()
    assert obstacle_map.known(1, OWN).tolist() == BOXES[1:].tolist()
    assert len(obstacle_map.known(0, SHARED)) == len(obstacle_map.known(0, GIVEN)) == 2
    assert obstacle_map.add_sensed(np.array([[5.0, 5.0], [5.0, 5.0]]), BOXES[:0], 3.0) == 0
    assert len(obstacle_map.known(0, OWN)) == 1, "what is out of sight is not forgotten"


def test_what_others_tell_is_shared_and_not_own() -> None:
    obstacle_map = ObstacleMap(1, BOXES[:0])
    obstacle_map.add_told("r2", BOXES)
    obstacle_map.add_told("r3", BOXES + 1e-5)  # the same ones, rounded elsewhere
    assert len(obstacle_map.known(0, SHARED)) == 2
    assert len(obstacle_map.known(0, OWN)) == 0


MANY = np.column_stack([np.arange(3000.0)] + [np.zeros(3000)] * 5)


def test_an_obstacle_map_has_an_end() -> None:
    obstacle_map = ObstacleMap(1, BOXES[:0])
    for host in ("r2", "r3"):
        obstacle_map.add_told(host, MANY + len(host) * 0.25 * (host == "r3"), MOST)
    assert len(obstacle_map.known(0, SHARED)) == MOST


def test_obstacles_that_a_robot_made_up_end_with_its_next_report_and_take_no_room() -> None:
    obstacle_map = ObstacleMap(1, BOXES[:0])
    place = np.array([[1.0, 1.0]])
    obstacle_map.add_told("liar", np.vstack([BOXES + 0.5, MANY]), MOST)
    assert obstacle_map.add_sensed(place, BOXES[:1], 3.0) == 1, "there is room for what the robot senses itself"
    obstacle_map.add_told("r3", BOXES[1:])
    assert {tuple(each) for each in BOXES.tolist()} <= {tuple(each) for each in obstacle_map.known(0, SHARED).tolist()}
    assert obstacle_map.seen().tolist() == BOXES[:1].tolist(), "what others report is not passed on as seen"
    obstacle_map.add_told("liar", BOXES[:0])
    assert obstacle_map.known(0, SHARED).tolist() == BOXES.tolist()


# ---------------------------------------------------------------- stepping aside
FORWARD = np.array([[0.4, 0.0]])
LIMIT = np.array([0.5])


def turned(
    deadlocks: Deadlocks, now_s: float, pose: np.ndarray, wished: np.ndarray = FORWARD,
    twist: tuple[float, float] = (0.0, 0.0),
) -> float:  # fmt: skip
    """Return by how much the wish is turned to the right, rad."""
    answer = wished.copy()
    deadlocks.resolve(now_s, answer, np.ones(1, bool), pose, np.array([twist]), LIMIT)
    assert np.hypot(*answer[0]) == pytest.approx(np.hypot(*wished[0]))
    return -math.atan2(answer[0, 1], answer[0, 0])


def test_who_stands_although_it_wishes_to_go_steps_aside_and_then_goes_on() -> None:
    deadlocks, pose = Deadlocks(["r1"]), np.zeros((1, 3))
    times = np.arange(0.0, 12.0, 0.02)
    angles = [turned(deadlocks, now_s, pose) for now_s in times]
    first = next(k for k, angle in enumerate(angles) if angle != 0.0)
    assert times[first] == pytest.approx(BLOCKED_S, abs=0.05)
    aside = [angle for angle in angles if angle != 0.0]
    assert all(ANGLE_RAD[0] <= angle <= ANGLE_RAD[1] for angle in aside)
    assert 2 <= int(deadlocks.deadlock_count[0]) <= 6
    assert len(set(np.round(aside, 6))) == int(deadlocks.deadlock_count[0]), "a new angle each time"


def test_who_makes_way_or_turns_or_wishes_nothing_is_left_alone() -> None:
    deadlocks = Deadlocks(["r1"])
    for k in range(300):
        assert turned(deadlocks, 0.02 * k, np.array([[0.004 * k, 0.0, 0.0]]), twist=(0.2, 0.0)) == 0.0
    for k in range(300):
        assert turned(deadlocks, 6.0 + 0.02 * k, np.array([[1.2, 0.0, 0.01 * k]]), twist=(0.0, 0.5)) == 0.0
    for k in range(300):
        assert turned(deadlocks, 12.0 + 0.02 * k, np.zeros((1, 3)), np.array([[0.01, 0.0]])) == 0.0


@pytest.mark.parametrize("sigma_m", [0.03, 0.05])
@given(seed=st.integers(0, 1000))
@settings(max_examples=10, deadline=None)
def test_noise_of_the_pose_is_no_motion_and_hides_none(sigma_m: float, seed: int) -> None:
    noise = np.random.default_rng(seed)
    stands, drives = Deadlocks(["r1"]), Deadlocks(["r1"])
    for k in range(400):
        x, y = noise.normal(0.0, sigma_m, 2)
        turned(stands, 0.02 * k, np.array([[x, y, 0.0]]))
        assert turned(drives, 0.02 * k, np.array([[0.004 * k + x, y, 0.0]]), twist=(0.2, 0.0)) == 0.0
    assert int(stands.deadlock_count[0]) >= 2


def test_wheels_that_slip_are_no_motion() -> None:
    deadlocks = Deadlocks(["r1"])
    for k in range(500):
        turned(deadlocks, 0.02 * k, np.zeros((1, 3)), twist=(0.2, 0.0))
    assert int(deadlocks.deadlock_count[0]) >= 1


@given(st.integers(0, 2**32 - 1), st.integers(0, 10_000))
def test_chance_is_spread_and_repeats(seed: int, draw: int) -> None:
    assert 0.0 <= chance(seed, draw) < 1.0
    assert chance(seed, draw) == chance(seed, draw)


def test_robots_do_not_draw_alike() -> None:
    seeds = Deadlocks([f"r{k}" for k in range(20)]).progress.seed.tolist()
    draws = [[chance(seed, draw) for draw in range(50)] for seed in seeds]
    assert abs(float(np.mean(draws)) - 0.5) < 0.05
    assert np.abs(np.corrcoef(np.array(draws)) - np.eye(20)).max() < 0.6
