"""Odometry through the real port: squares of 2 m, forwards and backwards, across the wrap of the encoders.

The robot, its body and the driver share one clock that runs several times as fast as the wall's, so that all that is
timed (frames, bytes on the wire, expiry) keeps its proportions; only the machine has less time for it.
"""

from __future__ import annotations

import math
import time

import pytest

from fullswarm.drivers.base import STAND, Lifecycle, Pose, Twist
from fullswarm.drivers.create_oi.driver import CreateDriver
from fullswarm.drivers.create_oi.protocol import CREATE1, CREATE2, Generation
from fullswarm.emulators.create_oi.emulator import CreateEmulator
from fullswarm.geometry import wrap
from fullswarm.simulation.bodies import BodyState, FreeBody

SPEED_M_S, TURN_RAD_S = 0.45, 1.5
NEAR_THE_WRAP = (65000, 400)
"""One encoder is about to wrap forwards, the other backwards."""


class FastClock:
    """The wall's clock, but faster."""

    def __init__(self, factor: float) -> None:
        self._factor, self._start_s = factor, time.monotonic()

    def now_s(self) -> float:
        return self._factor * (time.monotonic() - self._start_s)


class Walk:
    """A driver that is led around squares by its own odometry."""

    def __init__(self, driver: CreateDriver, side_m: float, factor: float) -> None:
        self.driver, self._side_m, self._pause_s = driver, side_m, 0.02 / factor

    @property
    def pose(self) -> Pose:
        reading = self.driver.read()
        assert reading is not None
        return reading.odometry

    def start(self) -> None:
        self.driver.open()
        self._reach(Lifecycle.READY)
        self.driver.activate()
        self._reach(Lifecycle.ACTIVE)

    def _reach(self, state: Lifecycle) -> None:
        deadline_s = time.monotonic() + 10.0
        while self.driver.state is not state:
            assert time.monotonic() < deadline_s, self.driver.fault or self.driver.blocked
            time.sleep(self._pause_s)

    def squares(self, count: int, direction: float) -> None:
        """Drive each side on the line that leads there, `direction` -1.0 backwards, and turn left at its end."""
        start = self.pose
        heading = start.heading_rad
        for _ in range(4 * count):
            start = self.pose
            self._side(start, heading, direction)
            heading = wrap(heading + math.pi / 2.0)
            while (off := wrap(heading - self.pose.heading_rad)) > 0.01:
                self._go(Twist(0.0, min(TURN_RAD_S, 3.0 * off + 0.05)))

    def _side(self, start: Pose, heading: float, direction: float) -> None:
        while True:
            pose = self.pose
            gone = direction * self._along(start, pose, heading)
            if gone >= self._side_m:
                return
            speed = min(SPEED_M_S, 2.0 * (self._side_m - gone) + 0.05)
            self._go(Twist(direction * speed, 1.5 * wrap(heading - pose.heading_rad)))

    @staticmethod
    def _along(start: Pose, pose: Pose, heading: float) -> float:
        return (pose.x_m - start.x_m) * math.cos(heading) + (pose.y_m - start.y_m) * math.sin(heading)

    def _go(self, twist: Twist) -> None:
        assert self.driver.command(twist) != STAND, self.driver.fault or self.driver.blocked
        time.sleep(self._pause_s)

    def halt(self) -> None:
        """Stand, and wait until the driver has heard of it."""
        self.driver.deactivate()
        stamps: set[float] = set()
        deadline_s = time.monotonic() + 10.0
        while len(stamps) < 10:
            assert time.monotonic() < deadline_s
            reading = self.driver.read()
            assert reading is not None
            stamps.add(reading.stamp_s)
            time.sleep(self._pause_s)


def gap(told: Pose, true: BodyState) -> tuple[float, float]:
    return math.hypot(told.x_m - true.x_m, told.y_m - true.y_m), abs(wrap(told.heading_rad - true.heading_rad))


def walk(
    generation: Generation, count: int, side_m: float, direction: float, factor: float
) -> tuple[float, float, float]:
    """Drive squares; return by how much the odometry is off in m and rad, and how far the body has rolled."""
    clock = FastClock(factor)
    body = FreeBody(clock=clock)
    with CreateEmulator(generation, body, encoders=NEAR_THE_WRAP, clock=clock) as robot:
        driver = CreateDriver(robot.url, clock=clock)
        walker = Walk(driver, side_m, factor)
        try:
            walker.start()
            walker.squares(count, direction)
            walker.halt()
            off_m, off_rad = gap(walker.pose, body.state())
        finally:
            driver.close()
        return off_m, off_rad, body.state().rolled_m


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_one_small_square(direction: float) -> None:
    # At a multiple of the real time a busy machine loses corners.
    off_m, off_rad, rolled_m = walk(CREATE2, 1, 0.4, direction, factor=1.0)
    assert direction * rolled_m >= 1.58
    assert off_m < 0.01 * 1.6
    assert off_rad < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("direction", [1.0, -1.0])
@pytest.mark.parametrize("generation", [CREATE2, CREATE1])
def test_ten_squares_of_two_metres(generation: Generation, direction: float) -> None:
    """80 m: the counts wrap nearly three times."""
    off_m, off_rad, rolled_m = walk(generation, 10, 2.0, direction, factor=6.0)
    assert direction * rolled_m >= 79.0
    assert off_m < 0.01 * 80.0
    assert off_rad < 0.05
