"""Who sees a robot and who wants to know: sources that come and go, contacts, drivers that take fixes."""

from __future__ import annotations

from typing import Any

import pytest

from fullswarm.agent.pose.sources import Source
from fullswarm.clock import SimClock
from fullswarm.drivers.base import Pose, Reading, TakesFixes
from fullswarm.drivers.null.driver import NullDriver
from fullswarm.messages import FixSourceReport
from tests.unit import fix_lab
from tests.unit.fix_lab import KEYS, START, TIMEOUT_S, Lab, seen

lab = fix_lab.lab


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


# ---------------------------------------------------------------- sources that come and go
def sources(lab: Lab) -> dict[str, Source]:
    return dict(lab.agent.fixes._robots[0].sources)


def test_two_sources_are_used_together_and_the_other_one_alone_when_one_has_gone_silent(lab: Lab) -> None:
    seen(lab)
    for _ in range(20):
        lab.say(source="camera-2", x_m=START[0] + 0.02, stamp_s=5.0 + lab.runtime.now_s())
        lab.tick()
    assert lab.pose[0] - START[0] == pytest.approx(0.01, abs=0.01)
    assert {name for name, each in sources(lab).items() if not each.refused} == {"camera-1", "camera-2"}
    assert sources(lab)["camera-2"].residual_m == pytest.approx(0.01, abs=0.0101)
    lab.source, lab.ahead_s = "camera-2", 5.0  # a clock of its own
    lab.run(TIMEOUT_S + 0.1)
    health = lab.now()
    assert health.pose_source == "fixes"
    assert {each.sensor: each.used for each in health.pose_sources} == {"camera-1": False, "camera-2": True}


def test_what_a_silent_source_has_left_behind_is_refused(lab: Lab) -> None:
    seen(lab)
    old_s = lab.runtime.now_s() + lab.ahead_s
    lab.seeing = False
    lab.run(1.0)
    lab.source, lab.ahead_s = "camera-2", -3.0
    lab.seeing = True
    lab.run(0.1)
    lab.say(source="camera-1", stamp_s=old_s + 0.1, x_m=START[0] + 0.02)
    lab.tick()
    assert sources(lab)["camera-1"].refused == "too late"
    assert lab.pose == pytest.approx(START, abs=1e-3)


def test_no_more_sources_are_kept_than_a_report_holds_and_the_one_in_use_is(lab: Lab) -> None:
    seen(lab)
    for number in range(40):
        lab.say(source=f"stranger-{number}", stamp_s=float(number))
        lab.tick()
    assert len(sources(lab)) == 8
    assert "camera-1" in sources(lab)
    assert len(lab.now().pose_sources) == 8


def contradict(lab: Lab, seconds: float, source: str = "camera-2", off_m: float = 0.4, **more: Any) -> None:
    for _ in range(round(seconds / 0.02)):
        lab.say(source=source, x_m=START[0] + off_m, stamp_s=5.0 + lab.runtime.now_s(), **more)
        lab.tick()


def test_a_robot_stands_while_two_sources_contradict_each_other(lab: Lab) -> None:
    seen(lab)
    lab.drive(0.0, 0.2)
    contradict(lab, 0.3)
    assert not lab.agent.reflexes.pose_uncertain[0], "an outlier or two are no contradiction"
    contradict(lab, 0.5)
    assert lab.agent.reflexes.pose_uncertain[0]
    health = lab.now()
    assert health.stop_code == "unsure"
    assert "camera-1 and camera-2 contradict each other by 0.40 m" in health.pose_note
    assert lab.pose[0] == pytest.approx(START[0], abs=0.01)
    lab.run(TIMEOUT_S + 0.2)  # the second one has gone silent
    assert not lab.agent.reflexes.pose_uncertain[0]
    assert lab.now().pose_note == ""


def test_the_preferred_source_counts_where_two_contradict_each_other() -> None:
    lab = Lab(fix_order=["mocap"])
    try:
        seen(lab)
        contradict(lab, 1.0, sensor="mocap hall")
        health = lab.now()
        assert lab.pose[0] == pytest.approx(START[0] + 0.4, abs=0.02)
        assert not lab.agent.reflexes.pose_uncertain[0]
        assert {each.sensor: each.used for each in health.pose_sources} == {"camera-1": False, "mocap hall": True}
        contradict(lab, 0.2, sensor="mocap hall")
        lab.run(TIMEOUT_S + 0.6)  # without it the other one counts again
        assert lab.pose[0] == pytest.approx(START[0], abs=0.02)
    finally:
        lab.agent.close()


def report(lab: Lab, unseen_s: float, problem: str = "") -> None:
    lab.bus.publish(
        KEYS.fix_source("c"),
        FixSourceReport(
            source="c", sensor="camera ceiling", problem=problem, robots=("r1",), markers=("tag 3",),
            unseen_s=(unseen_s,),
        ),
    )  # fmt: skip
    lab.tick()


def test_the_note_says_which_marker_is_not_seen_and_since_when(lab: Lab) -> None:
    report(lab, -1.0)
    assert lab.now().pose_note == "camera ceiling has not seen tag 3 yet"
    seen(lab)
    lab.seeing = False
    lab.run(1.0)
    report(lab, 12.0)
    assert lab.now().pose_note == "its fixes have stopped; odometry alone: camera ceiling has not seen tag 3 for 12 s"
    report(lab, 12.0, "it has moved")
    assert lab.now().pose_note.endswith("camera ceiling: it has moved")
    lab.run(5.0)
    assert "camera ceiling has ended or is not reached since 5 s" in lab.now().pose_note


def test_a_source_that_begins_its_clock_anew_under_its_old_name_is_believed_again(lab: Lab) -> None:
    seen(lab).ahead_s = -lab.runtime.now_s()
    lab.run(0.2)
    assert sources(lab)["camera-1"].refused == "out of order"
    lab.run(TIMEOUT_S + 0.1)
    assert sources(lab)["camera-1"].refused == ""
    assert lab.now().pose_source == "fixes"


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


def test_a_fix_before_the_driver_senses_its_pose_does_not_hold_the_robot_for_ever() -> None:
    lab = Lab(Located)
    driver = lab.driver
    assert isinstance(driver, Located)
    lab.origin = (9.0, 9.0, 0.0)  # far from the start pose: its first fixes have to agree
    lab.seeing = True
    lab.run(0.03)
    assert lab.agent.fixes.unsettled[0]
    driver.senses = Pose(9.0, 9.0, 0.0)
    lab.run(0.1)
    assert not lab.agent.fixes.unsettled[0]
    assert not lab.agent.reflexes.pose_uncertain[0]
