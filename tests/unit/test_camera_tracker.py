"""Poses from rendered pictures with known truth: accuracy, identity, what is refused, a moved camera."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fullswarm.localization.camera.plan import RobotTag, TagPlan, plan_of
from fullswarm.localization.camera.rehearsal import tag_plate
from fullswarm.simulation.pictures import Disturbance, PictureMaker, lying
from tests.unit import camera_lab as lab

pytest.importorskip("cv2")


def things(time_s: float) -> list:  # type: ignore[type-arg]
    plan = plan_of(lab.fleet())
    return [
        lying(tag_plate(tag, each.size_m, 0.17), *lab.in_circles(time_s)[each.robot], each.height_m)
        for tag, each in plan.robots.items()
    ]


def test_poses_are_within_a_centimetre_and_two_degrees_and_nobody_is_swapped() -> None:
    tracker, away, turned = lab.tracker(), [], []
    for number in range(12):
        time_s = number / 20.0
        truth = lab.in_circles(time_s)
        twists = dict.fromkeys(truth, (0.165, 1.1))
        outcome = tracker.look(lab.pictures().picture(truth, twists), time_s)
        assert len(outcome.poses) == 8
        for pose in outcome.poses:
            away.append(lab.away_m(truth[pose.robot.robot], pose.x_m, pose.y_m))
            turned.append(lab.turned_rad(truth[pose.robot.robot], pose.heading_rad))
            assert away[-1] <= 4.0 * pose.sigma_m
    assert np.percentile(away, 95) <= 0.01
    assert max(away) < 0.02  # another robot is 0.6 m away
    assert np.percentile(turned, 95) <= math.radians(2.0)


def test_a_tag_that_is_covered_or_dazzled_gives_no_pose_and_the_others_do() -> None:
    tracker, maker = lab.tracker(), lab.pictures().maker
    truth = lab.in_circles(0.0)
    hidden, dazzled = (maker.pixels(np.array([[*truth[robot][:2], 0.1]]))[0] for robot in ("r2", "r7"))
    worse = Disturbance(
        noise=5.0, covers=((hidden[0] - 40, hidden[1] - 12, 80, 24),), glare=((dazzled[0], dazzled[1], 40.0),)
    )
    seen = {pose.robot.robot for pose in tracker.look(maker.picture(things(0.0), worse), 0.0).poses}
    assert seen == set(truth) - {"r2", "r7"}


def test_a_tag_at_two_places_is_refused_until_one_is_gone() -> None:
    tracker, maker = lab.tracker(), lab.pictures().maker
    twin = lying(tag_plate(3, 0.12, 0.17), 2.0, 1.1, 0.0, 0.1)
    refused = False
    for number in range(60):
        outcome = tracker.look(maker.picture([*things(0.0), twin], Disturbance(noise=3.0)), number / 20.0)
        refused |= outcome.refused.get(3) == "the tag is at two places"
        if refused:
            assert 3 not in {pose.found.tag for pose in outcome.poses}
    assert refused
    for number in range(60, 90):
        outcome = tracker.look(maker.picture(things(0.0), Disturbance(noise=3.0)), number / 20.0)
    assert 3 in {pose.found.tag for pose in outcome.poses}


@pytest.mark.parametrize(("size_m", "height_m"), [(0.10, 0.1), (0.15, 0.1), (0.12, 0.75)])
def test_a_tag_whose_size_does_not_fit_its_height_is_refused(size_m: float, height_m: float) -> None:
    tracker = lab.tracker()
    grey = lab.pictures().maker.picture([lying(tag_plate(5, size_m), 2.0, 1.1, 0.3, height_m)], Disturbance(noise=2.0))
    outcome = tracker.look(grey, 0.0)
    assert outcome.refused[5] == "its size does not fit its height"
    assert not outcome.poses


def test_a_robot_cannot_jump_but_one_that_is_carried_is_found_again() -> None:
    tracker, maker = lab.tracker(), lab.pictures().maker

    def at(x_m: float) -> object:
        return lying(tag_plate(1, 0.12, 0.17), x_m, 1.1, 0.0, 0.1)

    tracker.look(maker.picture([at(0.6)], Disturbance(noise=2.0)), 0.0)  # type: ignore[list-item]
    used = []
    for number in range(1, 30):
        outcome = tracker.look(maker.picture([at(3.2)], Disturbance(noise=2.0)), number / 20.0)  # type: ignore[list-item]
        used += [number] * len(outcome.poses)
    assert used[0] >= 6  # after a quarter of a second at the new place
    assert used[-1] == 29


def test_tags_are_not_found_in_noise() -> None:
    tracker = lab.tracker()
    for seed in range(3):
        tracker.finder.search_everything()
        assert not tracker.look(lab.noise_only(seed), seed / 20.0).poses


def test_the_offset_of_a_tag_on_its_robot_counts() -> None:
    plan = plan_of(lab.fleet())
    robots = {1: RobotTag(1, "r1", 0.12, 0.1, (0.05, -0.02, math.pi / 2.0))}
    tracker = lab.tracker(TagPlan(robots, plan.floor))
    cos, sin = math.cos(0.7), math.sin(0.7)
    at = 1.0 + 0.05 * cos + 0.02 * sin, 1.2 + 0.05 * sin - 0.02 * cos
    grey = lab.pictures().maker.picture([lying(tag_plate(1, 0.12), *at, 0.7 + math.pi / 2.0, 0.1)])
    (pose,) = tracker.look(grey, 0.0).poses
    assert (pose.x_m, pose.y_m, pose.heading_rad) == pytest.approx((1.0, 1.2, 0.7), abs=0.01)


@pytest.mark.parametrize(("shift_m", "tilt_deg"), [(0.03, 0.0), (0.0, 1.0), (0.1, -3.0)])
def test_a_moved_camera_is_noticed_within_a_second_and_found_again(shift_m: float, tilt_deg: float) -> None:
    tracker, maker = lab.tracker(), lab.pictures().maker
    mount = maker.mount
    turned = replace(mount, x_m=mount.x_m + shift_m, tilt_x_rad=mount.tilt_x_rad + math.radians(tilt_deg))
    moved = PictureMaker(maker.lens, turned, maker.floor, seed=1)
    noticed_s = again_s = math.inf
    for number in range(50):
        time_s, truth = number / 20.0, lab.in_circles(number / 20.0)
        used = maker if number < 10 else moved
        outcome = tracker.look(used.picture(things(time_s), Disturbance(noise=3.0)), time_s)
        for pose in outcome.poses:  # at no time is one wrong
            assert lab.away_m(truth[pose.robot.robot], pose.x_m, pose.y_m) < 0.02
        if number >= 10:
            noticed_s = min(noticed_s, time_s - 0.5) if tracker.mount.problem else noticed_s
            again_s = min(again_s, time_s - 0.5) if outcome.poses and noticed_s < math.inf else again_s
    assert noticed_s <= 1.0
    assert again_s <= 2.0
    assert "moved by" in tracker.mount.note


def test_one_floor_tag_that_was_moved_is_named_and_the_camera_stays() -> None:
    tracker, maker = lab.tracker(), lab.pictures().maker
    kicked = list(maker.floor)
    kicked[0] = replace(kicked[0], origin_m=(0.2, 0.15, 0.0))
    other = PictureMaker(maker.lens, maker.mount, tuple(kicked), seed=1)
    for number in range(20):
        outcome = tracker.look(other.picture(things(0.0), Disturbance(noise=3.0)), number / 20.0)
        assert len(outcome.poses) >= 7
    assert "floor tag 501 is not where it was" in tracker.mount.note
    assert not tracker.mount.moved
