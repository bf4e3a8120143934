"""The check of drivers with a rig: it breaks the link of a robot in memory, and names what a driver does wrong then."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from fullswarm.drivers.base import Lifecycle, Pose, Reading
from fullswarm.drivers.null.driver import NullDriver
from fullswarm.testing import Report, Rig, check_driver, claims, contract, driver, faults, jumps, trial
from tests.unit.tethered import (
    BackActive,
    BelievesNoise,
    CannotClose,
    Chokes,
    CountsTheHour,
    Creeps,
    Deaf,
    DrivesOn,
    DrivesThroughTheHour,
    FeelsForEver,
    FeelsNothing,
    KeepsFault,
    LosesItsThread,
    MindsTheWall,
    Mirrored,
    NoFault,
    NotBack,
    Reverses,
    Robot,
    SaysNothing,
    SeesNothing,
    TellsAgain,
    Tethered,
    TrustsTheWall,
    WrongScale,
)

BROKEN: list[tuple[type[Tethered], str]] = [
    (NoFault, r"it is ACTIVE, not FAULT, 0\.4 s after unplugging"),
    (SaysNothing, "says nothing; say why"),
    (BackActive, "ACTIVE again after unplugging"),
    (NotBack, r"it is FAULT, not READY, 0\.3 s after the end of unplugging"),
    (KeepsFault, "READY after unplugging with a fault: there was something"),
    (DrivesOn, r"still moves 0\.3 s after it was READY again"),
    (TellsAgain, "when nothing came any more"),
    (CannotClose, r"close\(\) without the device raises OSError: no such device"),
    (BelievesNoise, r"odometry leaps by 5\.00 m"),
    (Creeps, r"odometry leaps by 0\.[36]"),
    (Chokes, r"raises ValueError: bad frame"),
    (LosesItsThread, "thread 'link' ended with IndexError: pop from empty list"),
    (Deaf, "neither READY nor ACTIVE, .* after garbage .not a word"),
    (WrongScale, "check wheel radius"),
    (FeelsNothing, "a bump is not told"),
    (FeelsForEver, "still tells a bump"),
    (Mirrored, r"the body is at Pose\(x_m=1\.0, y_m=2\.0"),
    (SeesNothing, "senses_obstacles, but an obstacle is not told"),
    (Reverses, "says that it cannot reverse, but"),
    (CountsTheHour, "odometry goes on by .* at a jump of the clock"),
    (DrivesThroughTheHour, "still moves .* after a jump of the clock"),
    (TrustsTheWall, "not FAULT, .* and the wall clock was set back"),
    (MindsTheWall, "after the wall clock was set by 3600 s"),
]


SECTION = dict.fromkeys((WrongScale, FeelsNothing, FeelsForEver, Mirrored, SeesNothing, Reverses), "check_claims") | (
    dict.fromkeys((CountsTheHour, DrivesThroughTheHour, TrustsTheWall, MindsTheWall), "check_jumps")
)


def rig(kind: Callable[..., Tethered] = Tethered) -> Rig:
    robot = Robot()
    return Rig(
        make=lambda: kind(robot),
        make_on=lambda clock: kind(robot, clock),
        body_speed=robot.speed,
        body_pose=lambda: Pose(1.0, 2.0, 0.5),
        unplug=lambda: robot.plug(False),
        replug=lambda: robot.plug(True),
        mute=robot.mute,
        garbage=robot.talk,
        cut=robot.cut,
        bump=robot.press,
        obstacle=lambda: None,
        fault_s=0.4,
        ready_s=0.3,
    )


@pytest.fixture(autouse=True)
def brisk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Watch for a shorter time: the robot has no inertia."""
    monkeypatch.setattr(contract, "WINDOW_S", 0.06)
    monkeypatch.setattr(contract, "CALLS", 10)
    for module in (trial, faults, jumps):
        monkeypatch.setattr(module, "IDLE_S", 0.05)
    monkeypatch.setattr(trial, "STEP_S", 0.005)
    monkeypatch.setattr(claims, "NEXT_S", 0.2)
    monkeypatch.setattr(faults, "NOISE_S", 0.1)
    monkeypatch.setattr(faults, "UNHEARD_S", 0.12)


@pytest.mark.parametrize(("broken", "sentence"), BROKEN)
def test_a_broken_driver_is_told_what_is_wrong(
    broken: type[Tethered], sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    only(monkeypatch, SECTION.get(broken, "check_faults"))
    with pytest.raises(AssertionError, match=sentence):
        check_driver(rig(broken), settle_s=0.3, deadline_s=0.3)


def only(monkeypatch: pytest.MonkeyPatch, section: str) -> None:
    """Leave out what takes time and is not meant; the lifecycle is the business of another file."""
    for name in {"check_contract", "check_claims", "check_faults", "check_jumps"} - {section}:
        monkeypatch.setattr(driver, name, open_only if name == "check_contract" else lambda _: None)


def open_only(trial: trial.Trial, *_: object) -> None:
    trial.open()
    trial.reach(Lifecycle.READY, "open()")


def test_a_driver_without_fault_passes_and_the_report_says_what_was_left_out() -> None:
    before = threading.excepthook, time.time
    report = check_driver(rig(), settle_s=0.3, deadline_s=0.3)
    assert (threading.excepthook, time.time) == before
    assert set(report.skipped) == {"controller's process paused", "watchdog_s"}
    assert "other_process" in report.skipped["watchdog_s"]
    assert {"unplug", "mute and stale data", "garbage", "frames cut short", "wall clock set"} <= set(report.checked)
    assert "at rest after" in report.checked["unplug"]


def test_without_a_rig_nothing_is_believed_to_be_checked() -> None:
    report = check_driver(lambda: NullDriver("null://r1"), settle_s=0.3, deadline_s=0.3)
    assert set(report.checked) == {
        "lifecycle", "limits, signs and scale", "silence of the controller", "promptness", "deactivate and close",
        "can_reverse", "senses_bumps", "senses_pose", "senses_obstacles",
    }  # fmt: skip
    for name, lack in (("unplug", "no unplug, no replug"), ("garbage", "no garbage"), ("wall clock set", "no make_on")):
        assert lack in report.skipped[name]
    still = check_driver(lambda: NullDriver("null://r1"), exercise=False)
    assert set(still.checked) == {"lifecycle", "promptness", "deactivate and close"}
    assert set(still.skipped) == set(report.checked | report.skipped) - set(still.checked)


def test_a_report_is_a_table() -> None:
    report = Report("null://r1")
    report.add("lifecycle")
    report.add("unplug", "FAULT after 0.1 s")
    assert not report.lacks("garbage", garbage=print)
    assert report.lacks("cuts", cut=None, unplug=None, mute=print)
    assert str(report).splitlines() == [
        "null://r1",
        "  checked  lifecycle",
        "  checked  unplug     FAULT after 0.1 s",
        "  skipped  cuts       the rig has no cut, no unplug",
    ]


def test_the_obstacles_of_a_driver_that_sees_them_are_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    only(monkeypatch, "check_claims")

    class Sees(SeesNothing):
        def look(self, reading: Reading) -> Reading:
            return replace(reading, obstacles=np.ones((1, 6)))

    assert check_driver(rig(Sees), settle_s=0.3, deadline_s=0.3).checked["senses_obstacles"] == "told"
