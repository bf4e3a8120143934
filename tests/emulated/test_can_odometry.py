"""How far odometry is off at the end of a drive through a real port: a square, forwards and backwards."""

from __future__ import annotations

import math
import time
from pathlib import Path

import pytest

from fullswarm.drivers.base import STAND, Lifecycle, Pose
from fullswarm.drivers.can.driver import CanBaseDriver
from fullswarm.emulators.can.emulator import EmulatedBase
from tests.emulated.can_robot import wait_state
from tests.unit.can_square import Square, error_m
from tests.waiting import until

OPTIONS = "interface=slcan&settle=0&left=1&right=2&wheel_radius=0.05&base=0.3&watchdog=0.5&vel_limit=10"


def drive(tmp_path: Path, side_m: float, laps: int, speed_m_s: float) -> None:
    url = f"can+odrive://{tmp_path}/robot.can?{OPTIONS}&speed={speed_m_s}"
    driver = CanBaseDriver(url)
    with EmulatedBase(url) as robot:
        driver.open()
        try:
            wait_state(driver, Lifecycle.READY)
            driver.activate()
            wait_state(driver, Lifecycle.ACTIVE)
            for sign in (1.0, -1.0):
                square_round(driver, robot, Square(pose(driver), side_m, laps, sign, speed_m_s, 8.0))
        finally:
            driver.close()


def square_round(driver: CanBaseDriver, robot: EmulatedBase, square: Square) -> None:
    before, told_before = robot.body.state(), pose(driver)
    last, went_m = before, 0.0
    while (twist := square.twist(pose(driver))) is not None:
        assert driver.state is Lifecycle.ACTIVE, driver.fault
        driver.command(twist)
        time.sleep(0.02)
        here = robot.body.state()
        last, went_m = here, went_m + math.hypot(here.x_m - last.x_m, here.y_m - last.y_m)
    driver.command(STAND)
    until(lambda: robot.body.state().speed_m_s == robot.body.state().turn_rad_s == 0.0, 1.0)
    time.sleep(0.05)  # for the last encoder estimates
    after, told = robot.body.state(), pose(driver)
    assert went_m == pytest.approx(square.path_m, rel=0.15)  # who goes nowhere is never off
    assert error_m(told, after.x_m, after.y_m) - error_m(told_before, before.x_m, before.y_m) < 0.01 * square.path_m


def pose(driver: CanBaseDriver) -> Pose:
    reading = driver.read()
    assert reading is not None
    return reading.odometry


def test_a_square_of_20_cm_each_way(tmp_path: Path) -> None:
    """The short form: 0.8 m each way. The bar's ten squares of 2 m take two minutes and are marked slow."""
    drive(tmp_path, 0.2, 1, 2.0)


@pytest.mark.slow
def test_ten_squares_of_2_m_each_way(tmp_path: Path) -> None:
    drive(tmp_path, 2.0, 10, 2.5)
