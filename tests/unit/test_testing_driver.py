"""The published check of drivers without a rig: it lets the template pass, and names each defect of a broken one."""

from __future__ import annotations

import math
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

from fullswarm.drivers.base import STAND, Lifecycle, Pose, Reading, Twist
from fullswarm.drivers.null.driver import LIMITS, NullDriver
from fullswarm.testing import check_driver, driver, trial


class Remembering(NullDriver):
    """The template driver, with all that it was told."""

    def __init__(self, url: str = "null://r1") -> None:
        super().__init__(url)
        self.applied: list[Twist] = []

    def command(self, twist: Twist) -> Twist:
        self.applied.append(super().command(twist))
        return self.applied[-1]


class OpenAtOnce(NullDriver):
    def __init__(self, url: str) -> None:
        super().__init__(url)
        self.open()


class Unlimited(NullDriver):
    def __init__(self, url: str) -> None:
        super().__init__(url)
        limits = replace(LIMITS, turn_rad_s=math.inf)
        self.description = replace(self.description, limits=limits)


class NeverReady(NullDriver):
    def open(self) -> None:
        super().open()
        self.state = Lifecycle.OPEN


class Eager(NullDriver):
    def open(self) -> None:
        super().open()
        self.state = Lifecycle.ACTIVE


class Drifting(NullDriver):
    """Moves in READY, whatever it says."""

    def command(self, twist: Twist) -> Twist:
        applied = super().command(twist)
        if self.state is Lifecycle.READY:
            self._twist = twist
        return applied


class SaysWhatWasWished(NullDriver):
    def command(self, twist: Twist) -> Twist:
        applied = super().command(twist)
        return twist if self.state is Lifecycle.ACTIVE else applied


class MovesWhenClosed(NullDriver):
    def command(self, twist: Twist) -> Twist:
        super().command(twist)
        return twist


class Permissive(NullDriver):
    def command(self, twist: Twist) -> Twist:
        try:
            return super().command(twist)
        except ValueError:
            return STAND


class RefusesTooMuch(NullDriver):
    def command(self, twist: Twist) -> Twist:
        if abs(twist.linear_m_s) > 1.0:
            raise ValueError("too fast")
        return super().command(twist)


class RaisesOnly(NullDriver):
    """A value that is not finite raises, but the wheels go on until the watchdog bites."""

    def command(self, twist: Twist) -> Twist:
        if not (math.isfinite(twist.linear_m_s) and math.isfinite(twist.angular_rad_s)):
            raise ValueError("not finite")
        return super().command(twist)


class WrongWayRound(NullDriver):
    def command(self, twist: Twist) -> Twist:
        applied = super().command(twist)
        return Twist(applied.linear_m_s, -applied.angular_rad_s)


class Telling(NullDriver):
    """Changes what is read."""

    def change(self, reading: Reading) -> Reading:
        return reading

    def read(self) -> Reading | None:
        reading = super().read()
        return reading and self.change(reading)


class Clockwise(Telling):
    def change(self, reading: Reading) -> Reading:
        pose, twist = reading.odometry, reading.twist
        mirrored = Pose(pose.x_m, -pose.y_m, -pose.heading_rad)
        return replace(reading, odometry=mirrored, twist=Twist(twist.linear_m_s, -twist.angular_rad_s))


class Millimetres(Telling):
    def change(self, reading: Reading) -> Reading:
        pose = reading.odometry
        return replace(reading, odometry=Pose(pose.x_m * 1e3, pose.y_m * 1e3, pose.heading_rad))


class Degrees(Telling):
    def change(self, reading: Reading) -> Reading:
        twist = reading.twist
        return replace(reading, twist=Twist(twist.linear_m_s, math.degrees(twist.angular_rad_s)))


class Askew(Telling):
    """Its x axis points to the front left."""

    def change(self, reading: Reading) -> Reading:
        pose, share = reading.odometry, math.sqrt(0.5)
        x_m, y_m = share * (pose.x_m - pose.y_m), share * (pose.x_m + pose.y_m)
        return replace(reading, odometry=Pose(x_m, y_m, pose.heading_rad))


class WallClock(Telling):
    def change(self, reading: Reading) -> Reading:
        return replace(reading, stamp_s=time.time())


class Backwards(Telling):
    """Every second reading is older than the one before."""

    def change(self, reading: Reading) -> Reading:
        self.even = not getattr(self, "even", False)
        return replace(reading, stamp_s=reading.stamp_s + (0.0 if self.even else 0.015))


