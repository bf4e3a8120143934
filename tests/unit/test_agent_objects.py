"""What moves and is no robot of the fleet: seen, tracked, kept off, evaded; and silent robots that are searched."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.agent.motion.evade import Evasion
from fullswarm.agent.neighbours.estimates import Assumed, Nearby, Neighbours
from fullswarm.agent.neighbours.objects import Objects, ObjectTracker, no_objects
from fullswarm.agent.neighbours.silent import MOST_CELLS, SilentSearch, _Search
from fullswarm.agent.safety.filter import Measured, Requested, SafetyFilter, Tuning, robot_params
from fullswarm.bus.local import LocalBus
from fullswarm.drivers.base import NO_OBSTACLES, Description, Limits
from fullswarm.kernels import Array
from fullswarm.keys import Keys
from fullswarm.messages import ObjectFix, RobotStates, SearchedDiscs
from fullswarm.runtime import Mailbox

RADIUS, SPEED, TURN, ACCEL, HALT_S = 0.17, 0.5, 4.25, 2.0, 1.3
ASSUMED = Assumed(ACCEL, SPEED, TURN, HALT_S)
OBJECT_SPEED, OBJECT_ACCEL, OBJECT_RADIUS = 2.0, 2.0, 0.25
BOUNDS = np.array([-50.0, -50.0, 50.0, 50.0])
KEYS = Keys()
AT_REST_S = HALT_S + SPEED / ACCEL + 0.5


def table(*others: tuple[str, float, float]) -> Neighbours:
    made = Neighbours(("me",), 1.0, ASSUMED)
    for robot, x, y in others:
        receive(made, robot, x, y, 0.0)
    return made


def receive(made: Neighbours, robot: str, x: float, y: float, now_s: float) -> None:
    made.receive(
        RobotStates(
            host=robot, sequence=int(now_s * 20) + 1, stamp_s=now_s, robots=(robot,), x_m=(x,), y_m=(y,),
            heading_rad=(0.0,), speed_m_s=(0.0,), turn_rad_s=(0.0,), radius_m=(RADIUS,),
        ), now_s,
    )  # fmt: skip


def tracker(made: Neighbours | None = None) -> ObjectTracker:
    return ObjectTracker(made or table(), 3.0, OBJECT_SPEED, OBJECT_ACCEL)


HERE = np.array([[0.0, 0.0, 0.0]])


# ---------------------------------------------------------------- tracking
def test_a_moving_body_is_tracked_with_its_velocity() -> None:
    found = tracker()
    for tick in range(50):
        now_s = 0.02 * tick
        found.update(now_s, HERE, np.array([[2.0 - 0.8 * now_s, 1.0, 0.25]]), now_s)
    assert found.objects.used[0] == 1
    assert found.objects.rows[0] == pytest.approx([2.0 - 0.8 * 0.98, 1.0, -0.8, 0.0, 0.25, 0.1], abs=0.03)


def test_a_body_that_is_a_received_robot_is_no_object() -> None:
    made = table(("other", 1.0, 0.0))
    found = tracker(made)
    found.update(0.02, HERE, np.array([[1.02, 0.0, RADIUS], [1.0, 0.5, 0.25]]), 0.02)
    assert found.objects.rows[: found.objects.used[0], :2].tolist() == [[1.0, 0.5]]


def test_a_robot_that_was_seen_before_it_was_received_leaves_no_object_behind() -> None:
    made = table()
    found = tracker(made)
    found.update(0.0, HERE, np.array([[1.0, 0.0, RADIUS]]), 0.0)
    assert found.objects.used[0] == 1
    receive(made, "other", 1.0, 0.0, 0.02)
    found.update(0.02, HERE, np.array([[1.0, 0.0, RADIUS]]), 0.02)
    assert found.objects.used[0] == 0


@pytest.mark.parametrize(("hidden", "left"), [(False, 0), (True, 1)])
def test_one_that_is_not_seen_any_more_has_gone_unless_it_is_hidden(hidden: bool, left: int) -> None:
    found = tracker()
    for tick in range(20):
        found.update(0.02 * tick, HERE, np.array([[2.0, 0.0, 0.25]]), 0.02 * tick)
    screen = np.array([[1.0, 0.0, 0.4]])
    for tick in range(20, 60):
        found.update(0.02 * tick, HERE, screen if hidden else np.zeros((0, 3)), 0.02 * tick)
    rows = found.objects.rows[: found.objects.used[0]]
    assert int((rows[:, 0] > 1.9).sum()) == left


def test_an_object_that_is_told_of_counts_without_any_sense() -> None:
    found = tracker()
    for tick in range(20):
        now_s = 0.05 * tick
        found.tell(ObjectFix(object="person", x_m=1.0 + now_s, y_m=2.0, radius_m=0.3, stamp_s=now_s), now_s)
        found.update(now_s, HERE, None, now_s)
    assert found.objects.rows[0, :5] == pytest.approx([1.95, 2.0, 1.0, 0.0, 0.3], abs=0.05)
    found.update(5.0, HERE, None, 5.0)
    assert found.objects.used[0] == 0


# ---------------------------------------------------------------- keeping off
def filter_of(objects: Objects) -> SafetyFilter:
    limits = Limits(SPEED, TURN, ACCEL, 20.0)
    robots = robot_params(
        (Description("any", "any", RADIUS, limits),), np.array([SPEED]), np.array([TURN]), np.ones(1, bool)
    )
    return SafetyFilter(("me",), robots, Tuning(0.02, 3.0, 1.0, 3.0), BOUNDS, objects)


def alone() -> Nearby:
    return table().nearby(np.zeros(2, np.int64), np.zeros(1, np.int64))


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=40, deadline=None)
def test_no_contact_while_the_robot_moves_whatever_the_object_does(seed: int) -> None:
    """An object within its limits and a control law that aims at it or anywhere: they may touch at standstill only."""
    rng = np.random.default_rng(seed)
    objects, dt_s, near = no_objects(), 0.02, alone()
    objects.limits[:], objects.used[0] = (OBJECT_SPEED, OBJECT_ACCEL), 1
    guard, twists = filter_of(objects), np.zeros((1, 2))
    pose, motion = np.array([[0.0, 0.0, rng.uniform(-math.pi, math.pi)]]), np.zeros((1, 2))
    place, velocity = rng.uniform(-2.0, 2.0, 2), np.zeros(2)
    if np.hypot(*place) < 1.0:
        place += 1.5
    planar, stamp = np.full((1, 2), math.nan), np.zeros(1)
    requested = Requested(planar, np.ones(1, bool), np.array([2.0]), np.array([0.03]))
    for tick in range(400):
        if tick % 25 == 0:
            push = rng.uniform(-1.0, 1.0, 2) * OBJECT_ACCEL / math.sqrt(2.0)
            chase, aim = rng.random() < 0.6, rng.random() < 0.6
            wish = rng.uniform(-SPEED, SPEED, 2)
        towards = pose[0, :2] - place
        towards /= np.hypot(*towards)
        velocity = velocity + dt_s * (OBJECT_ACCEL * towards if chase else push)
        velocity *= min(1.0, OBJECT_SPEED / max(1e-9, float(np.hypot(*velocity))))
        objects.rows[0] = *place, *velocity, OBJECT_RADIUS, 0.0
        planar[0] = -SPEED * towards if aim else wish
        stamp[0] = tick * dt_s
        guard.apply(tick * dt_s, requested, Measured(pose, motion, stamp, np.zeros((1, 2))), near, NO_OBSTACLES, twists)
        motion[0, 0] += float(np.clip(twists[0, 0] - motion[0, 0], -ACCEL * dt_s, ACCEL * dt_s))
        motion[0, 1] += float(np.clip(twists[0, 1] - motion[0, 1], -20.0 * dt_s, 20.0 * dt_s))
        for _ in range(4):
            pose[0] += (
                0.25
                * dt_s
                * np.array([motion[0, 0] * math.cos(pose[0, 2]), motion[0, 0] * math.sin(pose[0, 2]), motion[0, 1]])
            )
            place = place + 0.25 * dt_s * velocity
            way = place - pose[0, :2]
            closing = motion[0, 0] * (way @ [math.cos(pose[0, 2]), math.sin(pose[0, 2])]) / np.hypot(*way)
            if np.hypot(*way) < RADIUS + OBJECT_RADIUS:
                assert closing < 1e-6, f"touched at {closing:.3f} m/s in tick {tick}"
                return


# ---------------------------------------------------------------- evading
def evaded(objects: Objects, wish: tuple[float, float], pose: Array = HERE, bounds: Array = BOUNDS) -> Array:
    desired = np.array([wish])
    evasion = Evasion(objects, np.array([0.2]), np.array([SPEED]), np.array([TURN]))
    evasion.apply(desired, np.ones(1, bool), pose, NO_OBSTACLES, bounds)
    found: Array = desired[0]
    return found


def one_object(x: float, y: float, vx: float, vy: float) -> Objects:
    objects = no_objects()
    objects.limits[:], objects.used[0] = (OBJECT_SPEED, OBJECT_ACCEL), 1
    objects.rows[0] = x, y, vx, vy, OBJECT_RADIUS, 0.1
    return objects


def test_a_robot_steps_out_of_the_way_and_else_does_as_desired() -> None:
    assert abs(evaded(one_object(3.0, 0.0, -1.0, 0.0), (0.5, 0.0))[1]) > 0.3
    assert np.hypot(*evaded(one_object(3.0, 0.0, -1.0, 0.0), (0.0, 0.0))) > 0.2, "one that stands, too"
    assert evaded(one_object(3.0, 0.0, 1.0, 0.0), (0.5, 0.0)).tolist() == [0.5, 0.0], "it goes away"
    assert evaded(one_object(3.0, 2.0, -1.0, 0.0), (0.5, 0.0)).tolist() == [0.5, 0.0], "it passes by"


def test_it_steps_to_the_side_where_there_is_room() -> None:
    wall_left = np.array([-50.0, -50.0, 50.0, 0.4])
    wall_right = np.array([-50.0, -0.4, 50.0, 50.0])
    assert evaded(one_object(3.0, 0.0, -1.0, 0.0), (0.5, 0.0), bounds=wall_left)[1] < -0.2
    assert evaded(one_object(3.0, 0.0, -1.0, 0.0), (0.5, 0.0), bounds=wall_right)[1] > 0.2


# ---------------------------------------------------------------- searching for silent robots
class Search:
    """A robot that looks for the silent robot `lost`, last received at the origin."""

    def __init__(self, host: str = "me") -> None:
        self.bus_mailbox = Mailbox()
        self.bus = LocalBus(self.bus_mailbox)
        self.table = table(("lost", 0.0, 0.0))
        self.search = SilentSearch(self.bus, KEYS, host, self.table, 3.0, np.array([RADIUS]))

    def look(self, eye: tuple[float, float], bodies: Array, now_s: float = 10.0, looks: int = 3) -> None:
        for _ in range(looks):
            self.table.set_time(now_s)
            self.table.around(np.array([eye]), 10.0)
            self.search.look(now_s, np.array([eye]), bodies, np.ones(len(bodies), bool), NO_OBSTACLES)
        self.table.set_time(now_s)
        self.table.around(np.array([eye]), 10.0)

    @property
    def disc(self) -> list[float]:
        return [*self.table.places[0].tolist(), float(self.table.spread_m[0])]


NOTHING_SEEN = np.zeros((0, 3))


def test_a_disc_that_is_in_sight_and_empty_vanishes() -> None:
    made = Search()
    made.look((-2.0, 0.0), NOTHING_SEEN, looks=2)
    assert made.disc[2] > 0.5, "a sense may miss a body once"
    made.look((-2.0, 0.0), NOTHING_SEEN, looks=1)
    assert math.isnan(made.disc[0])
    receive(made.table, "lost", 0.3, 0.0, 11.0)
    made.table.set_time(11.0)
    made.table.around(np.zeros((1, 2)), 10.0)
    assert made.disc[0] == pytest.approx(0.3)


def test_a_disc_shrinks_to_what_is_hidden() -> None:
    made = Search()
    made.look((-2.0, 0.0), NOTHING_SEEN, looks=0)
    before = made.disc
    made.look((-2.0, 0.0), np.array([[0.1, 0.0, RADIUS]]))
    x, y, radius = made.disc
    assert radius < 0.6 * before[2]
    assert x > 0.2, "behind the body"
    assert abs(y) < 0.1


def test_nothing_is_concluded_from_a_place_out_of_range_or_before_the_robot_is_at_rest() -> None:
    made = Search()
    made.look((-5.0, 0.0), NOTHING_SEEN)
    assert made.disc[2] > 0.5
    made.look((-2.0, 0.0), NOTHING_SEEN, now_s=1.2)
    assert made.disc[2] > 0.4


def visible(eye: Array, at: Array, discs: Array) -> bool:
    """Tell whether some point of a body's near side can be seen: by walking along many rays."""
    for angle in np.linspace(0.0, 2.0 * math.pi, 48, endpoint=False):
        rim = at + 0.98 * RADIUS * np.array([math.cos(angle), math.sin(angle)])
        points = eye + np.linspace(0.0, 1.0, 60)[:, None] * (rim - eye)
        if all((np.hypot(*(points - disc[:2]).T) > disc[2]).all() for disc in discs):
            return True
    return False


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=60, deadline=None)
def test_the_silent_robot_is_never_outside_of_what_is_kept_off(seed: int) -> None:
    rng, made = np.random.default_rng(seed), Search()
    true = rng.uniform(-1.0, 1.0, 2) * 0.45
    others = np.column_stack([rng.uniform(-1.5, 1.5, (4, 2)), rng.uniform(0.1, 0.4, 4)])
    others = others[np.hypot(*(others[:, :2] - true).T) > others[:, 2] + RADIUS]
    ever_seen = False
    for _ in range(6):
        eye = rng.uniform(-2.5, 2.5, 2)
        if (np.hypot(*(others[:, :2] - eye).T) < others[:, 2] + RADIUS).any() or np.hypot(*(eye - true)) < 2 * RADIUS:
            continue
        seen = visible(eye, true, others) and bool(np.hypot(*(true - eye)) <= 3.0 + RADIUS)
        ever_seen |= seen
        bodies = np.vstack([others, [[*true, RADIUS]]]) if seen else others
        made.look((float(eye[0]), float(eye[1])), bodies)
        x, y, radius = made.disc
        assert ever_seen or math.hypot(true[0] - x, true[1] - y) <= radius


