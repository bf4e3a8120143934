"""A robot in memory with a link to break, a driver for it without fault, and drivers with one fault each."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Pose, Reading, Twist
from fullswarm.drivers.null.driver import WATCHDOG_S, NullDriver
from fullswarm.testing import Rig

SILENT_S = 0.1
WALL_S = time.time()


@dataclass
class Robot:
    """A device in memory: it keeps its last set-point until its watchdog bites."""

    told: Twist = STAND
    told_s: float = -math.inf
    plugged: bool = True
    muted: bool = False
    noise: bytes = b""
    cuts: int = 0
    pressed: bool = False
    watchdog_s: float = WATCHDOG_S
    armed: bool = False
    clock: Clock = field(default_factory=MonotonicClock)

    def obey(self, twist: Twist) -> None:
        if self.plugged:
            self.told, self.told_s = twist, self.clock.now_s()

    def speed(self) -> Twist:
        return self.told if self.clock.now_s() - self.told_s < self.watchdog_s else STAND

    def plug(self, plugged: bool) -> None:
        self.plugged = plugged

    def mute(self, muted: bool) -> None:
        self.muted = muted

    def talk(self, noise: bytes) -> None:
        self.noise += noise

    def cut(self) -> None:
        self.cuts += 1

    def press(self, pressed: bool) -> None:
        self.pressed = pressed


class Tethered(NullDriver):
    """A driver for that robot, without fault; it does on the caller's thread what others do on their link's."""

    claims: dict[str, object] = {}  # noqa: RUF012  (read only)

    def __init__(self, robot: Robot, clock: Clock | None = None) -> None:
        super().__init__("null://r1", clock)
        self.robot = robot
        self.description = replace(self.description, **({"senses_bumps": True} | self.claims))  # type: ignore[arg-type]
        self.last: Reading | None = None
        self.heard_s = -math.inf

    def open(self) -> None:
        super().open()
        self.heard_s, self.last = self._clock.now_s(), None

    def listen(self) -> None:
        now_s = self._clock.now_s()
        if self.robot.plugged and not self.robot.muted:
            if self.state is Lifecycle.FAULT:
                self.back()
            self.heard_s = now_s
        elif self.state in (Lifecycle.READY, Lifecycle.ACTIVE) and now_s - self.heard_s > SILENT_S:
            self.lose()
        self.hear(self.robot.noise, self.robot.cuts)
        self.robot.noise, self.robot.cuts = b"", 0

    def hear(self, noise: bytes, cuts: int) -> None:
        """Know noise for what it is."""

    def lose(self) -> None:
        self._set(STAND)
        self.state, self.fault = Lifecycle.FAULT, "not a word: is it plugged in?"

    def back(self) -> None:
        self._set(STAND)
        self.state, self.fault = Lifecycle.READY, ""

    def read(self) -> Reading | None:
        if self.state is Lifecycle.CLOSED:
            return None
        self.listen()
        if self.heard_s > self.stamp_s:
            told = super().read()
            self.last = told and self.look(replace(told, stamp_s=self.heard_s, hazards=self.hazards()))
        return self.last

    def look(self, reading: Reading) -> Reading:
        return reading

    @property
    def stamp_s(self) -> float:
        return -math.inf if self.last is None else self.last.stamp_s

    def hazards(self) -> Hazard:
        return Hazard.BUMP if self.robot.pressed else Hazard.NONE

    def command(self, twist: Twist) -> Twist:
        if self.state is not Lifecycle.CLOSED:
            self.listen()
        return super().command(twist)

    def close(self) -> None:
        super().close()
        self.robot.obey(STAND)

    def _set(self, twist: Twist) -> None:
        super()._set(twist)
        self.robot.obey(self._twist)


class NoFault(Tethered):
    def lose(self) -> None:
        self._set(STAND)


class SaysNothing(Tethered):
    def lose(self) -> None:
        super().lose()
        self.fault = " "


class BackActive(Tethered):
    def back(self) -> None:
        super().back()
        self.state = Lifecycle.ACTIVE


class NotBack(Tethered):
    def back(self) -> None:
        """Stay where it is."""


class KeepsFault(Tethered):
    def back(self) -> None:
        super().back()
        self.fault = "there was something"


class DrivesOn(Tethered):
    """Back in READY it says the old set-point once more, whatever it tells the agent."""

    haunted = False

    def back(self) -> None:
        self.haunted = True
        super().back()

    def _set(self, twist: Twist) -> None:
        super()._set(twist)
        if self.haunted:
            self.robot.obey(Twist(0.25, 0.0))


class TellsAgain(Tethered):
    def read(self) -> Reading | None:
        reading = super().read()
        return reading and replace(reading, stamp_s=self._clock.now_s())


class CannotClose(Tethered):
    def close(self) -> None:
        if not self.robot.plugged and self.state is not Lifecycle.CLOSED:
            super().close()
            raise OSError("no such device")
        super().close()


class BelievesNoise(Tethered):
    def hear(self, noise: bytes, cuts: int) -> None:
        if noise:
            pose = self._odometry
            self._odometry = Pose(pose.x_m + 5.0, pose.y_m, pose.heading_rad)


class Creeps(Tethered):
    """Each frame that is cut turns the robot a little."""

    def hear(self, noise: bytes, cuts: int) -> None:
        pose = self._odometry
        self._odometry = Pose(pose.x_m, pose.y_m + 0.3 * cuts, pose.heading_rad)


class Chokes(Tethered):
    def hear(self, noise: bytes, cuts: int) -> None:
        if noise:
            raise ValueError("bad frame")


class LosesItsThread(Tethered):
    def hear(self, noise: bytes, cuts: int) -> None:
        if noise and not getattr(self, "lost", False):
            self.lost = True
            thread = threading.Thread(target=[].pop, name="link")
            thread.start()
            thread.join()


class Deaf(Tethered):
    """After garbage it never finds the next frame."""

    deaf = False

    def hear(self, noise: bytes, cuts: int) -> None:
        self.deaf = self.deaf or bool(noise)
        if self.deaf and self.state is not Lifecycle.FAULT:
            self.lose()

    def back(self) -> None:
        if not self.deaf:
            super().back()


class WrongScale(Tethered):
    """Commands and readings wrong alike: a wheel of another radius."""

    def _set(self, twist: Twist) -> None:
        super()._set(twist)
        self.robot.obey(Twist(0.5 * self._twist.linear_m_s, self._twist.angular_rad_s))


class FeelsNothing(Tethered):
    def hazards(self) -> Hazard:
        return Hazard.NONE


class FeelsForEver(Tethered):
    felt = False

    def hazards(self) -> Hazard:
        self.felt = self.felt or self.robot.pressed
        return Hazard.BUMP if self.felt else Hazard.NONE


class Mirrored(Tethered):
    claims = {"senses_pose": True}  # noqa: RUF012

    def look(self, reading: Reading) -> Reading:
        return replace(reading, pose=Pose(1.0, -2.0, 0.5))


class SeesNothing(Tethered):
    claims = {"senses_obstacles": True}  # noqa: RUF012


class Reverses(Tethered):
    claims = {"limits": replace(NullDriver("null://r1").description.limits, can_reverse=False)}  # noqa: RUF012

    def command(self, twist: Twist) -> Twist:
        applied = super().command(twist)
        return replace(applied, linear_m_s=max(0.0, applied.linear_m_s))


class CountsTheHour(Tethered):
    def _integrate(self) -> None:
        passed_s = self._clock.now_s() - self._at_s
        if passed_s > 60.0:
            pose, way_m = self._odometry, self._twist.linear_m_s * passed_s
            self._odometry = Pose(pose.x_m + way_m, pose.y_m, pose.heading_rad)
        super()._integrate()


class DrivesThroughTheHour(Tethered):
    """Knows only what the device's watchdog cannot: that its agent is there."""

    def listen(self) -> None:
        super().listen()
        if self._clock.now_s() > time.monotonic() + 60.0:
            self.robot.told_s = self.robot.clock.now_s()


