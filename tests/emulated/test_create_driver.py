"""The Create driver and its emulator through a real pseudo-terminal; ports and URLs."""

from __future__ import annotations

import errno
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import serial

from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Pose, Twist
from fullswarm.drivers.create_oi import protocol
from fullswarm.drivers.create_oi.driver import CreateDriver
from fullswarm.drivers.create_oi.protocol import CREATE1, CREATE2, Generation, Mode
from fullswarm.drivers.create_oi.settings import parse_url
from fullswarm.drivers.fleet import OneRobot
from fullswarm.emulators.create_oi import shows
from fullswarm.emulators.create_oi.emulator import CreateEmulator
from fullswarm.errors import ConfigError, DriverError
from fullswarm.simulation.bodies import BodyState, FreeBody, wheels_rolled
from tests.waiting import until

GO = Twist(0.3, 0.5)


def close_to(told: Pose, true: BodyState, way_m: float) -> bool:
    off_m = math.hypot(told.x_m - true.x_m, told.y_m - true.y_m)
    return off_m < 0.01 * way_m and abs(math.remainder(told.heading_rad - true.heading_rad, math.tau)) < 0.02


class Rig:
    """An emulator and a driver that is open on it."""

    def __init__(self, generation: Generation = CREATE2, encoders: tuple[int, int] = (0, 0)) -> None:
        self.body = FreeBody()
        self.robot = CreateEmulator(generation, self.body, encoders=encoders).start()
        self.driver = CreateDriver(self.robot.url)

    def reach(self, state: Lifecycle) -> None:
        until(lambda: self.driver.state is state)

    def start(self) -> Rig:
        self.driver.open()
        self.reach(Lifecycle.READY)
        self.driver.activate()
        self.reach(Lifecycle.ACTIVE)
        return self

    def drive(self, twist: Twist, enough: Callable[[], bool]) -> None:
        until(lambda: self.driver.command(twist) != STAND and enough())

    def still(self) -> bool:
        state = self.body.state()
        return state.speed_m_s == 0.0 and state.turn_rad_s == 0.0

    @property
    def wheels(self) -> tuple[float, float]:
        """Left and right wheel, m/s."""
        state, half = self.body.state(), self.robot.generation.wheel_base_m / 2.0
        left, right = state.speed_m_s - half * state.turn_rad_s, state.speed_m_s + half * state.turn_rad_s
        return round(left, 9), round(right, 9)

    @property
    def rolled_m(self) -> float:
        """How far the left wheel has rolled."""
        return wheels_rolled(self.body.state(), self.robot.generation.wheel_base_m)[0]


@contextmanager
def plugged(generation: Generation = CREATE2, encoders: tuple[int, int] = (0, 0)) -> Iterator[Rig]:
    rig = Rig(generation, encoders)
    try:
        yield rig
    finally:
        rig.driver.close()
        rig.robot.close()


def test_pty_a_create1_forwards_and_backwards() -> None:
    with plugged(CREATE1) as rig:
        rig.start()
        driver, body = rig.driver, rig.body
        rig.drive(Twist(0.5, 0.3), lambda: rig.rolled_m > 0.2)
        rig.drive(Twist(-0.5, 0.0), lambda: rig.rolled_m < -0.2)
        driver.deactivate()
        until(rig.still)
        stopped_s = time.monotonic()
        until(lambda: (reading := driver.read()) is not None and reading.stamp_s > stopped_s + 0.05)
        reading = driver.read()
        assert reading is not None
        assert close_to(reading.odometry, body.state(), 0.6)
        assert reading.battery == pytest.approx(2200 / 2696)


def test_pty_lamps_and_songs_reach_the_robot_and_no_stop_waits_for_them() -> None:
    tune = [(60.0 + number, 0.1) for number in range(16)]
    with plugged() as rig:
        rig.start()
        fleet, panel = OneRobot("r1", rig.driver), rig.robot.firmware.panel
        for name, value in (("led_check", True), ("power_light", 1.0), ("display", "go"), ("song", tune)):
            fleet.actuate(0, name, value)
        until(lambda: rig.driver.command(STAND) == STAND and panel.played == [0] and panel.digits == "GO  ")
        assert (panel.led_bits, panel.power_intensity) == (0b1000, 255)
        assert list(panel.songs[0][::2]) == [pitch for pitch, _ in tune]
        assert shows(rig.robot).startswith("lamps 3, power lamp 100% (0% red); display 'GO'; song 1 (60:0.09s")
        with pytest.raises(ValueError, match="'display' takes up to 4 printable ASCII characters"):
            fleet.actuate(0, "display", "too long")
        rig.drive(Twist(0.3, 0.0), lambda: rig.wheels == (0.3, 0.3))
        for number in range(2000):
            fleet.actuate(0, "power_colour", (number % 256) / 255.0)
            fleet.actuate(0, "song", [(31.0 + number % 90, 0.1)] * 16)
        began_s = time.monotonic()
        fleet.command(np.zeros((1, 2)), np.ones(1, bool))
        until(rig.still)
        assert time.monotonic() - began_s < 0.1


