"""Poses from outside: what an autopilot without GPS is given, and what it must be set to for that."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from fullswarm.drivers.base import Lifecycle, Pose
from fullswarm.drivers.mavlink import protocol as p
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.drivers.mavlink.px4 import AUTOPILOTS
from tests.unit.mavlink_bench import Px4Bench

ORIGIN = p.Origin(52.5163, 13.3777, 34.0)


def locating(bench: Px4Bench, every_s: float = 0.1, jump_s: float = math.inf) -> Callable[[], None]:
    """Return what hands the session the body's true pose again and again, from `jump_s` on a metre aside."""
    due_s = [bench.now_s]

    def look() -> None:
        if bench.now_s >= due_s[0]:
            due_s[0] += every_s
            state = bench.body.state()
            x_m = state.x_m + (1.0 if bench.now_s >= jump_s else 0.0)
            assert bench.session.locate(Pose(x_m, state.y_m, state.heading_rad), 0.02, 0.01, bench.now_s)

    return look


def indoors(**options: Any) -> Px4Bench:
    bench = Px4Bench(external=True, **options)
    bench.rover.gps = False
    bench.rover.parameters["EKF2_EV_CTRL"] = (9, p.PARAM_INT32)
    return bench


def test_fixes_become_odometry_and_make_it_ready() -> None:
    bench = indoors(origin=ORIGIN)
    bench.run(3.0)
    assert bench.session.state is Lifecycle.OPEN
    assert "no pose fix has come in yet" in bench.session.why
    look = locating(bench)
    bench.until(lambda: bench.session.state is Lifecycle.READY, 4.0, look)
    assert bench.rover.origin == (525163000, 133777000, 34000)
    bench.session.activate(bench.now_s)
    bench.until(lambda: bench.session.state is Lifecycle.ACTIVE, 5.0, look)

    def drive() -> None:
        look()
        bench.drive(0.5, 0.2)

    bench.run(2.0, drive)
    state, fix = bench.body.state(), bench.rover.fixes[-1]
    assert (fix.frame_id, fix.child_frame_id, fix.reset_counter) == (20, 12, 0)
    assert (fix.x, fix.y) == (pytest.approx(state.y_m, abs=0.06), pytest.approx(state.x_m, abs=0.06))  # north, east
    yaw = 2.0 * math.atan2(fix.q[3], fix.q[0])
    assert math.cos(p.heading_from_yaw(yaw) - state.heading_rad) == pytest.approx(1.0, abs=1e-3)
    covariance = fix.pose_covariance
    assert all(0.02**2 <= covariance[index] <= 0.031**2 for index in (0, 6, 11))  # at most 10 ms old, at 1 m/s
    assert all(0.01**2 <= covariance[index] <= 0.031**2 for index in (15, 18, 20))
    assert math.isnan(fix.velocity_covariance[0])
    assert not math.isfinite(fix.vx)  # PX4 passes over what is no number


def test_slow_fixes_are_repeated_with_growing_doubt_and_stale_ones_are_not() -> None:
    bench = indoors()
    look = locating(bench, every_s=0.8)
    bench.run(4.0, look)
    since_s, count = bench.now_s, len(bench.rover.fixes)
    bench.run(2.4, look)
    assert len(bench.rover.fixes) - count >= 4 * (bench.now_s - since_s)
    assert len({fix.pose_covariance[0] for fix in bench.rover.fixes}) == 4
    bench.run(1.2)
    count = len(bench.rover.fixes)
    bench.run(2.0)
    assert len(bench.rover.fixes) == count
    assert "no pose fix has come in for" in bench.session.why


def test_a_jump_of_the_fixes_is_told_once() -> None:
    bench = indoors()
    look = locating(bench, jump_s=bench.now_s + 3.0)
    bench.run(5.0, look)
    assert [fix.reset_counter for fix in bench.rover.fixes if fix.reset_counter not in (0, 1)] == []
    assert bench.rover.fixes[-1].reset_counter == 1


def test_a_heading_that_was_not_seen_is_the_vehicle_s_own() -> None:
    bench = indoors()
    for _ in range(200):
        bench.session.locate(Pose(1.0, 2.0, math.nan), 0.05, math.pi, bench.now_s)
        bench.run(0.02)
    fix = bench.rover.fixes[-1]
    assert p.heading_from_yaw(2.0 * math.atan2(fix.q[3], fix.q[0])) == pytest.approx(0.7, abs=1e-3)
    assert fix.pose_covariance[20] > 9.0
    assert fix.reset_counter == 0


def test_an_origin_that_is_set_already_stays_and_is_told() -> None:
    bench = indoors(origin=ORIGIN)
    bench.rover.origin = (1, 2, 3)
    bench.run(3.0, locating(bench))
    assert bench.rover.origin == (1, 2, 3)
    assert any("origin was set" in text for text in bench.session.texts(bench.now_s))


def test_without_the_parameters_for_it_it_is_not_ready() -> None:
    bench = indoors()
    bench.rover.parameters["EKF2_EV_CTRL"] = (1, p.PARAM_INT32)
    bench.run(4.0, locating(bench))
    assert bench.session.state is Lifecycle.OPEN
    assert "EKF2_EV_CTRL" in bench.session.why


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [
        ("VISO_TYPE", None, "VISO_TYPE"), ("VISO_TYPE", 0.0, "reboot"), ("EK3_SRC1_POSXY", 3.0, "POSXY"),
        ("EK3_SRC1_VELXY", 6.0, "no velocity"), ("EK3_SRC1_YAW", 1.0, ""), ("EK3_SRC1_YAW", 6.0, ""),
    ],
)  # fmt: skip
def test_ardupilot_s_parameters_are_checked(name: str, value: float | None, word: str) -> None:
    fit = {"VISO_TYPE": 1.0, "EK3_SRC1_POSXY": 6.0, "EK3_SRC1_VELXY": 0.0, "EK3_SRC1_YAW": 6.0} | {name: value}
    found = [(check.needed, check.unfit(fit[check.name])) for check in AUTOPILOTS[3].pose_checks]
    assert [text for needed, text in found if needed and text] == ([text for _, text in found if text] if word else [])
    assert word in "".join(text for needed, text in found if needed)
    assert any(text and not needed for needed, text in found) is (name == "EK3_SRC1_YAW" and value == 1.0)


def test_without_being_asked_for_fixes_are_not_taken() -> None:
    bench = Px4Bench()
    assert not bench.session.locate(Pose(0.0, 0.0, 0.0), 0.1, 0.1, bench.now_s)
    bench = indoors()
    for pose, sigma_m, sigma_rad in (
        (Pose(math.nan, 0.0, 0.0), 0.1, 0.1), (Pose(0.0, 0.0, math.inf), 0.1, 0.1), (Pose(0.0, 0.0, 0.0), 0.0, 0.1),
        (Pose(0.0, 0.0, 0.0), 0.1, math.nan),
    ):  # fmt: skip
        bench.session.locate(pose, sigma_m, sigma_rad, bench.now_s)
    bench.run(1.0)
    assert not bench.rover.fixes
    MavlinkDriver("mavlink+tcp://127.0.0.1:5760").locate(Pose(0.0, 0.0, 0.0), 0.1, 0.1)  # closed: nothing happens
