"""Settling: places and enclosures against geometry of another kind, then when robots settle and go on."""

from __future__ import annotations

import math

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.agent.motion.settling import (
    CHECK_S,
    CIRCLES_S,
    GIVE_UP_S,
    GOAL_TAKEN,
    NO_NEARER_PLACE,
    NOT_SETTLED,
    ROOM_S,
    SHUT_IN,
    WAIT_S,
    Settling,
    Wanted,
    is_enclosed,
    is_free,
    place_left,
)
from fullswarm.agent.neighbours.estimates import Nearby
from fullswarm.agent.safety.barrier import Arena
from fullswarm.kernels import Array

RADIUS_M, MARGIN_M = 0.17, 0.03
CLEARANCE_M = RADIUS_M + MARGIN_M
NO_BOXES = np.zeros((0, 6))
WIDE = np.array([-50.0, -50.0, 50.0, 50.0])
OPEN_GROUND = Arena(NO_BOXES, WIDE)
PERIOD_S = 0.1

metres = st.floats(-1.5, 1.5, allow_subnormal=False).map(lambda value: round(value, 6))  # GEOS divides by the smallest
points = st.lists(st.tuples(metres, metres), min_size=1, max_size=9)


def among(others: Array, speed: float = 0.0) -> Nearby:
    """Return `others` (m, 2) as the neighbours of one robot."""
    count = len(others)
    states = np.zeros((count, 6))
    states[:, :2], states[:, 3], states[:, 5] = others, speed, RADIUS_M
    none = np.zeros(count)
    start, other = np.array([0, count], np.int64), np.arange(count, dtype=np.int64)
    return Nearby(start, other, np.ascontiguousarray(others), states, none, none, none)


def taken(others: Array) -> shapely.Geometry:
    """Return where no robot can stand beside `others`."""
    return shapely.union_all([shapely.Point(each).buffer(CLEARANCE_M + RADIUS_M, quad_segs=64) for each in others])


@given(points, st.floats(0.05, 1.0))
@settings(max_examples=60, deadline=None)
def test_a_place_is_found_if_and_only_if_there_is_one(others: list[tuple[float, float]], within_m: float) -> None:
    near = among(np.array(others))
    found = place_left.plain(0, False, 5.0, 5.0, 0.0, 0.0, within_m, CLEARANCE_M, near, OPEN_GROUND)
    left = shapely.Point(0.0, 0.0).buffer(within_m, quad_segs=64) - taken(np.array(others))
    if left.area > 1e-3:
        assert found
    if found:
        assert shapely.distance(left, shapely.Point(0.0, 0.0)) <= within_m + 1e-2 if left.area else within_m > 0.0
    if not found:
        assert left.area < 1e-3


@given(points, st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)))
@settings(max_examples=60, deadline=None)
def test_a_place_is_enclosed_when_it_is_in_another_part_of_the_plane(
    others: list[tuple[float, float]], place: tuple[float, float]
) -> None:
    near = among(np.array(others))
    x, y = place
    if not is_free.plain(0, x, y, CLEARANCE_M, True, near, OPEN_GROUND):
        return
    enclosed = is_enclosed.plain(0, x, y, 5.0, 5.0, CLEARANCE_M, near)
    plane = shapely.box(-9.0, -9.0, 9.0, 9.0) - taken(np.array(others))
    parts = [part for part in shapely.get_parts(plane) if part.distance(shapely.Point(place)) < 1e-3]
    assert enclosed == all(part.distance(shapely.Point(5.0, 5.0)) > 0.0 for part in parts)


def test_a_ring_encloses_its_middle_and_a_ring_with_a_gap_does_not() -> None:
    angle = np.arange(8) * math.pi / 4.0
    ring = np.stack([0.8 * np.cos(angle), 0.8 * np.sin(angle)], axis=1)
    for others, closed in ((ring, True), (ring[1:], False)):
        assert closed == is_enclosed.plain(0, 0.0, 0.0, 3.0, 0.1, CLEARANCE_M, among(others))