def test_agents_tell_each_other_what_remains_and_where_bodies_are() -> None:
    made, told = Search(), list[SearchedDiscs]()
    made.bus.subscribe(KEYS.searched(), SearchedDiscs, told.append)
    made.look((-2.0, 0.0), np.array([[0.1, 0.0, RADIUS]]))
    made.look((-2.0, 0.0), np.array([[0.1, 0.0, RADIUS]]), now_s=11.0)
    made.bus_mailbox.drain()
    assert told[-1].robots == ("lost",)
    assert any(math.hypot(x - 0.1, y) < 1e-6 for _, x, y, _ in told[-1].discs), "the body may be the robot"
    other = Search("other")
    other.look((2.9, 0.0), NOTHING_SEEN, looks=1)
    before = other.disc
    other.bus.publish(KEYS.searched("me"), told[-1])
    other.bus_mailbox.drain()
    other.look((2.9, 0.0), NOTHING_SEEN, looks=0)
    assert other.disc[2] < before[2]
    assert math.hypot(other.disc[0] - 0.1, other.disc[1]) <= other.disc[2], "it still keeps off where the body is"


@pytest.mark.parametrize("radius_m", [5e-324, 1e-300, 1e-9])
def test_a_silent_robot_that_says_it_is_all_but_a_point_is_not_searched_for(radius_m: float) -> None:
    assert _Search.cell_count(radius_m, 100.0) > MOST_CELLS