def test_pty_commands_are_limited_rounded_and_told() -> None:
    with plugged() as rig:
        assert rig.driver.command(GO) == STAND  # closed
        rig.start()
        applied = rig.driver.command(Twist(0.5, 2.0))
        until(lambda: rig.wheels[1] == 0.5)
        left, right = rig.wheels
        assert applied.linear_m_s == pytest.approx((left + right) / 2)
        assert applied.angular_rad_s == pytest.approx((right - left) / 0.235)
        assert applied.angular_rad_s / applied.linear_m_s == pytest.approx(4.0, rel=0.01)
        with pytest.raises(ValueError, match="must be finite"):
            rig.driver.command(Twist(math.nan, 0.0))
        until(rig.still)


def test_pty_wheels_stop_when_commands_cease() -> None:
    with plugged() as rig:
        rig.start()
        rig.drive(GO, lambda: not rig.still())
        last_s = time.monotonic()
        until(rig.still)
        assert 0.2 < time.monotonic() - last_s < 1.0
        assert rig.driver.state is Lifecycle.ACTIVE


def test_pty_cliff_stops_and_makes_ready() -> None:
    with plugged() as rig:
        rig.start()
        rig.drive(GO, lambda: not rig.still())
        rig.robot.set_cliff(front_left=True)
        rig.reach(Lifecycle.READY)
        assert rig.still()
        reading = rig.driver.read()
        assert reading is not None
        assert Hazard.CLIFF in reading.hazards
        rig.driver.activate()
        assert "cliff" in rig.driver.blocked
        assert rig.driver.state is Lifecycle.READY


def test_pty_a_robot_on_its_charger_tells_its_agent_why_it_stands() -> None:
    with plugged() as rig:
        rig.robot.set_charger(True)
        fleet = OneRobot("r1", rig.driver)
        fleet.open()
        rig.reach(Lifecycle.READY)
        assert fleet.fault(0) == ""
        ask = np.array([[0.3, 0.0]]), np.array([True])
        until(lambda: not fleet.command(*ask).any() and "charger is plugged in" in fleet.fault(0))
        assert fleet.lifecycle(0) is Lifecycle.READY
        assert rig.robot.port in fleet.fault(0)
        rig.robot.set_charger(False)
        until(lambda: bool(fleet.command(*ask).any()))
        assert fleet.fault(0) == ""


def test_pty_unplugged_is_a_fault_and_comes_back_ready() -> None:
    with plugged() as rig:
        rig.start()
        rig.drive(GO, lambda: not rig.still())
        rig.robot.unplug()
        rig.reach(Lifecycle.FAULT)
        assert "port" in rig.driver.fault
        assert rig.robot.port in rig.driver.fault
        assert rig.driver.command(GO) == STAND
        assert not rig.still()  # nobody can reach it: the Open Interface has no timeout
        rig.robot.replug()
        rig.reach(Lifecycle.READY)
        assert rig.still()
        assert rig.robot.mode is Mode.PASSIVE
        assert rig.driver.fault == ""
        rig.driver.activate()
        rig.reach(Lifecycle.ACTIVE)


def test_pty_a_stuck_stream_is_silence() -> None:
    with plugged() as rig:
        rig.start()
        rig.drive(GO, lambda: not rig.still())
        rig.robot.mute(True)
        rig.reach(Lifecycle.FAULT)
        assert "silent" in rig.driver.fault
        until(rig.still)
        rig.robot.mute(False)
        rig.reach(Lifecycle.READY)


def test_pty_closing_leaves_the_robot_passive_and_open_starts_anew() -> None:
    with plugged() as rig:
        rig.start()
        rig.drive(GO, lambda: rig.rolled_m > 0.02)
        rig.driver.close()
        assert rig.driver.state is Lifecycle.CLOSED
        until(lambda: rig.robot.mode is Mode.PASSIVE)
        assert rig.still()
        rig.driver.close()
        rig.driver.open()
        rig.driver.open()
        rig.reach(Lifecycle.READY)
        reading = rig.driver.read()
        assert reading is not None
        assert reading.odometry == Pose(0.0, 0.0, 0.0)