class One:
    """One robot at `place` that is to go to the origin."""

    def __init__(
        self, place: tuple[float, float], reach_m: float = 0.1, goal: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        self.goal = np.array([goal])
        wanted = Wanted(
            self.goal, np.array([reach_m]), np.ones(1, bool), np.array([RADIUS_M]), np.array([MARGIN_M]),
            np.array([0.5]),
        )  # fmt: skip
        self.settling, self.place, self.now_s = Settling(wanted, WIDE, 3.0), np.array(place), 0.0

    def wait(
        self, others: Array, for_s: float, boxes: Array = NO_BOXES, sigma_m: float = 0.0, speed: float = 0.0
    ) -> Array:
        """Let time pass in which it comes no nearer; return its desired velocity at the end."""
        near, pose = among(others), np.array([[*self.place, 0.0]])
        for _ in range(round(for_s / PERIOD_S)):
            self.now_s += PERIOD_S
            desired: Array = self.goal - self.place
            sigma = np.array([[sigma_m, 0.0]])
            self.settling.hold(self.now_s, desired, pose, np.array([[speed, 0.0]]), sigma, near, boxes)
        return desired

    @property
    def rule(self) -> int:
        """By which it has settled."""
        return int(self.settling.rule[0])


TOUCHING_M = 2.0 * RADIUS_M + MARGIN_M + 0.01


def test_it_settles_beside_the_robot_at_its_goal_and_goes_on_when_that_leaves() -> None:
    one = One((TOUCHING_M, 0.0))
    assert not one.wait(np.array([[0.0, 0.0]]), 2.0 * CHECK_S).any()
    assert one.rule == NO_NEARER_PLACE
    one.wait(np.array([[0.0, 0.0]]), 60.0)
    assert one.rule == NO_NEARER_PLACE, "nothing has changed"
    one.wait(np.array([[-2.0, 0.0]]), ROOM_S - CHECK_S)
    assert one.rule == NO_NEARER_PLACE, "room for a moment is no room"
    assert one.wait(np.array([[-2.0, 0.0]]), ROOM_S + 2.0 * CHECK_S).any()
    assert one.rule == NOT_SETTLED


def test_one_that_circles_the_robot_at_its_goal_settles_too_but_not_one_that_has_just_come() -> None:
    one = One((TOUCHING_M, 0.0))
    assert one.wait(np.array([[0.0, 0.0]]), CIRCLES_S, speed=0.1).any()
    assert not one.wait(np.array([[0.0, 0.0]]), CHECK_S, speed=0.1).any()
    assert one.rule == NO_NEARER_PLACE


def test_a_robot_that_moves_takes_no_place() -> None:
    one = One((TOUCHING_M, 0.0))
    near = among(np.array([[0.0, 0.0]]), speed=0.2)
    pose = np.array([[*one.place, 0.0]])
    for k in range(50):
        one.settling.hold(PERIOD_S * k, one.goal - one.place, pose, np.zeros((1, 2)), np.zeros((1, 2)), near, NO_BOXES)
    assert one.rule == NOT_SETTLED


def test_it_does_not_settle_at_the_rim_of_a_disc_with_room_that_can_be_reached() -> None:
    one = One((1.0 + TOUCHING_M, 0.0), reach_m=1.0)
    one.wait(np.array([[1.0, 0.0]]), WAIT_S + GIVE_UP_S)
    assert one.rule == NOT_SETTLED


def test_it_settles_when_the_disc_is_closed_and_goes_on_when_it_opens() -> None:
    angle = np.arange(12) * math.pi / 6.0
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    one = One((1.0 + TOUCHING_M, 0.0), reach_m=0.9)
    one.wait(ring, WAIT_S - 2.0 * CHECK_S)
    assert one.rule == NOT_SETTLED
    one.wait(ring, 4.0 * CHECK_S)
    assert one.rule == GOAL_TAKEN
    one.wait(ring[1:], ROOM_S + 3.0 * CHECK_S)  # the one in front of it has left
    assert one.rule == NOT_SETTLED


def test_it_gives_up_between_walls_and_a_robot_but_not_where_there_is_room_at_its_side() -> None:
    walls = np.array([[0.0, 0.3, 9.0, 0.05, 0.0, 0.0], [0.0, -0.3, 9.0, 0.05, 0.0, 0.0]])
    others = np.array([[5.0 - TOUCHING_M, 0.0]])
    shut, free = One((5.0, 0.0)), One((5.0, 0.0))
    shut.wait(others, GIVE_UP_S + 2.0 * CHECK_S, walls)
    free.wait(others, GIVE_UP_S + 2.0 * CHECK_S)
    assert (shut.rule, free.rule) == (SHUT_IN, NOT_SETTLED)


def test_walls_alone_shut_no_robot_in() -> None:
    door = np.array([[5.0, 0.71, 0.1, 0.5, 0.0, 0.0], [5.0, -0.71, 0.1, 0.5, 0.0, 0.0]])  # 0.42 m: a way for one angle
    alone = One((5.19, 0.03))
    alone.wait(np.array([[6.0, 0.8]]), GIVE_UP_S + 2.0 * CHECK_S, door)
    assert alone.rule == NOT_SETTLED


def test_another_goal_ends_it_and_none_prevents_it() -> None:
    one = One((TOUCHING_M, 0.0))
    one.wait(np.array([[0.0, 0.0]]), 2.0)
    assert one.rule != NOT_SETTLED
    one.goal[:] = 3.0, 0.0
    assert one.wait(np.array([[0.0, 0.0]]), PERIOD_S).any()
    one.goal[:] = math.nan
    one.wait(np.array([[0.0, 0.0]]), 60.0)
    assert one.rule == NOT_SETTLED


def test_each_vain_attempt_must_wait_longer_for_room() -> None:
    one, at_goal, gone = One((TOUCHING_M, 0.0)), np.array([[0.0, 0.0]]), np.array([[-2.0, 0.0]])
    took_s = []
    for _ in range(3):
        one.wait(at_goal, 2.0)
        assert one.rule == NO_NEARER_PLACE
        began_s = one.now_s
        while one.rule != NOT_SETTLED:
            one.wait(gone, PERIOD_S)
        took_s.append(one.now_s - began_s)
    assert took_s == pytest.approx([ROOM_S, 2.0 * ROOM_S, 4.0 * ROOM_S], abs=2.0 * CHECK_S)


def test_at_its_goal_a_noisy_pose_moves_it_no_more() -> None:
    far = np.array([[9.0, 9.0]])
    one = One((0.02, 0.0))
    assert one.wait(far, 1.0).any(), "a sure robot goes on"
    assert not one.wait(far, 1.0, sigma_m=0.01).any()
    one.place[:] = 0.05, 0.0
    assert not one.wait(far, 1.0, sigma_m=0.01).any(), "nor at the next moment, somewhat away from it"
    one.place[:] = 0.08, 0.0
    assert one.wait(far, 1.0, sigma_m=0.01).any()
