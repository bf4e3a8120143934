"""Coordination above the filter: half-planes that keep a pair apart, and the best velocity within them."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog

from fullswarm import kernels
from fullswarm.agent.motion.coordination import (
    CREEP_SHARE,
    MAX_LINES,
    PART_S,
    RESTS_M_S,
    SLIDES_SHARE,
    Coordinator,
    Crowd,
    Lines,
    Motion,
    coordinate,
    hold,
    least_violation,
    nearest,
    reciprocal,
)
from fullswarm.agent.neighbours.estimates import Nearby
from fullswarm.config import SwarmConfig
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.launch.lockstep import Lockstep
from fullswarm.messages import RequestStatus, Value
from fullswarm.operator.client import Operator

TOP, HORIZON_S = 0.5, 2.0
TURN_RAD_S = 4.25
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(autouse=True, scope="module")
def _compiled() -> None:
    kernels.compile_all()


def inside(rng: np.random.Generator, normal: Array, limit: float) -> Array:
    """Return a velocity of at most `TOP` that keeps to a half-plane."""
    for _ in range(200):
        angle, size = rng.uniform(-math.pi, math.pi), TOP * math.sqrt(rng.random())
        velocity = np.array([size * math.cos(angle), size * math.sin(angle)])
        if velocity @ normal <= limit:
            return velocity
    assume(False)
    raise AssertionError


@given(seed=seeds)
@settings(max_examples=200, deadline=None)
def test_two_that_keep_to_their_halves_stay_apart_for_the_horizon(seed: int) -> None:
    rng = np.random.default_rng(seed)
    both_m = rng.uniform(0.1, 0.6)
    angle, distance_m = rng.uniform(-math.pi, math.pi), both_m + rng.uniform(0.001, 2.0)
    offset = distance_m * np.array([math.cos(angle), math.sin(angle)])
    vx, vy, other_vx, other_vy = rng.uniform(-TOP, TOP, 4).tolist()
    dx, dy = offset.tolist()
    *first, limit = reciprocal(dx, dy, vx, vy, other_vx, other_vy, both_m, HORIZON_S, PART_S, 0.5)
    *second, other_limit = reciprocal(-dx, -dy, other_vx, other_vy, vx, vy, both_m, HORIZON_S, PART_S, 0.5)
    relative = inside(rng, np.array(second), other_limit) - inside(rng, np.array(first), limit)
    times = np.linspace(0.0, HORIZON_S, 400)
    apart = np.linalg.norm(offset + times[:, None] * relative, axis=1)
    assert apart.min() >= both_m - 1e-6


@given(seed=seeds)
@settings(max_examples=100, deadline=None)
def test_two_that_overlap_part_in_the_time_given(seed: int) -> None:
    rng = np.random.default_rng(seed)
    angle, distance_m = rng.uniform(-math.pi, math.pi), rng.uniform(0.05, 0.39)
    offset = distance_m * np.array([math.cos(angle), math.sin(angle)])
    velocity, other = rng.uniform(-TOP, TOP, (2, 2))
    (dx, dy), (vx, vy), (other_vx, other_vy) = offset.tolist(), velocity.tolist(), other.tolist()
    *normal, limit = reciprocal(dx, dy, vx, vy, other_vx, other_vy, 0.4, HORIZON_S, 1.0, 1.0)
    # The whole share: the other keeps its velocity, and one on the border just parts from it.
    border = velocity + (limit - velocity @ normal) * np.array(normal)
    assert np.linalg.norm(offset + (other - border) * 1.0) == pytest.approx(0.4, abs=1e-6)


def half_planes(rng: np.random.Generator, count: int, low: float, high: float) -> tuple[Array, Array]:
    angle = rng.uniform(-math.pi, math.pi, count)
    return np.stack([np.cos(angle), np.sin(angle)], axis=1), rng.uniform(low, high, count)


def disc(step: float = TOP / 60) -> Array:
    """Return velocities on a grid over the disc of all that are possible, and on its border."""
    axis = np.arange(-TOP, TOP + step, step)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    angle = np.linspace(-math.pi, math.pi, 400)
    border = TOP * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.concatenate([grid[np.hypot(*grid.T) <= TOP], border])


@given(seed=seeds, count=st.integers(1, MAX_LINES))
@settings(max_examples=150, deadline=None)
def test_the_velocity_found_is_allowed_and_none_is_nearer(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    normals, limits = half_planes(rng, count, -0.1, 0.5)
    aim = rng.uniform(-TOP, TOP, 2)
    normal_x, normal_y = normals.T.copy()
    x, y, fulfilled = nearest(count, normal_x, normal_y, limits, TOP, float(aim[0]), float(aim[1]), False)
    others = disc()
    allowed = others[(others @ normals.T <= limits + 1e-9).all(axis=1)]
    if fulfilled < count:
        assert len(allowed) == 0, "there is one"
        return
    found = np.array([x, y])
    assert (normals @ found <= limits + 1e-6).all()
    assert np.linalg.norm(found) <= TOP + 1e-6
    if len(allowed):
        assert np.linalg.norm(found - aim) <= np.linalg.norm(allowed - aim, axis=1).min() + 1e-6


@given(seed=seeds, count=st.integers(3, MAX_LINES))
@settings(max_examples=150, deadline=None)
def test_where_none_is_allowed_the_greatest_violation_is_the_least(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    normals, limits = half_planes(rng, count, -0.4, 0.1)
    lines = Lines(*np.zeros((len(Lines._fields), MAX_LINES)))
    lines.normal_x[:count], lines.normal_y[:count], lines.limit[:count] = *normals.T, limits
    x, y, fulfilled = nearest(count, lines.normal_x, lines.normal_y, lines.limit, TOP, 0.1, 0.0, False)
    assume(fulfilled < count)
    x, y = least_violation(fulfilled, count, TOP, x, y, lines)
    violation = float((normals @ [x, y] - limits).max())
    # The same as a linear programme: the disc as a polygon around it.
    angle = np.linspace(-math.pi, math.pi, 720)
    sides = np.stack([np.cos(angle), np.sin(angle), np.zeros(720)], axis=1)
    rows = np.concatenate([np.column_stack([normals, -np.ones(count)]), sides])
    best = linprog([0.0, 0.0, 1.0], rows, np.concatenate([limits, np.full(720, TOP)]), bounds=(None, None))
    assert math.hypot(x, y) <= TOP + 1e-6
    assert violation <= best.fun + 1e-4


class Meeting:
    """A robot at the origin, heading east, and others around it."""

    def __init__(self, others: Array, takes_part: bool = True) -> None:
        count = len(others)
        self.near = Nearby(
            np.array([0, count], np.int64), np.arange(count, dtype=np.int64), others[:, :2].copy(), others,
            np.zeros(count), np.zeros(count), np.zeros(count),
        )  # fmt: skip
        self.crowd = Crowd(
            np.array([takes_part]), np.array([0.17]), np.array([0.03]), np.array([TOP]), np.array([TURN_RAD_S]),
            np.zeros(1, bool), np.zeros((1, 2)),
        )  # fmt: skip
        self.coordinator = Coordinator(self.crowd, 3.0, 0.02)

    def desired(self, x: float, y: float, speed: float = TOP) -> Array:
        desired = np.array([[x, y]])
        self.coordinator.apply(desired, np.zeros((1, 3)), np.array([[speed, 0.0]]), self.near)
        return np.array(desired[0])


def test_one_that_comes_towards_is_passed_and_one_behind_is_ignored() -> None:
    ahead, behind = np.array([[1.2, 0.05, math.pi, TOP, 0.0, 0.17]]), np.array([[-1.2, 0.05, math.pi, TOP, 0.0, 0.17]])
    assert Meeting(ahead).desired(TOP, 0.0)[1] < -0.02, "it passes on the side that is free"
    assert Meeting(behind).desired(TOP, 0.0) == pytest.approx([TOP, 0.0])


def test_one_at_rest_makes_way_for_one_that_comes() -> None:
    pushed = Meeting(np.array([[0.6, 0.0, math.pi, TOP, 0.0, 0.17]])).desired(0.0, 0.0, speed=0.0)
    assert pushed[0] < -0.05


def test_one_that_overlaps_by_its_speed_alone_slows_down_and_does_not_reverse() -> None:
    """At 0.1 m/s its disc is 3 cm larger than at rest."""
    meeting = Meeting(np.array([[0.39, 0.0, 0.0, 0.0, 0.0, 0.17]]))
    assert 0.0 <= meeting.desired(0.3, 0.0, speed=0.1)[0] < 0.1


def test_one_at_rest_stands_while_hardly_pushed_and_goes_on_making_way_once_it_has_begun() -> None:
    """As one that comes ever nearer, and leaves again, pushes it."""
    meeting = Meeting(np.array([[0.0, 0.0, math.pi, TOP, 0.0, 0.17]]))
    sizes = []
    for away_m in (*np.linspace(1.6, 0.45, 40), *np.linspace(0.45, 1.6, 40)):
        meeting.near.places[0, 0] = away_m
        sizes.append(float(np.hypot(*meeting.desired(0.0, 0.0, speed=0.0))))
    moves = [size > 0.0 for size in sizes]
    assert sum(one != other for one, other in itertools.pairwise(moves)) == 2, "it begins once and ends once"
    assert min(size for size in sizes if size > 0.0) >= RESTS_M_S
    assert sizes[0] == sizes[-1] == 0.0


@pytest.mark.parametrize("times", [1.0, 100.0])
def test_one_that_is_held_turns_to_where_it_wants_to_go_until_it_may_go_on(times: float) -> None:
    """The goal may be so far away that the law desires far more than the robot can."""
    ring = [(0.38 * math.cos(angle), 0.38 * math.sin(angle)) for angle in np.arange(-2, 3) * math.radians(58.0)]
    meeting = Meeting(np.array([[x, y, 0.0, 0.0, 0.0, 0.17] for x, y in ring]))
    for _ in range(20):
        desired = meeting.desired(0.3 * times, 0.1 * times, speed=0.0)
    assert meeting.crowd.held[0]
    assert math.atan2(desired[1], desired[0]) == pytest.approx(math.atan2(0.1, 0.3))
    assert np.hypot(*desired) == pytest.approx(CREEP_SHARE * min(times * math.hypot(0.3, 0.1), TOP))
    meeting.near.places[:, 0] += 3.0
    for _ in range(20):
        desired = meeting.desired(0.3, 0.1, speed=0.0)
    assert desired == pytest.approx([0.3, 0.1])
    assert not meeting.crowd.held[0]


def left(x: float, y: float, calls: int, every: float, tightest: float = TOP) -> tuple[float, float]:
    """What a held robot that wants to go east at its limit does with what is left, (x, y) or its opposite in turns."""
    held, slide, answer = np.ones(1, bool), np.zeros((1, 2)), (0.0, 0.0)
    for call in range(calls):
        sign = 1.0 if call // every % 2 == 0 else -1.0
        answer = hold(0, sign * x, sign * y, TOP, 0.0, TOP, tightest, 0.02 * TURN_RAD_S / math.pi, held, slide)
    assert held[0]
    return answer


def test_one_that_is_held_follows_what_lasts_of_its_velocity_and_nothing_that_jumps() -> None:
    x, y = 0.5 * SLIDES_SHARE * TOP, 1.3 * SLIDES_SHARE * TOP
    assert left(x, y, 200, math.inf) == pytest.approx((x, y), rel=0.05)
    assert left(x, y, 200, math.inf, SLIDES_SHARE * TOP) == pytest.approx((CREEP_SHARE * TOP, 0.0)), "too fast to turn"
    assert left(x, y, 10, math.inf) == pytest.approx((CREEP_SHARE * TOP, 0.0)), "it cannot have turned there yet"
    for calls in range(100, 120):
        assert left(x, y, calls, 10.0) == pytest.approx((CREEP_SHARE * TOP, 0.0))


def test_those_that_do_not_take_part_and_twists_are_left_alone() -> None:
    ahead = np.array([[0.8, 0.0, math.pi, TOP, 0.0, 0.17]])
    assert Meeting(ahead, takes_part=False).desired(TOP, 0.0) == pytest.approx([TOP, 0.0])
    assert np.isnan(Meeting(ahead).desired(math.nan, math.nan)).all()


@given(seed=seeds, count=st.integers(1, 3 * MAX_LINES))
@settings(max_examples=60, deadline=None)
def test_plain_and_compiled_agree_in_any_crowd(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    others = rng.uniform(-1.5, 1.5, (count, 6))
    others[:, 3] = rng.uniform(-TOP, TOP, count)
    others[:, 5] = 0.17
    meeting, desired = Meeting(others), rng.uniform(-TOP, TOP, (1, 2))
    other, top = desired.copy(), max(TOP, float(np.hypot(*desired[0])))
    pose, twist = np.array([[0.0, 0.0, rng.uniform(-3.0, 3.0)]]), np.array([[rng.uniform(-TOP, TOP), 0.0]])
    meeting.coordinator.apply(desired, pose, twist, meeting.near)
    rules, lines = meeting.coordinator._rules, Lines(*np.zeros((len(Lines._fields), MAX_LINES)))
    coordinate.plain(rules, meeting.crowd, meeting.near, lines, Motion(other, pose, twist))
    assert desired == pytest.approx(other, abs=1e-9)
    assert np.hypot(*desired[0]) <= top + 1e-6


def meet(agent: dict[str, object], behaviour: str = "formation_bc") -> tuple[float, int]:
    """Let two robots change places; return the time that they take, inf for more than 20 s, and the contacts."""
    starts = [(2.0, 3.0, 0.0), (6.0, 3.0, math.pi)]
    config = SwarmConfig.model_validate(
        {
            "world": {"engine": "kinematic", "bounds_m": (0.0, 0.0, 8.0, 6.0)},
            "robot": [{"id": f"r{row}", "pose": pose} for row, pose in enumerate(starts)],
            "agent": agent,
        }
    )
    lockstep = Lockstep(config)
    answers: list[RequestStatus] = []
    targets: Value = [[6.0, 3.0], [2.0, 3.0]]
    lockstep.run(0.49)
    operator = Operator(lockstep.bus, Keys(), lockstep.runtime, "op")
    operator.request(behaviour, (), {"targets": targets}, answers.append)
    touched, began_s = 0, lockstep.runtime.now_s()
    try:
        while lockstep.runtime.now_s() < began_s + 20.0:
            lockstep.run(0.1)
            touched += int(lockstep.world.contacts.sum())
            if (np.hypot(*(lockstep.world.pose[:, :2] - np.array(targets)).T) < 0.2).all():
                return lockstep.runtime.now_s() - began_s, touched
        return math.inf, touched
    finally:
        lockstep.close()


def test_two_that_meet_head_on_pass_without_stopping_by_default_and_not_when_it_is_switched_off() -> None:
    with_s, touched = meet({})
    without_s, touched_too = meet({"coordination": False})
    assert (touched, touched_too) == (0, 0)
    assert with_s < 10.5, "4 m at 0.5 m/s, the last of it slower"
    assert without_s > with_s + 2.0


@pytest.mark.parametrize("seed", range(6))
def test_two_with_one_goal_come_to_rest_one_at_it_and_one_beside(seed: int) -> None:
    random = np.random.default_rng(seed)
    angles = random.uniform(-math.pi, math.pi, 3) * 0.2 + 2.0 * math.pi / 3.0 * np.arange(3)
    starts = 4.0 + np.stack([np.cos(angles), np.sin(angles)], axis=1) * random.uniform(1.0, 2.5, (3, 1))
    poses = np.column_stack([starts, random.uniform(-math.pi, math.pi, 3)])
    config = SwarmConfig.model_validate(
        {
            "world": {"engine": "kinematic", "bounds_m": (0.0, 0.0, 8.0, 8.0)},
            "robot": [{"id": f"r{row}", "pose": tuple(pose)} for row, pose in enumerate(poses.tolist())],
        }
    )
    lockstep = Lockstep(config)
    try:
        lockstep.run(0.49)
        operator = Operator(lockstep.bus, Keys(), lockstep.runtime, "op")
        operator.request("move_to_goal_bc", ("r0", "r1"), {"goal": [4.0, 4.0]}, lambda _: None)
        lockstep.run(25.0)
        assert np.abs(lockstep.world.twist).max() < 1e-6
        left_m = np.hypot(*(lockstep.world.pose[:2, :2] - 4.0).T)
        settled = lockstep.agent.settling.settled[:2]
        assert ((left_m < 0.1) | settled).all()
        assert left_m.min() < 0.25, "at the goal, or with the other in its way"
        assert left_m.max() < 0.6, "beside it"
    finally:
        lockstep.close()