def test_pty_one_port_serves_one_driver() -> None:
    with plugged() as rig:
        rig.driver.open()
        second = CreateDriver(rig.robot.url)
        with pytest.raises(DriverError, match=f"held by .*pid {os.getpid()}"):
            second.open()
        assert second.state is Lifecycle.CLOSED
        rig.reach(Lifecycle.READY)


def test_pty_at_a_wrong_rate_there_is_noise_and_no_robot() -> None:
    with plugged() as rig:
        noise = bytearray()
        rig.driver = CreateDriver(
            rig.robot.url + "&baud=57600", log=lambda way, data: noise.extend(data if way == "<" else b"")
        )
        rig.driver.open()
        until(lambda: len(noise) > 20)
        assert rig.driver.state is Lifecycle.OPEN
        assert rig.robot.mode is Mode.OFF


CRASH = """
import sys, time
from fullswarm.drivers.base import Lifecycle, Twist
from fullswarm.drivers.create_oi.driver import CreateDriver
driver = CreateDriver(sys.argv[1])
driver.open()
end = time.monotonic() + 5
while driver.command(Twist(0.3, 0.0)) == Twist() and time.monotonic() < end:
    driver.activate()
    time.sleep(0.005)
time.sleep(0.1)
raise SystemExit(7)
"""


def test_pty_a_program_that_ends_without_closing_stops_its_robot() -> None:
    with plugged() as rig:
        ended = subprocess.run([sys.executable, "-c", CRASH, rig.robot.url], check=False, timeout=20)
        assert ended.returncode == 7
        until(rig.still)
        assert rig.robot.mode is Mode.PASSIVE
        assert rig.rolled_m > 0.01


def test_pty_every_byte_can_be_logged() -> None:
    with plugged() as rig:
        seen: dict[str, bytearray] = {"<": bytearray(), ">": bytearray()}
        rig.driver = CreateDriver(rig.robot.url, log=lambda way, data: seen[way].extend(data))
        rig.start()
        assert bytes(seen[">"]).startswith(protocol.drive_direct(0, 0) + b"\x80\x94")
        assert seen["<"][0] == 19


# ================================================================ ports and URLs
def test_a_missing_port_says_so(tmp_path: Path) -> None:
    driver = CreateDriver(f"create://{tmp_path}/none")
    with pytest.raises(DriverError, match="no such port"):
        driver.open()
    assert driver.state is Lifecycle.CLOSED
    assert driver.read() is None
    driver.close()


def test_a_file_is_no_port(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(DriverError, match="not a serial port"):
        CreateDriver(f"create://{tmp_path}/file").open()


def test_a_forbidden_port_says_which_group_to_join(monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*_: object, **__: object) -> None:
        raise serial.SerialException(errno.EACCES, "could not open port")

    monkeypatch.setattr(serial, "Serial", forbidden)  # root, as in a container, may open everything
    with pytest.raises(DriverError, match="dialout"):
        CreateDriver("create:///dev/ttyUSB0").open()


def test_urls() -> None:
    assert parse_url("create:///dev/ttyUSB0?model=create1").generation is CREATE1
    assert parse_url("create:///dev/ttyUSB0").baud == 115200
    assert parse_url("create:///dev/ttyUSB0?speed_step=28.5").speed_step_mm_s == 28.5
    assert CreateDriver("create:///dev/ttyUSB0").description.limits.speed_m_s == 0.5
    for url, part in (
        ("create://dev/ttyUSB0", "serial port"),
        ("create:///dev/ttyUSB0?modle=create2", "did you mean 'model'"),
        ("create:///dev/ttyUSB0?model=creat2", "did you mean 'create2'"),
        ("create:///dev/ttyUSB0?baud=9600", "115200"),
        ("create:///dev/ttyUSB0?mode_offset=2", "0, 1"),
        ("create:///dev/ttyUSB0?speed_step=nan", "28.5"),
        ("create:///dev/ttyUSB0?speed_step=500", "28.5"),
        ("create:///dev/ttyUSB0?speed_step=fast", "28.5"),
    ):
        with pytest.raises(ConfigError, match=part):
            CreateDriver(url)