class TrustsTheWall(Tethered):
    """Measures silence by the wall clock."""

    def __init__(self, robot: Robot, clock: Clock | None = None) -> None:
        super().__init__(robot, clock)
        self.wall_s = math.inf

    def listen(self) -> None:
        if self.robot.muted and time.time() < self.wall_s + SILENT_S:
            return
        self.wall_s = time.time()
        super().listen()


class MindsTheWall(Tethered):
    def listen(self) -> None:
        super().listen()
        if abs(time.time() - WALL_S) > 1800.0:
            self.lose()


class RaisesButDrivesOn(Tethered):
    """A value that is not finite raises; the set-point before it holds until it expires."""

    def command(self, twist: Twist) -> Twist:
        if not (math.isfinite(twist.linear_m_s) and math.isfinite(twist.angular_rad_s)):
            raise ValueError("not finite")
        return super().command(twist)


class LeavesTheRestToTheWatchdog(Tethered):
    claims = {"watchdog_s": 1.0}  # noqa: RUF012

    def close(self) -> None:
        NullDriver.close(self)


class TenPercent(Tethered):
    """Its wheels are a tenth larger than it believes."""

    def look(self, reading: Reading) -> Reading:
        pose = reading.odometry
        return replace(reading, odometry=Pose(0.9 * pose.x_m, 0.9 * pose.y_m, pose.heading_rad))


class TurnsTenPercent(Tethered):
    def look(self, reading: Reading) -> Reading:
        pose = reading.odometry
        return replace(reading, odometry=Pose(pose.x_m, pose.y_m, math.remainder(1.1 * pose.heading_rad, math.tau)))


class DeadBand(Tethered):
    """Says that it applies what its motors do not turn for."""

    def _set(self, twist: Twist) -> None:
        super()._set(twist)
        if abs(self._twist.linear_m_s) < 0.1:
            self.robot.obey(Twist(0.0, self._twist.angular_rad_s))


class StaysArmed(Tethered):
    """Switches the motors on when it is activated, and never off."""

    def activate(self) -> None:
        super().activate()
        self.robot.armed |= self.state is Lifecycle.ACTIVE


class LeaksAThread(Tethered):
    def open(self) -> None:
        super().open()
        threading.Thread(target=threading.Event().wait, args=(20.0,), name="forgotten", daemon=True).start()


class DropsOut(Tethered):
    """Leaves ACTIVE by itself, a moment after it was activated."""

    activated_s = math.inf

    def activate(self) -> None:
        super().activate()
        self.activated_s = self._clock.now_s()

    def listen(self) -> None:
        super().listen()
        if self.state is Lifecycle.ACTIVE and self._clock.now_s() - self.activated_s > 0.02:
            self.state = Lifecycle.READY


class Rival(Tethered):
    """Constructing it takes the robot from whoever drives it."""

    def __init__(self, robot: Robot, clock: Clock | None = None) -> None:
        super().__init__(robot, clock)
        robot.owner = self  # type: ignore[attr-defined]

    def listen(self) -> None:
        super().listen()
        if self.state is Lifecycle.ACTIVE and self.robot.owner is not self:  # type: ignore[attr-defined]
            self.state, self.robot.owner = Lifecycle.READY, self  # type: ignore[attr-defined]


@contextmanager
def dead_band() -> Iterator[Rig]:
    """Yield the hands for a robot whose driver keeps its dead band to itself."""
    robot = Robot()
    yield Rig(make=lambda: DeadBand(robot), body_speed=robot.speed)
