"""The driver against the emulated PX4 rover, through real ports. The published check runs in test_conformance.py."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from fullswarm.drivers.base import STAND, Lifecycle, Pose, Twist
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.drivers.mavlink.px4 import HOLD, OFFBOARD
from fullswarm.drivers.mavlink.signing import Signing, Timestamps
from fullswarm.emulators.mavlink.emulator import Px4Emulator
from fullswarm.errors import ConfigError
from fullswarm.simulation.bodies import FreeBody
from tests.emulated.rover_link import CLOCK, IN_THE_WORLD, active, free_port
from tests.waiting import until

KEY, OTHER = bytes(range(32)), bytes(32)


@contextmanager
def pair(
    address: str, options: str = f"autopilot=px4&{IN_THE_WORLD}", signing: Signing | None = None
) -> Iterator[tuple[MavlinkDriver, Px4Emulator]]:
    with Px4Emulator(address, FreeBody(Pose(2.0, -1.0, 2.5)), signing=signing) as emulator:
        driver = MavlinkDriver(f"{emulator.url}?{options}")
        try:
            driver.open()
            yield driver, emulator
        finally:
            driver.close()


def test_drives_where_it_says_and_is_left_holding() -> None:
    with pair("pty:") as (driver, emulator):
        active(driver)
        assert (driver.fault, driver.firmware) == ("", "PX4 1.16.0")
        until(lambda: emulator.body.state().rolled_m > 0.2, each=lambda: driver.command(Twist(0.5, 0.2)))
        state, reading = emulator.body.state(), driver.read()
        assert state.heading_rad > 2.5
        assert reading is not None
        assert reading.pose is not None
        assert reading.pose.x_m == pytest.approx(state.x_m, abs=0.1)
        assert reading.odometry.x_m > 0.1
        assert reading.battery == 0.87
        driver.close()
        assert (emulator.firmware.mode, emulator.firmware.armed) == (HOLD, False)


def test_unplugged_it_stops_by_itself_and_comes_back_ready() -> None:
    with pair(f"udp://127.0.0.1:{free_port()}") as (driver, emulator):
        active(driver)
        until(lambda: emulator.body.state().speed_m_s > 0.4, each=lambda: driver.command(Twist(0.5, 0.0)))
        emulator.unplug()
        cut_s = CLOCK.now_s()
        until(lambda: driver.state is Lifecycle.FAULT, each=lambda: driver.command(Twist(0.5, 0.0)))
        assert driver.fault
        assert driver.command(Twist(0.5, 0.0)) == STAND
        until(lambda: emulator.body.state().speed_m_s == 0.0, 2.5)
        assert CLOCK.now_s() - cut_s < 2.5
        emulator.replug()
        back_s, seen = CLOCK.now_s(), set()
        until(lambda: driver.state is Lifecycle.READY, each=lambda: seen.add(driver.state))
        assert CLOCK.now_s() - back_s < 2.0
        assert Lifecycle.ACTIVE not in seen
        assert not emulator.firmware.armed


def test_an_interpreter_that_ends_without_close_leaves_it_holding_and_disarmed() -> None:
    code = """
import sys, threading
from fullswarm.drivers.base import Twist
from fullswarm.drivers.mavlink.driver import MavlinkDriver
driver, pause = MavlinkDriver(sys.argv[1]), threading.Event()
driver.open()
while driver.state != "ACTIVE":
    driver.activate()
    pause.wait(0.02)
for _ in range(25):
    driver.command(Twist(0.5, 0.0))
    pause.wait(0.02)
"""
    with Px4Emulator(f"udp://127.0.0.1:{free_port()}") as emulator:
        subprocess.run([sys.executable, "-c", code, f"{emulator.url}?autopilot=px4"], check=True, timeout=20)
        assert emulator.body.state().rolled_m > 0.05
        assert (emulator.firmware.mode, emulator.firmware.armed) == (HOLD, False)


# ---------------------------------------------------------------- signing, over a real port
def key_file(folder: Path, key: bytes = KEY) -> Path:
    path = folder / "rover.key"
    path.write_text(key.hex())
    path.chmod(0o600)
    return path


def test_signed_both_ways_and_again_after_a_restart(tmp_path: Path) -> None:
    options = f"sign_key={key_file(tmp_path)}&sign_state={tmp_path / 'state'}&sign_link=3"
    with pair("tcp://127.0.0.1:0", options, Signing(KEY, Timestamps(None))) as (driver, emulator):
        active(driver)
        until(lambda: emulator.firmware.mode == OFFBOARD)
        before = int((tmp_path / "state").read_text())
        driver.close()
        driver.open()  # another run, the same vehicle: it has seen our timestamps
        until(lambda: driver.state is Lifecycle.READY)
        assert int((tmp_path / "state").read_text()) >= before


def test_another_key_is_told_from_a_dead_line(tmp_path: Path) -> None:
    options = f"sign_key={key_file(tmp_path)}&sign_state={tmp_path / 'state'}"
    with pair(f"udp://127.0.0.1:{free_port()}", options, Signing(OTHER, Timestamps(None))) as (driver, _):
        until(lambda: driver.state is Lifecycle.FAULT)
        assert "it is received, but it signs with another key than ours" in driver.fault
        assert driver.read() is None


def test_a_key_that_others_may_read_is_refused(tmp_path: Path) -> None:
    path = key_file(tmp_path)
    path.chmod(0o644)
    with pytest.raises(ConfigError, match="others may read"):
        MavlinkDriver(f"mavlink+tcp://127.0.0.1:5760?sign_key={path}").open()
