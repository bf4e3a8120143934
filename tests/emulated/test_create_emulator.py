"""The emulated Create's port: its path, its pace, all that can go wrong with a cable, and what the driver says."""

from __future__ import annotations

import math
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import serial

from fullswarm.drivers.base import STAND, Lifecycle, Twist
from fullswarm.drivers.create_oi import protocol
from fullswarm.drivers.create_oi.driver import CreateDriver
from fullswarm.drivers.create_oi.protocol import CREATE2, Mode, Op, StreamParser
from fullswarm.emulators.create_oi.emulator import CreateEmulator
from fullswarm.errors import DriverError
from tests.waiting import until

GO = Twist(0.3, 0.5)


@contextmanager
def driving() -> Iterator[tuple[CreateEmulator, CreateDriver]]:
    """A robot that drives at the hand of its driver."""
    with CreateEmulator() as robot:
        driver = CreateDriver(robot.url)
        driver.open()
        try:
            activate(driver)
            until(lambda: driver.command(GO) != STAND and moves(robot))
            yield robot, driver
        finally:
            driver.close()


def activate(driver: CreateDriver) -> None:
    until(lambda: driver.state is Lifecycle.READY)
    driver.activate()
    until(lambda: driver.state is Lifecycle.ACTIVE)


def moves(robot: CreateEmulator) -> bool:
    state = robot.body.state()
    return state.speed_m_s != 0.0 or state.turn_rad_s != 0.0


@contextmanager
def client(robot: CreateEmulator, baud: int = 115200) -> Iterator[serial.Serial]:
    with serial.Serial(robot.port, baud, timeout=1.0) as port:
        yield port


# ---------------------------------------------------------------- the cable
def test_unplugged_in_mid_drive_is_a_fault_and_replugged_is_ready_within_two_seconds() -> None:
    with driving() as (robot, driver):
        robot.unplug()
        assert until(lambda: driver.state is Lifecycle.FAULT) < 1.0
        assert "plug it in again" in driver.fault
        assert driver.command(GO) == STAND
        until(lambda: "no such port" in driver.fault)
        robot.replug()
        assert until(lambda: driver.state is Lifecycle.READY) < 2.0
        assert not moves(robot)
        for _ in range(20):
            assert driver.command(GO) == STAND
            time.sleep(0.005)
        assert not moves(robot)
        activate(driver)
        until(lambda: driver.command(GO) != STAND and moves(robot))


def test_a_reboot_is_a_fault_and_then_ready_with_the_version_known() -> None:
    with driving() as (robot, driver):
        assert driver.firmware == "Open Interface, Create 2"
        robot.reboot()
        assert not moves(robot)
        until(lambda: driver.state is Lifecycle.FAULT)
        until(lambda: driver.state is Lifecycle.READY)
        assert driver.firmware == "Open Interface, Create 2, firmware 3.5.4"
        assert robot.mode is Mode.PASSIVE


def test_a_bad_link_is_driven_over() -> None:
    with driving() as (robot, driver):
        robot.faults.drop = robot.faults.corrupt = 0.1
        robot.faults.delay_s = 0.03
        began_s = time.monotonic()
        until(lambda: driver.command(GO) == STAND or time.monotonic() - began_s > 1.0)
        assert driver.state is Lifecycle.ACTIVE
        reading = driver.read()
        assert reading is not None
        assert reading.odometry.x_m > 0.05
        until(lambda: not moves(robot))  # silence is heard of through a bad link as well


def test_garbage_and_a_cut_frame_cost_a_frame_and_no_more() -> None:
    with driving() as (robot, driver):
        reading = driver.read()
        assert reading is not None
        for _ in range(10):
            robot.garbage(os.urandom(40))
            robot.cut()
            driver.command(GO)
            time.sleep(0.05)
        assert driver.state is Lifecycle.ACTIVE
        newer = driver.read()
        assert newer is not None
        assert newer.stamp_s > reading.stamp_s
        true = robot.body.state()
        assert math.hypot(newer.odometry.x_m - true.x_m, newer.odometry.y_m - true.y_m) < 0.05


def test_a_low_battery_and_a_hanging_wheel_are_told() -> None:
    with driving() as (robot, driver):
        robot.set_battery(0.05)
        until(lambda: (reading := driver.read()) is not None and reading.battery == pytest.approx(0.05, abs=0.001))
        robot.set_wheel_drop(left=True)
        until(lambda: driver.state is Lifecycle.READY)
        assert driver.blocked == "the robot stopped itself: a wheel hangs"


# ---------------------------------------------------------------- what only a Create can
def test_it_sings_lights_up_and_shows() -> None:
    with driving() as (robot, driver):
        assert driver.sing([(60, 0.1), (0, 0.05), (67, 0.1)]) == pytest.approx(0.25, abs=0.03)
        driver.set_lamps(3, colour=255)
        driver.show("go")
        panel = robot.firmware.panel
        until(lambda: panel.digits == "GO  ")
        assert (panel.led_bits, panel.power_colour, panel.played) == (3, 255, [0])
        with pytest.raises(ValueError, match="characters"):
            driver.show("too long")
        driver.deactivate()
        with pytest.raises(DriverError, match="cannot show a text while READY"):
            driver.show("no")