class HiddenPose(Telling):
    def change(self, reading: Reading) -> Reading:
        return replace(reading, pose=reading.odometry)


class NoWatchdog(NullDriver):
    def read(self) -> Reading | None:
        self._commanded_s = self._clock.now_s()
        return super().read()


class Waiting(NullDriver):
    def command(self, twist: Twist) -> Twist:
        threading.Event().wait(0.006)
        return super().command(twist)


class StaysActive(NullDriver):
    def deactivate(self) -> None:
        self._set(STAND)


class RollsOn(NullDriver):
    """Leaves the wheels to the watchdog."""

    def deactivate(self) -> None:
        if self.state is Lifecycle.ACTIVE:
            self.state = Lifecycle.READY


class CloseOnce(NullDriver):
    closed = False

    def close(self) -> None:
        if self.state is not Lifecycle.CLOSED:
            self.closed = True
            super().close()
        elif self.closed and sys.exc_info()[0] is None:
            raise AssertionError("closed twice")


class RemembersItsWay(NullDriver):
    def open(self) -> None:
        odometry = self._odometry
        super().open()
        self._odometry = odometry


BROKEN_DRIVERS: list[tuple[type[NullDriver], str]] = [
    (OpenAtOnce, "before open"),
    (Unlimited, r"limits\.turn_rad_s is inf"),
    (NeverReady, r"it is OPEN, not READY, 0\.3 s after open\(\)"),
    (Eager, r"it is ACTIVE, not READY"),
    (Drifting, "it moves while READY"),
    (SaysWhatWasWished, r"linear beyond 0\.5; clip"),
    (MovesWhenClosed, "anything but ACTIVE applies and returns zero"),
    (Permissive, r"command\(Twist\(linear_m_s=nan.* before open\(\) returns"),
    (RefusesTooMuch, "it is finite: clip it"),
    (RaisesOnly, "set zero, then raise"),
    (WrongWayRound, "angular the other way round"),
    (Clockwise, "check sign"),
    (Millimetres, r"odometry leaps by .*check its scale"),
    (Degrees, "check signs and scale"),
    (Askew, "sideways"),
    (WallClock, "monotonic clock's time of arrival"),
    (Backwards, "stamps of readings go back"),
    (HiddenPose, "set senses_pose"),
    (NoWatchdog, r"after silence \(set zero, from a thread of the driver's own"),
    (Waiting, r"command\(\) takes .* never wait there"),
    (StaysActive, r"ACTIVE, not READY, 0\.3 s after deactivate|after deactivate\(\) returns"),
    (RollsOn, r"deactivate\(\) slows it after 0\.3"),
    (CloseOnce, "closed twice"),
    (RemembersItsWay, r"starts at \(0, 0, 0\)"),
]


@pytest.fixture
def brisk(monkeypatch: pytest.MonkeyPatch) -> None:
    """Watch for a shorter time: the template driver has no inertia."""
    monkeypatch.setattr(driver, "WINDOW_S", 0.06)
    monkeypatch.setattr(trial, "IDLE_S", 0.05)


@pytest.mark.usefixtures("brisk")
@pytest.mark.parametrize(("broken", "sentence"), BROKEN_DRIVERS)
def test_a_broken_driver_is_told_what_is_wrong(broken: type[NullDriver], sentence: str) -> None:
    with pytest.raises(AssertionError, match=sentence):
        check_driver(lambda: broken("null://r1"), settle_s=0.3, deadline_s=0.3)


@pytest.mark.usefixtures("brisk")
def test_nothing_moves_unless_it_may() -> None:
    made: list[Remembering] = []

    def make() -> Remembering:
        made.append(Remembering())
        return made[-1]

    check_driver(make, settle_s=0.3, deadline_s=0.3, exercise=False)
    assert len(made) == 2
    assert made[1].applied == []
    assert set(made[0].applied) == {STAND}
    check_driver(make, settle_s=0.3, deadline_s=0.3)
    assert max(each.linear_m_s for each in made[2].applied) == LIMITS.speed_m_s


@pytest.mark.usefixtures("brisk")
def test_the_pump_is_worked_while_the_check_waits() -> None:
    pumped: list[float] = []
    check_driver(
        lambda: NullDriver("null://r1"), settle_s=0.3, pump=lambda: pumped.append(time.monotonic()), exercise=False
    )
    assert len(pumped) > 5
    assert np.median(np.diff(pumped)) == pytest.approx(0.02, abs=0.01)
