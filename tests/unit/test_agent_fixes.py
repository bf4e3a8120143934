"""Fixes on the bus: an agent whose robot feels its wheels only, and somebody who sees it."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.agent.node import AgentNode, Identity
from fullswarm.bus import LocalBus
from fullswarm.clock import SimClock
from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import Pose, Reading, TakesFixes
from fullswarm.drivers.fleet import OneRobot
from fullswarm.drivers.null.driver import LIMITS, NullDriver
from fullswarm.keys import Keys
from fullswarm.messages import (
    ControlRequest,
    HealthReport,
    Heartbeat,
    PoseFix,
    RobotHealth,
    RobotStates,
    decode,
    encode,
)
from fullswarm.runtime import Mailbox, Runtime

KEYS = Keys("swarm")
START = (1.0, 2.0, 0.5)
RATE_HZ = 50
TIMEOUT_S = 0.5


class Located(NullDriver):
    """A robot that takes fixes, and may sense its pose."""

    def __init__(self, url: str, clock: SimClock) -> None:
        super().__init__(url, clock)
        self.located: list[tuple[Pose, float, float]] = []
        self.senses: Pose | None = None

    def locate(self, pose: Pose, position_sigma_m: float, heading_sigma_rad: float) -> None:
        self.located.append((pose, position_sigma_m, heading_sigma_rad))

    def read(self) -> Reading | None:
        told = super().read()
        if told is None or self.senses is None:
            return told
        return Reading(told.stamp_s, told.odometry, told.twist, pose=self.senses)


class Lab:
    """One null robot with its agent, and a camera that sees it where `truth` says, while `seeing`."""

    def __init__(self, driver: type[NullDriver] = NullDriver, **agent: Any) -> None:
        self.clock = SimClock()
        self.runtime = Runtime(self.clock, Mailbox())
        self.bus = LocalBus(self.runtime.mailbox)
        config = SwarmConfig.model_validate({"agent": agent, "robot": [{"id": "r1", "pose": START}]})
        self.driver = driver("null://r1", self.clock)
        self.agent = AgentNode(
            self.bus, self.runtime, config, OneRobot("r1", self.driver), Identity("r1", "r1-0"), np.array([START]),
            self.runtime.stats,
        )  # fmt: skip
        self.reports: list[HealthReport] = []
        self.states: list[RobotStates] = []
        self.bus.subscribe(KEYS.health(), HealthReport, self.reports.append)
        self.bus.subscribe(KEYS.state(), RobotStates, self.states.append)
        self.origin = START  # what the odometry is laid on in truth
        self.seeing = False
        self.source, self.ahead_s = "camera-1", 1000.0  # how far the camera's clock is ahead
        self.contacts = 0
        self.runtime.every(1.0 / RATE_HZ, self._see, first_s=0.011)
        self.runtime.every(0.1, self._beat, first_s=0.0)
        self.run(0.1)

    def _beat(self) -> None:
        self.bus.publish(KEYS.heartbeat("core"), Heartbeat(node="core", process="c", sequence=1))

    def _see(self) -> None:
        if self.seeing:
            self.say()

    def truth(self) -> tuple[float, float, float]:
        reading = self.driver.read()
        assert reading is not None
        x, y, turned = reading.odometry.x_m, reading.odometry.y_m, reading.odometry.heading_rad
        cos, sin = math.cos(self.origin[2]), math.sin(self.origin[2])
        return self.origin[0] + cos * x - sin * y, self.origin[1] + sin * x + cos * y, self.origin[2] + turned

    def say(self, **fields: Any) -> None:
        x_m, y_m, heading_rad = self.truth()
        fix = PoseFix(
            **{
                "robot": "r1", "x_m": x_m, "y_m": y_m, "heading_rad": heading_rad, "position_sigma_m": 0.01,
                "heading_sigma_rad": 0.02, "source": self.source, "stamp_s": self.runtime.now_s() + self.ahead_s,
                "contacts": self.contacts, **fields,
            }
        )  # fmt: skip
        self.bus.publish(KEYS.pose_fix("r1"), decode(encode(fix), PoseFix))

    def run(self, seconds: float) -> None:
        self.runtime.run(seconds)

    def tick(self) -> None:
        self.runtime.run(0.02)

    @property
    def health(self) -> RobotHealth:
        return self.reports[-1].robots[0]

    def now(self) -> RobotHealth:
        self.agent.publish_health()
        self.runtime.mailbox.drain()
        return self.health

    @property
    def pose(self) -> list[float]:
        return [float(value) for value in self.agent.pose[0]]

    def drive(self, linear: float, angular: float) -> None:
        self.bus.publish(
            KEYS.control_requests("r1", "drive"),
            ControlRequest(
                request_id="q", robot="r1", behaviour="drive", law="drive", enable=True, core="c", sequence=1,
                parameters={"linear": linear, "angular": angular, "speed_m_s": 0.4, "turn_rad_s": 1.0},
            ),
        )  # fmt: skip


@pytest.fixture(params=["direct", "ekf"])
def lab(request: pytest.FixtureRequest) -> Iterator[Lab]:
    lab = Lab(estimator=request.param)
    yield lab
    lab.agent.close()


def seen(lab: Lab) -> Lab:
    lab.seeing = True
    lab.run(0.3)
    assert lab.health.pose_source == "fixes"
    return lab


def test_without_fixes_the_pose_is_odometry_on_the_start_pose(lab: Lab) -> None:
    lab.drive(1.0, 0.3)
    lab.run(1.0)
    assert lab.pose == pytest.approx(lab.truth(), abs=0.01)
    health = lab.now()
    assert (health.pose_source, health.pose_note) == ("odometry", "")
    assert health.position_sigma_m > 0.1  # of the start pose, and growing


def test_the_first_fix_says_where_it_is_and_the_health_report_where_from(lab: Lab) -> None:
    lab.origin = (-3.0, 4.0, 2.0)
    lab.seeing = True
    lab.run(0.06)
    assert lab.health.pose_source == "fixes"  # told at once, not with the next report
    assert lab.pose == pytest.approx(lab.truth(), abs=1e-6)
    assert 0.0 < lab.now().position_sigma_m <= 0.011
    assert lab.states[-1].x_m[0] == pytest.approx(1.0) or lab.states[-1].x_m[0] == pytest.approx(-3.0)
    lab.run(0.1)
    assert lab.states[-1].x_m[0] == pytest.approx(-3.0)


def test_it_follows_while_it_drives(lab: Lab) -> None:
    seen(lab).drive(1.0, 0.5)
    for _ in range(100):
        lab.tick()
        assert lab.pose[:2] == pytest.approx(lab.truth()[:2], abs=0.01)


def test_a_lost_source_degrades_to_odometry_says_so_and_comes_back_by_itself(
    lab: Lab, capsys: pytest.CaptureFixture[str]
) -> None:
    seen(lab).drive(1.0, 0.2)
    lab.run(0.5)
    lab.seeing = False
    lost_s = lab.runtime.now_s()
    while lab.health.pose_source == "fixes":
        lab.tick()
    assert lab.runtime.now_s() - lost_s <= TIMEOUT_S + 0.15
    assert lab.health.pose_note == "its fixes have stopped; odometry alone"
    assert "its fixes have stopped; odometry alone" in capsys.readouterr().out
    sigmas = []
    for _ in range(4):
        lab.run(1.0)
        sigmas.append(lab.now().position_sigma_m)
        assert lab.pose[:2] == pytest.approx(lab.truth()[:2], abs=0.05)
    assert sigmas == sorted(sigmas)
    assert sigmas[-1] > 2.0 * sigmas[0]
    lab.seeing = True
    lab.run(0.1)
    assert (lab.health.pose_source, lab.health.pose_note) == ("fixes", "")
    assert "fixes are used" in capsys.readouterr().out


# ---------------------------------------------------------------- what must not be believed
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


# ---------------------------------------------------------------- sources that come and go
def test_one_source_at_a_time_and_the_next_when_it_has_gone_silent(lab: Lab) -> None:
    seen(lab)
    for _ in range(20):
        lab.say(source="camera-2", x_m=START[0] + 0.02, stamp_s=5.0 + lab.runtime.now_s())
        lab.tick()
    assert lab.pose == pytest.approx(START, abs=1e-3)
    assert lab.agent.fixes._watched[0].source == "camera-1"
    lab.source, lab.ahead_s = "camera-2", 5.0  # a clock of its own
    lab.run(TIMEOUT_S + 0.1)
    assert lab.agent.fixes._watched[0].source == "camera-2"
    assert lab.now().pose_source == "fixes"


def test_what_a_replaced_source_has_left_behind_is_refused(lab: Lab) -> None:
    seen(lab)
    old_s = lab.runtime.now_s() + lab.ahead_s
    lab.seeing = False
    lab.run(1.0)
    # Its queue comes first: late, so nobody follows it again.
    lab.say(stamp_s=old_s, x_m=START[0] + 0.02)
    lab.source, lab.ahead_s = "camera-2", -3.0
    lab.seeing = True
    lab.run(0.1)
    lab.say(source="camera-1", stamp_s=old_s + 0.1, x_m=START[0] + 0.02)
    lab.tick()
    assert lab.agent.fixes._watched[0].source == "camera-2"
    assert lab.pose == pytest.approx(START, abs=1e-3)


def test_a_source_that_begins_its_clock_anew_under_its_old_name_is_believed_again(lab: Lab) -> None:
    seen(lab).ahead_s = -lab.runtime.now_s()
    lab.run(0.2)
    assert lab.agent.fixes._watched[0].refused == "out of order"
    lab.run(TIMEOUT_S + 0.1)
    assert lab.agent.fixes._watched[0].refused == ""
    assert lab.now().pose_source == "fixes"


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


# ---------------------------------------------------------------- contacts, and drivers that want to know
def test_contacts_that_a_source_sees_are_collisions(lab: Lab) -> None:
    seen(lab).contacts = 2
    lab.run(0.2)
    assert lab.now().contacts == 2
    lab.contacts = 0
    lab.run(0.5)
    lab.contacts = 1
    lab.run(0.2)
    assert lab.now().contacts == 1
    assert lab.health.collisions == 2
    lab.seeing = False
    lab.run(1.0)  # a source that has gone silent sees nothing any more
    assert lab.now().contacts == 0
    assert lab.health.collisions == 2


def test_a_driver_that_takes_fixes_gets_those_that_are_accepted() -> None:
    lab = Lab(Located)
    try:
        driver = lab.driver
        assert isinstance(driver, Located)
        assert isinstance(driver, TakesFixes)
        assert not isinstance(NullDriver("null://r1"), TakesFixes)
        seen(lab)
        count = len(driver.located)
        assert count >= 10
        pose, sigma_m, sigma_rad = driver.located[-1]
        assert (pose.x_m, pose.y_m, pose.heading_rad) == pytest.approx(START)
        assert (sigma_m, sigma_rad) == (0.01, 0.02)
        lab.seeing = False
        lab.say(x_m=50.0)
        lab.tick()
        assert len(driver.located) == count
    finally:
        lab.agent.close()


def test_a_driver_that_senses_its_pose_makes_its_own_of_the_fixes() -> None:
    lab = Lab(Located, estimator="direct")
    try:
        driver = lab.driver
        assert isinstance(driver, Located)
        driver.senses = Pose(7.0, 7.0, 0.0)
        lab.tick()
        lab.seeing = True
        lab.run(0.3)
        assert driver.located
        assert lab.pose == [7.0, 7.0, 0.0]
        health = lab.now()
        assert (health.pose_source, health.position_sigma_m, health.pose_note) == ("driver", -1.0, "")
        lab.seeing = False
        lab.run(1.0)
        assert (lab.health.pose_source, lab.health.pose_note) == ("driver", "its fixes have stopped")
    finally:
        lab.agent.close()
