"""Fixes that must not be believed: numbers that are none, outliers, what is out of order or too late."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.drivers.null.driver import LIMITS
from tests.unit import fix_lab
from tests.unit.fix_lab import START, TIMEOUT_S, Lab, seen

lab = fix_lab.lab


@pytest.mark.parametrize("field", ["x_m", "y_m", "heading_rad", "position_sigma_m", "heading_sigma_rad", "stamp_s"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_fix_that_is_not_finite_is_refused(lab: Lab, field: str, value: float) -> None:
    lab.say(**{field: value})
    lab.tick()
    assert lab.pose == pytest.approx(START)
    seen(lab)
    pose = lab.pose
    lab.say(**{field: value})
    lab.tick()
    assert lab.pose == pytest.approx(pose, abs=1e-6)


@pytest.mark.parametrize("fields", [{"position_sigma_m": -0.1}, {"heading_sigma_rad": -0.1}, {"x_m": 1e9}])
def test_a_fix_that_makes_no_sense_is_refused_and_told(lab: Lab, fields: dict[str, float]) -> None:
    for _ in range(20):
        lab.say(**fields)
        lab.run(0.05)
    assert lab.pose == pytest.approx(START)
    assert lab.now().pose_source == "odometry"
    assert lab.health.pose_note.startswith("its fixes are refused (")


@pytest.mark.parametrize(("others", "used"), [(1, False), (0, True)])
def test_a_fix_with_which_robots_could_not_stop_for_each_other_is_refused(others: int, used: bool) -> None:
    """A robot alone stops for no other."""
    exact, vague = (Lab(others=others, sensing_radius_m=1.0, speed_limit_m_s=0.5) for _ in range(2))
    for lab, sigma_m in ((exact, 0.01), (vague, 60.0)):
        for _ in range(20):
            lab.say(position_sigma_m=sigma_m)
            lab.run(0.05)
    assert exact.now().pose_source == "fixes"
    assert (vague.now().pose_source == "fixes") == used
    assert ("sigma, 60 m, is too large" in vague.health.pose_note) != used


def test_a_source_that_is_perfectly_sure_of_itself_is_followed_all_the_same(lab: Lab) -> None:
    lab.drive(1.0, 0.5)
    for _ in range(100):
        lab.say(position_sigma_m=0.0, heading_sigma_rad=0.0)
        lab.tick()
        assert lab.pose[:2] == pytest.approx(lab.truth()[:2], abs=0.01)
    assert lab.now().position_sigma_m > 0.0


def test_outliers_do_not_move_it_and_are_told(lab: Lab) -> None:
    seen(lab)
    for number in range(10):
        lab.say(x_m=9.0 + number, stamp_s=lab.runtime.now_s() + lab.ahead_s)
        lab.tick()
        assert lab.pose == pytest.approx(START, abs=1e-3)
    lab.seeing = False
    for number in range(10):
        lab.run(0.1)
        lab.say(x_m=9.0 + number)
    assert lab.pose == pytest.approx(START, abs=1e-3)
    assert (lab.health.pose_source, lab.health.pose_note) == (
        "odometry", "its fixes are refused (outlier); odometry alone",
    )  # fmt: skip


def test_a_robot_that_was_carried_says_so_and_does_not_leap(lab: Lab, capsys: pytest.CaptureFixture[str]) -> None:
    seen(lab).drive(1.0, 0.0)
    lab.run(1.0)
    x, y, heading = lab.origin
    lab.origin = (x + 3.0, y - 1.0, heading + 2.0)
    before = lab.agent.setpoints[0].copy()
    jumped = False
    for _ in range(60):
        pose = lab.pose
        lab.tick()
        jumped |= math.dist(pose[:2], lab.pose[:2]) > 1.0
        step = np.abs(lab.agent.setpoints[0] - before)
        assert step[0] <= LIMITS.accel_m_s2 * 0.02 + 1e-9
        assert step[1] <= LIMITS.turn_accel_rad_s2 * 0.02 + 1e-9
        before = lab.agent.setpoints[0].copy()
    assert jumped
    assert lab.pose[:2] == pytest.approx(lab.truth()[:2], abs=0.02)
    assert lab.now().pose_source == "fixes"
    assert "it was carried" in lab.health.pose_note
    assert "the robot was carried" in capsys.readouterr().out


def test_out_of_order_and_repeated_fixes_are_refused(lab: Lab) -> None:
    seen(lab)
    lab.seeing = False
    stamp_s = lab.runtime.now_s() + lab.ahead_s
    lab.say(stamp_s=stamp_s)
    lab.tick()
    pose = lab.pose
    for late_s in (0.0, 0.001, 0.1):
        lab.say(stamp_s=stamp_s - late_s, x_m=START[0] + 0.02)
        lab.tick()
        assert lab.pose == pytest.approx(pose, abs=1e-9)


def test_a_fix_that_waited_somewhere_counts_for_where_the_robot_was(lab: Lab) -> None:
    seen(lab).drive(1.0, 0.0)
    lab.run(1.0)
    lab.seeing = False
    for _ in range(20):
        x_m, y_m, _ = lab.truth()
        stamp_s = lab.runtime.now_s() + lab.ahead_s
        lab.run(0.2)  # the robot drives on by 8 cm meanwhile
        lab.say(stamp_s=stamp_s, x_m=x_m, y_m=y_m)
        lab.tick()
        assert lab.pose[:2] == pytest.approx(lab.truth()[:2], abs=0.01)
    assert lab.now().pose_source == "fixes"


def test_a_fix_that_is_too_late_is_refused(lab: Lab) -> None:
    seen(lab)
    lab.seeing = False
    for _ in range(10):
        stamp_s = lab.runtime.now_s() + lab.ahead_s
        lab.run(0.1)
        lab.say(stamp_s=stamp_s - 0.25, x_m=START[0] + 0.02)
        lab.tick()
    assert lab.pose == pytest.approx(START, abs=1e-3)
    assert lab.now().pose_note == "its fixes are refused (too late); odometry alone"


@settings(max_examples=20, deadline=None)
@given(st.lists(st.tuples(st.floats(), st.floats(), st.floats(), st.floats(), st.floats(), st.floats()), max_size=20))
def test_whatever_is_sent_the_pose_stays_a_pose(numbers: list[tuple[float, ...]]) -> None:
    lab = Lab(estimator="ekf")
    try:
        for x_m, y_m, heading_rad, sigma_m, sigma_rad, stamp_s in numbers:
            lab.say(
                x_m=x_m, y_m=y_m, heading_rad=heading_rad, position_sigma_m=sigma_m, heading_sigma_rad=sigma_rad,
                stamp_s=stamp_s,
            )  # fmt: skip
            lab.run(0.1)
            assert np.isfinite(lab.agent.pose).all()
            assert -math.pi <= lab.pose[2] <= math.pi
    finally:
        lab.agent.close()


def test_a_robot_does_not_drive_while_its_first_fixes_contradict_its_start_pose() -> None:
    lab = Lab()
    assert not lab.agent.reflexes.pose_uncertain[0]
    lab.say(x_m=5.0)
    lab.run(0.1)
    assert lab.agent.reflexes.pose_uncertain[0], "one of both is wrong"
    for _ in range(3):
        lab.say()
    lab.run(0.1)
    assert not lab.agent.reflexes.pose_uncertain[0]


def test_a_single_contradiction_does_not_bar_a_robot_for_ever() -> None:
    lab = Lab()
    lab.say(x_m=5.0)
    lab.run(TIMEOUT_S + 0.3)
    assert not lab.agent.reflexes.pose_uncertain[0]
