"""The driver against the emulated controllers on buses of python-can: one process, multicast."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable, Iterator

import can
import pytest
from can.interfaces.virtual import VirtualBus

from fullswarm.drivers.base import STAND, Driver, Lifecycle, Twist
from fullswarm.drivers.can.driver import CanBaseDriver
from fullswarm.drivers.can.port import CanPort
from fullswarm.errors import DriverError
from tests.emulated.can_robot import GROUP, ODRIVE, Robot, channel, multicast, wait_state
from tests.waiting import until


@pytest.fixture
def make_robot() -> Iterator[Callable[[str], Robot]]:
    """Return what opens a driver against its emulated base; both are closed at the end."""
    with contextlib.ExitStack() as stack:

        def make(url: str) -> Robot:
            robot = Robot(url)
            stack.enter_context(robot.emulated)
            stack.callback(robot.driver.close)
            robot.driver.open()
            return robot

        yield make


@pytest.fixture
def robot(make_robot: Callable[[str], Robot]) -> Robot:
    """Return an ODrive base on a bus of its own within this process."""
    return make_robot(f"can+odrive://{channel()}?interface=virtual&{ODRIVE}")


def there_and_back(robot: Robot) -> None:
    """Drive forwards and backwards; the odometry must agree with the body within 1 %."""
    for sign in (1.0, -1.0):
        before_m, began_m = robot.reading().odometry.x_m, robot.emulated.body.state().rolled_m
        goal_m = before_m + sign * 0.15
        applied = robot.drive(Twist(0.4 * sign, 0.0), robot.beyond(goal_m, sign))
        assert applied.linear_m_s == pytest.approx(0.4 * sign, rel=1e-3)
        assert robot.reading().twist.linear_m_s == pytest.approx(0.4 * sign, rel=0.1)
        robot.drive(STAND, lambda: robot.speed() < 0.002 and abs(robot.reading().twist.linear_m_s) < 0.002)
        true_m = robot.emulated.body.state().rolled_m - began_m
        assert true_m * sign > 0.15
        near = pytest.approx(true_m, rel=0.01)
        until(lambda: robot.reading().odometry.x_m - before_m == near, 1.0)  # noqa: B023  (called at once)


def test_a_life(make_robot: Callable[[str], Robot]) -> None:
    robot = make_robot(f"can+odrive://{multicast()}&{ODRIVE}")
    contract: Driver = robot.driver
    assert contract.state is Lifecycle.OPEN
    wait_state(robot.driver, Lifecycle.READY, 1.5)
    assert robot.driver.command(Twist(0.3, 0.0)) == STAND
    assert robot.idle()
    robot.driver.activate()
    wait_state(robot.driver, Lifecycle.ACTIVE, 1.0)
    assert (robot.idle(), robot.speed()) == (False, 0.0)
    assert robot.driver.firmware == "ODrive 0.6.10"
    there_and_back(robot)
    robot.drive(Twist(0.3, 0.0), lambda: robot.speed() > 0.25)
    assert until(lambda: robot.speed() < 0.01, 1.5) > 0.2  # silence is a stop
    assert robot.driver.state is Lifecycle.ACTIVE
    robot.drive(Twist(0.3, 0.0), lambda: robot.speed() > 0.25)
    robot.odrives[1].inject("CURRENT_LIMIT_VIOLATION")
    robot.drive(Twist(0.3, 0.0), lambda: robot.driver.state is Lifecycle.FAULT, 1.0)
    assert "right wheel (node 2) reports CURRENT_LIMIT_VIOLATION" in robot.driver.fault
    until(robot.idle, 0.3)
    assert robot.driver.malformed == 0


def test_close_goes_over_zero_to_idle(robot: Robot) -> None:
    robot.moving()
    robot.driver.close()
    assert str(robot.driver.state) == "CLOSED"
    until(lambda: robot.idle() and robot.speed() < 0.05, 0.3)
    robot.driver.close()
    robot.driver.open()  # and again, from zero
    until(lambda: robot.driver.read() is not None, 1.0)
    assert robot.reading().odometry.x_m == pytest.approx(0.0, abs=0.02)


def test_bus_off_is_a_fault_and_ends_ready(robot: Robot) -> None:
    robot.moving()
    bus = port_of(robot.driver)._bus
    assert isinstance(bus, VirtualBus)
    bus.queue.put(can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False))
    wait_state(robot.driver, Lifecycle.FAULT)
    assert "bus-off" in robot.driver.fault
    until(robot.idle, 1.5)
    assert wait_state(robot.driver, Lifecycle.READY) < 2.0
    assert robot.idle()


def test_a_stray_datagram_is_counted_and_ignored(make_robot: Callable[[str], Robot]) -> None:
    bus = multicast()
    robot = make_robot(f"can+odrive://{bus}&{ODRIVE}")
    robot.activate()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        stranger.sendto(b"not a frame", (GROUP, int(bus.rpartition("=")[2])))
    until(lambda: port_of(robot.driver).dropped == 1, 1.0)
    assert robot.driver.state is Lifecycle.ACTIVE


def port_of(driver: CanBaseDriver) -> CanPort:
    assert isinstance(driver._port, CanPort)
    return driver._port


def test_a_missing_adapter_is_said_by_open() -> None:
    driver = CanBaseDriver(f"can+odrive:///dev/no-such-adapter?interface=slcan&{ODRIVE}")
    with pytest.raises(DriverError, match="no-such-adapter"):
        driver.open()
    assert driver.state is Lifecycle.CLOSED
    driver.close()


def test_an_emulator_that_ends_leaves_no_body_moving(robot: Robot) -> None:
    robot.moving()
    robot.emulated.close()
    assert robot.standing()
    wait_state(robot.driver, Lifecycle.FAULT)


def test_what_cannot_be_watched_is_said_at_open(capsys: pytest.CaptureFixture[str]) -> None:
    driver = CanBaseDriver(f"can+odrive://{channel()}?interface=virtual&{ODRIVE.replace('&watchdog=0.5', '')}")
    assert driver.description.watchdog_s is None
    driver.open()
    driver.close()
    assert "no CANSimple message switches it on" in driver.warning
    assert "no device watchdog" in capsys.readouterr().out