def test_a_create1_has_no_digits() -> None:
    with pytest.raises(DriverError, match="no digits"):
        CreateDriver("create:///dev/ttyUSB0?model=create1").show("1")


def test_it_docks() -> None:
    with driving() as (robot, driver):
        driver.dock()
        assert driver.docking
        until(lambda: driver.command(STAND) == STAND and robot.mode is Mode.PASSIVE and moves(robot))
        robot.set_dock(True)
        until(lambda: driver.command(STAND) == STAND and driver.state is Lifecycle.READY)
        power = driver.power
        assert power is not None
        assert power.on_dock


@pytest.mark.slow
def test_brc_wakes_it_through_the_driver() -> None:
    with CreateEmulator() as robot:
        with client(robot) as port:
            port.write(protocol.simple(Op.START) + protocol.simple(Op.POWER))
            until(lambda: robot.firmware.asleep)
        driver = CreateDriver(robot.url, brc=robot.brc)
        driver.open()
        try:
            until(lambda: driver.state is Lifecycle.READY)
            assert driver.firmware.endswith("3.5.4")
        finally:
            driver.close()


# ---------------------------------------------------------------- the port
def test_a_path_of_ones_own_is_claimed_and_left_clean(tmp_path: Path) -> None:
    path = tmp_path / "robot"
    with CreateEmulator(port=str(path)) as robot:
        assert robot.port == str(path)
        assert path.is_symlink()
        with pytest.raises(DriverError, match="another emulator"):
            CreateEmulator(port=str(path))
        with client(robot) as port:
            port.write(protocol.simple(Op.START) + protocol.query(35))
            assert port.read(1) == b"\x01"
    assert list(tmp_path.iterdir()) == []


KILLED = """
import os, sys
from fullswarm.emulators.create_oi.emulator import CreateEmulator
CreateEmulator(port=sys.argv[1]).start()
os._exit(9)
"""


def test_the_path_of_an_emulator_that_was_killed_is_free(tmp_path: Path) -> None:
    path = tmp_path / "robot"
    subprocess.run([sys.executable, "-c", KILLED, str(path)], check=False, timeout=20)
    assert path.is_symlink()
    with CreateEmulator(port=str(path)) as robot, client(robot) as port:
        port.write(protocol.simple(Op.START) + protocol.query(35))
        assert port.read(1) == b"\x01"


def test_a_path_that_is_taken_or_nowhere_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(DriverError, match="something else"):
        CreateEmulator(port=str(tmp_path / "file"))
    (tmp_path / "device").symlink_to("/dev/null")
    with pytest.raises(DriverError, match="something else"):
        CreateEmulator(port=str(tmp_path / "device"))
    assert (tmp_path / "device").is_symlink()
    with pytest.raises(DriverError, match="folder"):
        CreateEmulator(port=str(tmp_path / "none" / "robot"))


def test_a_second_start_and_a_close_before_any_are_fine() -> None:
    CreateEmulator().close()
    with CreateEmulator() as robot:
        robot.start()
        robot.replug()
        assert Path(robot.port).is_symlink()
        robot.close()
        assert not Path(robot.port).is_symlink()


def test_bytes_take_their_time_on_the_wire() -> None:
    with CreateEmulator() as robot, client(robot) as port:
        port.write(protocol.simple(Op.START))
        until(lambda: robot.mode is Mode.PASSIVE)
        began_s = time.monotonic()
        port.write(protocol.query_list([100] * 20))  # 1600 bytes at 11520 a second
        assert len(port.read(1600)) == 1600
        assert time.monotonic() - began_s > 0.138


def test_the_robot_changes_its_rate_and_is_noise_to_the_old_one() -> None:
    with CreateEmulator() as robot, client(robot) as port:
        port.write(protocol.simple(Op.START) + protocol.stream([35]) + protocol.baud(19200))
        time.sleep(0.1)
        port.reset_input_buffer()
        assert not StreamParser([35]).feed(port.read(60))
        port.baudrate = 19200
        parser = StreamParser([35])
        until(lambda: bool(parser.feed(port.read(6))))


def test_a_reader_who_is_late_loses_what_follows() -> None:
    with CreateEmulator() as robot, client(robot) as port:
        port.write(protocol.simple(Op.START))
        for _ in range(12):  # 9600 bytes: 0.83 s on the wire
            port.write(protocol.query(100) * 10)
            time.sleep(0.075)
        time.sleep(0.2)
        assert len(port.read(port.in_waiting)) == 4000
        port.write(protocol.query(35))
        assert port.read(1) == b"\x01"


def test_asking_for_more_than_a_period_holds_corrupts_the_stream() -> None:
    with CreateEmulator() as robot, client(robot) as port:
        ids = [100, 100]
        assert protocol.frame_size(ids) < CREATE2.budget(115200)
        port.write(protocol.simple(Op.START) + protocol.stream(ids))
        parser = StreamParser(ids)
        until(lambda: bool(parser.feed(port.read(80))))
        port.write(protocol.stream([100, 100, 46, 47, 48, 49]))
        time.sleep(0.1)
        port.reset_input_buffer()
        assert not StreamParser([100, 100, 46, 47, 48, 49]).feed(port.read(700))
