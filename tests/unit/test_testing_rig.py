"""The check of drivers with a rig: it breaks the link of a robot in memory, and names what a driver does wrong then."""

from __future__ import annotations

import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from fullswarm.drivers.base import Lifecycle, Pose, Reading
from fullswarm.drivers.null.driver import WATCHDOG_S, NullDriver
from fullswarm.testing import Report, Rig, check_driver, driver, faults, process, trial
from tests.unit.tethered import (
    BackActive,
    BelievesNoise,
    CannotClose,
    Chokes,
    CountsTheHour,
    Creeps,
    DeadBand,
    Deaf,
    DrivesOn,
    DrivesThroughTheHour,
    DropsOut,
    FeelsForEver,
    FeelsNothing,
    KeepsFault,
    LeaksAThread,
    LeavesTheRestToTheWatchdog,
    LosesItsThread,
    MindsTheWall,
    Mirrored,
    NoFault,
    NotBack,
    RaisesButDrivesOn,
    Reverses,
    Rival,
    Robot,
    SaysNothing,
    SeesNothing,
    StaysArmed,
    TellsAgain,
    TenPercent,
    Tethered,
    TrustsTheWall,
    TurnsTenPercent,
    WrongScale,
)

BROKEN: list[tuple[type[Tethered], str]] = [
    (NoFault, r"it is ACTIVE, not FAULT, 0\.4 s after unplugging"),
    (SaysNothing, "without a text; state why"),
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
    (FeelsNothing, "a bump is not reported"),
    (FeelsForEver, "still reports a bump"),
    (Mirrored, r"the body is at Pose\(x_m=1\.0, y_m=2\.0"),
    (SeesNothing, "senses_obstacles, but an obstacle is not reported"),
    (Reverses, "denies reversing, but"),
    (CountsTheHour, "odometry grows by .* at a jump of the clock"),
    (DrivesThroughTheHour, "still moves .* after a jump of the clock"),
    (TrustsTheWall, "not FAULT, .* and the wall clock was set back"),
    (MindsTheWall, "after the wall clock was set by 3600 s"),
    (RaisesButDrivesOn, r"a value that is not finite slows it after 0\.[23]"),
    (LeavesTheRestToTheWatchdog, r"close\(\) slows it after (0\.9|1\.0)"),
    (StaysArmed, r"the motors are on although it is READY after deactivate"),
    (LeaksAThread, r"close\(\) leaves the thread 'forgotten'"),
    (DropsOut, "although it was activated and commanded|not ACTIVE"),
    (Rival, "constructing a second driver disturbs the first"),
    (TenPercent, r"10% apart, more than 6%; check wheel radius"),
    (TurnsTenPercent, r"10% apart, more than 6%; check wheel base"),
    (DeadBand, r"returns 0\.050 m/s, but the robot moves with 0\.000 m/s"),
]


CLAIM = (
    WrongScale, FeelsNothing, FeelsForEver, Mirrored, SeesNothing, Reverses, TenPercent, TurnsTenPercent, DeadBand,
)  # fmt: skip
CONTRACT = (RaisesButDrivesOn, LeavesTheRestToTheWatchdog, StaysArmed, LeaksAThread, DropsOut, Rival)
SECTION = (
    dict.fromkeys(CLAIM, "check_claims")
    | dict.fromkeys(CONTRACT, "check_contract")
    | (dict.fromkeys((CountsTheHour, DrivesThroughTheHour, TrustsTheWall, MindsTheWall), "check_jumps"))
)


def rig(kind: type[Tethered] = Tethered) -> Rig:
    robot = Robot(watchdog_s=float(str(kind.claims.get("watchdog_s", WATCHDOG_S))))
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
        motors_on=lambda: robot.armed,
        fault_s=0.4,
        ready_s=0.3,
    )


@pytest.fixture(autouse=True)
def brisk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Watch for a shorter time: the robot has no inertia."""
    monkeypatch.setattr(driver, "WINDOW_S", 0.06)
    monkeypatch.setattr(driver, "CALLS", 10)
    for module in (trial, faults):
        monkeypatch.setattr(module, "IDLE_S", 0.05)
    monkeypatch.setattr(trial, "STEP_S", 0.005)
    monkeypatch.setattr(driver, "NEXT_S", 0.2)
    monkeypatch.setattr(driver, "WAY_S", 0.3)
    monkeypatch.setattr(driver, "SLOW_S", 0.1)
    monkeypatch.setattr(faults, "NOISE_S", 0.1)
    monkeypatch.setattr(faults, "UNRECEIVED_S", 0.12)


@pytest.mark.parametrize(("broken", "sentence"), BROKEN)
def test_a_broken_driver_is_told_what_is_wrong(
    broken: type[Tethered], sentence: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    only(monkeypatch, SECTION.get(broken, "check_faults"))
    with pytest.raises(AssertionError, match=sentence):
        check_driver(rig(broken), settle_s=0.3, deadline_s=0.3)


def only(monkeypatch: pytest.MonkeyPatch, section: str) -> None:
    """Leave out what takes time and is not meant; the lifecycle is the business of another file."""
    for name in {"check_contract", "check_claims", "check_actuators", "check_faults", "check_jumps"} - {section}:
        monkeypatch.setattr(driver, name, open_only if name == "check_contract" else lambda *_: None)


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
        "lifecycle", "limits, signs and scale", "silence of the controller", "not finite", "promptness",
        "deactivate and close", "slow driving", "can_reverse", "senses_bumps", "senses_pose", "senses_obstacles",
        "actuators", "ranges",
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

    assert check_driver(rig(Sees), settle_s=0.3, deadline_s=0.3).checked["senses_obstacles"] == "reported"


def test_what_is_late_on_a_busy_machine_is_no_fault_of_the_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    """This process gets the processor for 20 ms and then loses it for 100 ms, all the time."""
    only(monkeypatch, "check_contract")
    monkeypatch.setattr(trial, "STEP_S", 0.02)
    real_wait = threading.Event.wait

    def late(event: threading.Event, timeout: float | None = None) -> bool:
        return real_wait(event, timeout if timeout is None or timeout > 0.03 else timeout + 0.1)

    monkeypatch.setattr(threading.Event, "wait", late)
    report = check_driver(rig(), settle_s=0.3, deadline_s=0.3)
    assert "lifecycle" in report.checked


def test_a_process_that_cannot_drive_says_why(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("check_contract", "check_claims", "check_faults", "check_jumps"):
        monkeypatch.setattr(driver, name, lambda *_: None)
    shy = replace(rig(), other_process=True, make=lambda: NullDriver("null://r1"))  # another process is another robot
    monkeypatch.setattr(process, "START_S", 0.5)
    monkeypatch.setattr(process, "_MODULE", "fullswarm.no_such_module")
    with pytest.raises(AssertionError, match=r"does not get the robot to move: .*No module named fullswarm"):
        check_driver(shy, settle_s=0.3, deadline_s=0.3)
