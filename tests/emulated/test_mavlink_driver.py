"""The driver against the emulated rover, through real ports."""

from __future__ import annotations

import errno
import math
import termios
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Pose, Twist
from fullswarm.drivers.fleet import OneRobot
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.drivers.mavlink.protocol import Mode
from fullswarm.drivers.mavlink.session import Session
from fullswarm.emulators.mavlink.emulator import RoverEmulator
from fullswarm.errors import DriverError
from fullswarm.simulation.bodies import Body, FreeBody
from tests.emulated.rover_link import CLOCK, IN_THE_WORLD, PAUSE, active, free_port, ready
from tests.waiting import until


def hold(duration_s: float, each: Callable[[], object], never: Callable[[], bool] = lambda: False) -> None:
    """Call `each` at 50 Hz for a while; fail as soon as `never` holds."""
    end_s = CLOCK.now_s() + duration_s
    while CLOCK.now_s() < end_s:
        each()
        assert not never()
        PAUSE.wait(0.02)


ADDRESSES: dict[str, Callable[[], str]] = {"udp": lambda: f"udp://127.0.0.1:{free_port()}", "udpin": lambda: "udpin://127.0.0.1:0",
             "tcp": lambda: "tcp://127.0.0.1:0", "pty": lambda: "pty:"}  # fmt: skip


@contextmanager
def pair(address: str = "", body: Body | None = None) -> Iterator[tuple[MavlinkDriver, RoverEmulator]]:
    with RoverEmulator(address or ADDRESSES["udp"](), body) as emulator:
        driver = MavlinkDriver(f"{emulator.url}?{IN_THE_WORLD}")
        try:
            driver.open()
            yield driver, emulator
        finally:
            driver.close()


def last_speed(emulator: RoverEmulator) -> float:
    """Return the speed of the newest set-point; NaN before the first."""
    records = emulator.setpoints
    return records[-1].speed_m_s if records else math.nan


@pytest.mark.parametrize("kind", ["udp", "tcp"])
def test_drives_counter_clockwise_and_silence_is_zero(kind: str) -> None:
    with pair(ADDRESSES[kind](), FreeBody(Pose(2.0, -1.0, math.pi / 2))) as (driver, emulator):
        assert driver.state is Lifecycle.OPEN
        ready(driver)
        assert emulator.firmware.parameters["FS_GCS_ENABLE"] == 1.0
        hold(0.15, lambda: driver.command(Twist(0.5, 0.0)))  # not ACTIVE: nothing may go out
        assert emulator.setpoints == []
        driver.activate()
        twist, applied = Twist(0.5, 0.4), set()
        until(lambda: driver.state is Lifecycle.ACTIVE, each=lambda: driver.command(twist))
        assert (driver.fault, driver.firmware) == ("", "ArduRover 4.6.3")
        until(lambda: emulator.body.state().y_m > -0.9, each=lambda: applied.add(driver.command(twist)))
        assert applied == {twist}
        state, reading = emulator.body.state(), driver.read()
        assert state.heading_rad > math.pi / 2 + 0.03  # started north, turns to the west
        assert reading is not None
        assert reading.pose is not None
        assert reading.pose.x_m == pytest.approx(state.x_m, abs=0.1)
        assert reading.pose.y_m == pytest.approx(state.y_m, abs=0.1)
        assert reading.pose.heading_rad == pytest.approx(state.heading_rad, abs=0.15)
        assert reading.odometry.x_m > 0.05  # forward, whatever the heading at open was
        assert reading.odometry.heading_rad > 0.02
        assert (reading.twist.linear_m_s > 0.2, reading.twist.angular_rad_s > 0.2) == (True, True)
        assert reading.battery == 0.87
        silent_s = CLOCK.now_s()
        until(lambda: last_speed(emulator) == 0.0)
        assert 0.2 < emulator.setpoints[-1].at_s - silent_s < 0.7
        records = emulator.setpoints
        assert {(s.mask, s.frame) for s in records} == {(1511, 8)}
        assert all(record.armed and record.mode == Mode.GUIDED for record in records)
        assert records[0].speed_m_s == 0.0
        driver.close()
        assert str(driver.state) == "CLOSED"
        assert (emulator.firmware.armed, emulator.firmware.mode) == (False, Mode.HOLD)


@pytest.mark.parametrize("kind", ["udpin", "pty"])
def test_reaches_active_on_the_other_links(kind: str) -> None:
    with pair(ADDRESSES[kind]()) as (driver, emulator):
        active(driver)
        until(lambda: len(emulator.setpoints) > 2)


def test_a_stop_and_a_non_finite_set_point_go_out_at_once() -> None:
    with pair() as (driver, emulator):
        active(driver)
        for stop in (STAND, Twist(math.nan, 0.0)):
            until(lambda: last_speed(emulator) == 0.25, each=lambda: driver.command(Twist(0.25, 0.0)))
            if math.isfinite(stop.linear_m_s):
                driver.command(stop)
            else:
                with pytest.raises(ValueError, match="finite"):
                    driver.command(stop)
            until(lambda: last_speed(emulator) == 0.0, 0.25)


