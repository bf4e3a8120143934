"""The driver through a serial adapter on a pseudo terminal, as a world process offers it to the agents."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import can
import pytest

from fullswarm.drivers.base import Lifecycle, Twist
from fullswarm.drivers.can.driver import CanBaseDriver
from fullswarm.emulators.can.emulator import AdapterPort, EmulatedBase
from fullswarm.errors import DriverError
from tests.emulated.can_robot import ODRIVE, VESC, Robot, wait_state
from tests.waiting import until

OTHER_PROCESS = """
import sys
from fullswarm.emulators.can.emulator import EmulatedBase
with EmulatedBase(sys.argv[1]):
    print("ready", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def url(tmp_path: Path) -> str:
    return f"can+odrive://{tmp_path}/robot.can?interface=slcan&settle=0&{ODRIVE}"


@pytest.fixture
def robot(url: str) -> Iterator[Robot]:
    with opened(url) as robot:
        yield robot


@contextmanager
def opened(url: str) -> Iterator[Robot]:
    robot = Robot(url)
    with ExitStack() as stack:
        stack.enter_context(robot.emulated)
        stack.callback(robot.driver.close)
        robot.driver.open()
        yield robot


def test_a_drive_through_the_port(robot: Robot) -> None:
    robot.moving()
    robot.drive(Twist(0.3, 1.0), lambda: abs(robot.reading().odometry.heading_rad) > 0.3)
    robot.driver.deactivate()
    until(lambda: robot.standing() and robot.reading().twist.linear_m_s == 0.0, 1.5)

    def agrees() -> bool:
        true, told = robot.emulated.body.state(), robot.reading().odometry
        where = pytest.approx((true.x_m, true.y_m, true.heading_rad), abs=0.01)
        return bool((told.x_m, told.y_m, told.heading_rad) == where)

    until(agrees, 3.0)  # the newest reading may be one of before the standstill
    assert robot.driver.malformed == 0


def test_a_vesc_through_the_port(tmp_path: Path) -> None:
    with opened(f"can+vesc://{tmp_path}/robot.can?interface=slcan&settle=0&{VESC}") as robot:
        robot.activate()
        robot.drive(Twist(0.3, 0.0), lambda: robot.reading().twist.linear_m_s > 0.29)
        assert robot.driver.firmware == "VESC"


def test_unplugged_and_plugged_in_again(robot: Robot) -> None:
    robot.moving()
    robot.emulated.unplug()
    assert wait_state(robot.driver, Lifecycle.FAULT) < 0.5
    assert "robot.can" in robot.driver.fault
    until(robot.standing, 0.9)  # watchdog and rolling out
    robot.emulated.replug()
    assert wait_state(robot.driver, Lifecycle.READY) < 2.0
    assert robot.idle()
    robot.moving()


@pytest.mark.slow
def test_unplugged_for_a_moment_only(robot: Robot) -> None:
    robot.moving()
    robot.emulated.unplug()
    robot.emulated.replug()
    wait_state(robot.driver, Lifecycle.FAULT)
    assert wait_state(robot.driver, Lifecycle.READY) < 2.0
    assert robot.idle()


def test_the_port_has_one_owner(robot: Robot, url: str) -> None:
    robot.moving()
    second = CanBaseDriver(url)
    with pytest.raises(DriverError, match="the port is held"):
        second.open()
    assert second.state is Lifecycle.CLOSED
    robot.drive(Twist(0.3, 0.0), lambda: robot.reading().odometry.x_m > 0.2)
    assert robot.driver.state is Lifecycle.ACTIVE
    robot.driver.close()
    second.open()
    wait_state(second, Lifecycle.READY)
    second.close()


@pytest.mark.slow
def test_a_bad_line_never_breaks_the_driver(robot: Robot) -> None:
    """A flipped bit may make another valid frame: then a fault is right, anything unexpected is not."""
    robot.moving()
    robot.emulated.faults.corrupt = 0.2
    faults = robot.keep_driving(Twist(0.3, 0.0), 1.0)
    robot.emulated.faults.corrupt = 0.0
    assert not any("unexpected" in each for each in faults)
    until(lambda: robot.driver.state in (Lifecycle.READY, Lifecycle.ACTIVE), 4.0, lambda: robot.driver.fault)


@pytest.mark.slow
def test_another_bitrate_is_a_bus_without_anybody(url: str) -> None:
    with EmulatedBase(url):
        driver = CanBaseDriver(f"{url}&bitrate=500000")
        driver.open()
        wait_state(driver, Lifecycle.FAULT)
        driver.close()
        assert "no heartbeat" in driver.fault or driver.state is Lifecycle.CLOSED


def test_the_world_in_another_process(url: str) -> None:
    with subprocess.Popen(
        [sys.executable, "-c", OTHER_PROCESS, url], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as world:
        assert world.stdout is not None
        assert world.stdout.readline() == "ready\n"
        driver = CanBaseDriver(url)
        driver.open()
        try:
            wait_state(driver, Lifecycle.READY)
            driver.activate()
            wait_state(driver, Lifecycle.ACTIVE)
            until(lambda: bool(driver.command(Twist(0.3, 0.0))) and moved(driver) > 0.05, 2.0)
            world.kill()
            wait_state(driver, Lifecycle.FAULT)
        finally:
            driver.close()
            world.kill()


def moved(driver: CanBaseDriver) -> float:
    reading = driver.read()
    return reading.odometry.x_m if reading else 0.0


def test_python_cans_own_bus_may_use_the_port(url: str, tmp_path: Path) -> None:
    with (
        EmulatedBase(url),
        can.Bus(
            interface="slcan", channel=f"{tmp_path}/robot.can", bitrate=250_000, sleep_after_open=0, ignore_config=True
        ) as bus,
    ):
        heard = {frame.arbitration_id for _ in range(60) if (frame := bus.recv(0.1))}
    assert {0x21, 0x29, 0x41, 0x49} <= heard


def test_the_port_vanishes_with_the_emulator_and_stale_links_are_replaced(url: str, tmp_path: Path) -> None:
    path = tmp_path / "robot.can"
    path.symlink_to("/dev/pts/does-not-exist")  # left by one that was killed
    with EmulatedBase(url):
        assert os.path.realpath(path).startswith("/dev/pts/")
        assert path.exists()
    assert not path.is_symlink()


def test_a_file_is_not_overwritten(url: str, tmp_path: Path) -> None:
    (tmp_path / "robot.can").write_text("somebody's data")
    with pytest.raises(DriverError, match="there is something else"):
        EmulatedBase(url)
    with pytest.raises(DriverError, match="no port can be made"):
        EmulatedBase(url.replace("robot.can", "no/such/folder/robot.can"))


@pytest.mark.slow
def test_an_adapter_that_is_not_read_drops_frames_and_the_emulator_continues(url: str) -> None:
    """An adapter whose computer has stopped reading drops frames; it does not stop the robot's firmware."""
    path = url.split("://")[1].split("?")[0]
    with EmulatedBase(url) as base:
        descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY)
        try:
            os.write(descriptor, b"C\rS5\rO\r")
            until(lambda: port_of(base).lost > 10, 6.0)
        finally:
            os.close(descriptor)


def port_of(base: EmulatedBase) -> AdapterPort:
    port = base._links[0].port
    assert isinstance(port, AdapterPort)
    return port
