"""Who watches the bodies of a live trial: a world, or the robots' own messages."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest

from fullswarm.agent.safety.barrier import box_gap
from fullswarm.bus.local import LocalBus
from fullswarm.config import SwarmConfig, WorldConfig
from fullswarm.evaluate.witness import ReportedWitness, WorldWitness
from fullswarm.keys import Keys
from fullswarm.messages import HealthReport, PoseFix, RobotHealth, RobotStates
from fullswarm.runtime import Mailbox
from fullswarm.simulation.world import World

ROBOTS = ("a", "b", "c")


class Robots:
    """Say where they are and what they touch."""

    def __init__(self) -> None:
        self.mailbox, self.now_s = Mailbox(), 0.0
        self.bus = LocalBus(self.mailbox)
        self.witness = ReportedWitness(
            self.bus,
            SwarmConfig.model_validate({"robot": [{"id": robot} for robot in ROBOTS], "world": {"walls": False}}),
            lambda: self.now_s,
        )

    def stand(self, robot: str, x_m: float, y_m: float) -> None:
        states = RobotStates(
            host=robot, sequence=1, stamp_s=0.0, robots=(robot,), x_m=(x_m,), y_m=(y_m,), heading_rad=(0.0,),
            speed_m_s=(0.0,), turn_rad_s=(0.0,), radius_m=(0.2,),
        )  # fmt: skip
        self.bus.publish(Keys().state("0_0", robot), states)
        self.mailbox.drain()

    def fix(self, robot: str, x_m: float, y_m: float) -> None:
        fix = PoseFix(
            robot=robot, x_m=x_m, y_m=y_m, heading_rad=0.0, position_sigma_m=0.001, heading_sigma_rad=0.01,
            source="camera", stamp_s=self.now_s,
        )  # fmt: skip
        self.bus.publish(Keys().pose_fix(robot), fix)
        self.mailbox.drain()

    def report(self, robot: str, collisions: int, contacts: int = 0) -> None:
        health = RobotHealth(
            robot=robot, driver="", make="", model="", firmware="", lifecycle="ACTIVE", collisions=collisions,
            contacts=contacts,
        )  # fmt: skip
        report = HealthReport(host=robot, process="p", version="0", robots=(health,))
        self.bus.publish(Keys().health(robot), report)
        self.mailbox.drain()


@pytest.fixture
def robots() -> Iterator[Robots]:
    found = Robots()
    yield found
    found.witness.close()
    found.bus.close()


def test_poses_are_unknown_until_they_are_told(robots: Robots) -> None:
    robots.stand("b", 1.0, 2.0)
    assert np.isnan(robots.witness.pose[[0, 2]]).all()
    assert robots.witness.pose[1].tolist() == [1.0, 2.0, 0.0]
    assert robots.witness.radius_m.tolist() == [0.17, 0.2, 0.17]


def test_what_robots_counted_before_does_not_count(robots: Robots) -> None:
    robots.report("a", 7)
    assert robots.witness.tally().obstacle_events.tolist() == [0, 0, 0]
    robots.report("a", 9)
    assert robots.witness.tally().obstacle_events.tolist() == [2, 0, 0]


def test_a_contact_beside_another_robot_is_one_with_it_else_with_an_obstacle(robots: Robots) -> None:
    robots.stand("a", 0.0, 0.0)
    robots.stand("b", 0.45, 0.0)
    for robot in ROBOTS:
        robots.report(robot, 0)
    robots.report("a", 1)
    robots.stand("b", 0.6, 0.0)
    robots.report("b", 1)
    robots.report("c", 1)  # nobody knows where it is
    robot_events, obstacle_events, *_ = robots.witness.tally()
    assert robot_events.tolist() == [1, 0, 0]
    assert obstacle_events.tolist() == [0, 1, 1]


def test_contacts_before_the_request_do_not_count(robots: Robots) -> None:
    robots.report("a", 0)
    robots.report("a", 2)
    robots.witness.begin()
    assert not robots.witness.touched().any()
    robots.report("a", 3)
    assert robots.witness.tally().obstacle_events.tolist() == [1, 0, 0]
    assert robots.witness.tally().robots_touched == 1


def test_touched_is_asked_once(robots: Robots) -> None:
    robots.report("a", 0, contacts=1)
    robots.report("b", 0)
    robots.report("b", 1)  # short: it was over before the report
    assert robots.witness.touched().tolist() == [True, True, False]
    assert robots.witness.touched().tolist() == [False, False, False]


def test_a_world_is_seen_from_the_beginning_on_and_no_step_is_missed() -> None:
    config = WorldConfig(engine="kinematic", bounds_m=(0.0, 0.0, 4.0, 4.0), speed_limit_m_s=0.5)
    world = World(config, ["a", "b"], [(0.5, 1.0, 0.0), (0.5, 2.0, 0.0)])
    try:
        world.set_twists(np.array([[0.5, 0.0], [0.0, 0.0]]))
        world.step()
        witness = WorldWitness(world, np.full((2, 2), 2.0), 0.5, 0.1)
        witness.begin()
        world.watchers.append(witness.sample)
        began_m = world.pose[0, 0]
        for count in (1, 3, 0, 6):
            for _ in range(count):
                world.set_twists(np.array([[0.5, 0.0], [0.0, 0.0]]))
                world.step()
        assert witness.truth.distance_m[1] == 0.0
        way_m = world.pose[0, 0] - began_m
        assert way_m > 0.05
        # The first step has nothing to compare with: from the second on all is counted.
        assert way_m - 0.5 * world.dt_s <= witness.truth.distance_m[0] <= way_m
        assert not witness.touched().any()
        assert witness.tally().above_limits == 0
    finally:
        world.close()


def test_a_graze_between_two_looks_is_counted() -> None:
    config = WorldConfig(engine="kinematic", bounds_m=(0.0, 0.0, 9.0, 4.0), speed_limit_m_s=4.0, accel_limit_m_s2=500.0)
    world = World(config, ["a", "b", "c"], [(1.0, 1.0, 0.0), (5.0, 1.33, math.pi), (8.0, 3.0, 0.0)])
    try:
        witness = WorldWitness(world, np.full((3, 2), 2.0), 0.5, 0.1)
        witness.begin()
        world.watchers.append(witness.sample)
        for _ in range(80):
            world.set_twists(np.array([[2.0, 0.0], [2.0, 0.0], [0.0, 0.0]]))
            world.step()
        assert world.contacts.tolist() == [0, 0, 0]
        assert [each.tolist() for each in witness.tally()[:2]] == [[1, 1, 0], [0, 0, 0]]
        assert (witness.tally().pairs_touched, witness.tally().robots_touched) == (1, 2)
        assert witness.touched().tolist() == [True, True, False]
        evidence = witness.evidence()
        assert evidence.closest_m[0] <= evidence.touch_m < evidence.closest_m[1:].min()
        assert len(evidence.bend) > 0
    finally:
        world.close()


@pytest.mark.parametrize("emulated", [False, True])
def test_contacts_and_commands_above_the_limits_of_a_world(emulated: bool) -> None:
    config = WorldConfig(engine="kinematic", bounds_m=(0.0, 0.0, 4.0, 4.0), speed_limit_m_s=0.5)
    world = World(config, ["a", "b"], [(0.5, 1.0, 0.0), (0.9, 1.0, 0.0)])
    try:
        witness = WorldWitness(world, np.full((2, 2), 2.0), 0.5, 0.1, emulated)
        witness.begin()
        for _ in range(30):
            world.set_twists(np.array([[0.6, 0.0], [0.0, 0.0]]))
            world.step()
            witness.sample()
        robot_events, obstacle_events, *_ = witness.tally()
        assert robot_events.tolist() == [1, 1]
        assert obstacle_events.tolist() == [0, 0]
        assert witness.touched().all()
        assert (witness.tally().above_limits > 0) is not emulated
    finally:
        world.close()


def pass_by(robots: Robots, aside_m: float, fixes: bool = False) -> None:
    """Let two robots pass each other along x, at 1 m/s each, and report 20 times a second."""
    robots.witness.begin()
    for step in range(41):
        x_m = 1.0 - 0.05 * step
        for robot, x, y in (("a", x_m, 0.0), ("b", -x_m, aside_m), ("c", 5.0, 5.0)):
            if fixes:
                robots.fix(robot, x, y)
                y += 9.0  # a robot that is lost says otherwise
            robots.stand(robot, x, y)
        robots.now_s += 0.05
        robots.witness.sample()


def test_a_pass_of_real_robots_is_judged_by_the_referee_between_their_reports(robots: Robots) -> None:
    pass_by(robots, 0.41)
    assert robots.witness.source == "reported"
    assert not robots.witness.tally().robot_events.any()
    nearest = robots.witness.nearest()["separation.min_m"]
    assert nearest.who == ("a", "b")
    assert nearest.value == pytest.approx(0.41 - 0.4, abs=1e-3)
    assert nearest.at_s == pytest.approx(1.0, abs=0.1)
    assert 0.0 < robots.witness.values()["time_to_contact.min_s"] < 0.3


def test_an_overlap_of_reported_poses_counts_although_no_bumper_was_pressed(robots: Robots) -> None:
    pass_by(robots, 0.39)
    tally = robots.witness.tally()
    assert tally.robot_events.tolist() == [1, 1, 0]
    assert (tally.pairs_touched, tally.robots_touched) == (1, 2)
    assert robots.witness.evidence().has_contact


def test_fixes_count_more_than_what_robots_say(robots: Robots) -> None:
    pass_by(robots, 0.39, fixes=True)
    assert robots.witness.source == "fixes"
    assert robots.witness.tally().robot_events.tolist() == [1, 1, 0]
    assert robots.witness.evidence().source == "fixes"


def test_what_came_nearest_is_named_with_walls_and_boxes() -> None:
    config = WorldConfig.model_validate(
        {"engine": "kinematic", "bounds_m": (0.0, 0.0, 4.0, 4.0), "boxes": [(3.0, 3.0, 0.4, 0.4, 0.3)]}
    )
    world = World(config, ["a", "b"], [(0.5, 1.0, 0.0), (2.0, 3.0, 0.0)])
    try:
        witness = WorldWitness(world, np.full((2, 2), 2.0), 0.5, 0.1)
        witness.begin()
        for _ in range(60):
            world.set_twists(np.array([[-0.1, 0.0], [0.3, 0.0]]))
            world.step()
            witness.sample()
        nearest = witness.nearest()
        assert nearest["clearance.min_m"].who == ("a", "west wall")
        assert nearest["clearance.min_m"].value == pytest.approx(world.pose[0, 0] - 0.17)
        soonest = nearest["time_to_contact.min_s"]
        assert soonest.who == ("b", "box 0")
        gap_m = box_gap(world.pose[1, 0], world.pose[1, 1], world.obstacles, 0)[0] - 0.17
        assert soonest.value == pytest.approx(gap_m / 0.3, rel=0.05)  # it drives at it, not along a side
        assert witness.per_robot()["clearance.gap_m"]["b"] == pytest.approx(gap_m, abs=1e-6)
    finally:
        world.close()