def test_a_pilot_who_takes_over_is_reported_and_not_fought() -> None:
    with pair() as (driver, emulator):
        active(driver)
        emulator.pilot_mode(Mode.MANUAL)
        until(lambda: driver.state is Lifecycle.READY, each=lambda: driver.command(Twist(0.5, 0.0)))
        assert "MANUAL" in driver.fault
        reading = driver.read()
        assert reading is not None
        assert reading.hazards & Hazard.ESTOP_BUTTON

        def insist() -> None:  # as an agent does whose behaviour is still on
            driver.activate()
            driver.command(Twist(0.5, 0.0))

        count = len(emulator.setpoints)
        hold(0.5, insist, never=lambda: emulator.firmware.mode != Mode.MANUAL or not emulator.firmware.armed)
        assert len(emulator.setpoints) == count


def test_a_refused_arm_leaves_ready_with_the_firmware_s_words() -> None:
    with pair() as (driver, emulator):
        ready(driver)
        emulator.firmware.refuse_arm = "Throttle (RC3) is not neutral and this text is longer than a chunk"
        driver.activate()
        until(lambda: driver.fault != "", each=lambda: driver.command(Twist(0.5, 0.0)))
        assert "Arm: Throttle (RC3) is not neutral and this text is longer than a chunk" in driver.fault
        assert driver.state is Lifecycle.READY
        assert emulator.setpoints == []


@pytest.mark.parametrize("kind", ["udp", "tcp"])
def test_killed_and_restarted_it_comes_back_ready_never_active(kind: str) -> None:
    address = f"{kind}://127.0.0.1:{free_port()}"
    seen: list[Lifecycle] = []
    with pair(address) as (driver, emulator):

        def drive() -> None:
            driver.command(Twist(0.5, 0.0))
            seen.append(driver.state)

        active(driver)
        emulator.close()
        until(lambda: driver.state is Lifecycle.FAULT, each=drive)
        assert driver.fault != ""
        assert driver.command(Twist(0.5, 0.0)) == STAND
        seen.clear()
        with RoverEmulator(address) as second:
            until(lambda: driver.state is Lifecycle.READY, each=drive)
            hold(0.1, drive)
            assert Lifecycle.ACTIVE not in seen
            assert driver.fault == ""
            assert second.setpoints == []


def test_another_system_id_is_not_ours_and_two_drivers_cannot_share_a_port() -> None:
    with RoverEmulator(ADDRESSES["udp"](), system=7) as emulator:
        driver = MavlinkDriver(emulator.url)
        try:
            driver.open()
            with pytest.raises(DriverError, match="another program"):
                MavlinkDriver(emulator.url).open()
            hold(0.4, lambda: driver.command(Twist(1.0, 0.0)), never=lambda: driver.state is not Lifecycle.OPEN)
            assert driver.read() is None
            assert emulator.firmware.parameters["FS_GCS_ENABLE"] == 0.0
        finally:
            driver.close()


def test_a_failing_link_thread_is_a_fault_and_stops_the_rover(monkeypatch: pytest.MonkeyPatch) -> None:
    with pair() as (driver, emulator):
        active(driver)
        until(lambda: last_speed(emulator) == 0.5, each=lambda: driver.command(Twist(0.5, 0.0)))

        def broken(*_: object) -> list[bytes]:
            raise RuntimeError("boom")

        monkeypatch.setattr(Session, "tick", broken)
        until(lambda: driver.state is Lifecycle.FAULT)
        assert "boom" in driver.fault
        until(lambda: emulator.firmware.mode == Mode.HOLD and not emulator.firmware.armed)
        assert last_speed(emulator) == 0.0


def test_a_port_that_vanishes_while_it_is_opened_again_is_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    with pair(ADDRESSES["pty"]()) as (driver, emulator):
        ready(driver)
        flush, failed = termios.tcflush, threading.Event()

        def vanish(descriptor: int, queue: int) -> None:
            if not failed.is_set():
                failed.set()
                raise termios.error(errno.EIO, "Input/output error")  # no OSError, and pyserial lets it pass
            flush(descriptor, queue)

        emulator.unplug()
        until(lambda: driver.state is Lifecycle.FAULT)
        monkeypatch.setattr(termios, "tcflush", vanish)
        emulator.replug()
        until(failed.is_set)
        ready(driver)


def test_an_e_stop_while_an_arm_is_to_be_tried_again_ends_disarmed() -> None:
    with pair() as (driver, emulator):
        ready(driver)
        fleet = OneRobot("r1", driver)

        def go() -> None:
            fleet.command(np.array([[0.5, 0.0]]), np.array([True]))

        emulator.firmware.refuse_arm = "GPS 1: Bad fix"
        until(lambda: driver.fault != "", each=go)
        go()
        emulator.firmware.refuse_arm = ""
        stop, off = np.zeros((1, 2)), np.array([False])
        hold(2.5, lambda: fleet.command(stop, off), never=lambda: emulator.firmware.armed)
        assert driver.state is Lifecycle.READY


def test_open_says_what_is_wrong() -> None:
    port = free_port()
    with pytest.raises(DriverError, match="no program listens there"):
        MavlinkDriver(f"mavlink+tcp://127.0.0.1:{port}").open()
    with pytest.raises(DriverError, match="plug the robot in"):
        MavlinkDriver("mavlink+serial:///dev/no-such-rover").open()
    driver = MavlinkDriver("mavlink+tcp://127.0.0.1:1")
    assert driver.state is Lifecycle.CLOSED
    assert driver.command(Twist(1.0, 0.0)) == STAND
    with pytest.raises(ValueError, match="finite"):
        driver.command(Twist(math.inf, 0.0))
    driver.close()
