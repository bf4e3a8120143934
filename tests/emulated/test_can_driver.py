"""The driver against the emulated controllers on python-can buses: one process, multicast, a serial adapter."""

from __future__ import annotations

import contextlib
import itertools
import os
import select
import socket
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path

import can
import pytest
from can.interfaces.virtual import VirtualBus

from fullswarm.drivers.base import STAND, Driver, Lifecycle, Reading, Twist
from fullswarm.drivers.can.driver import CanBaseDriver
from fullswarm.drivers.can.emulator import EmulatedBase, ODriveEmulator
from fullswarm.drivers.can.odrive import AxisState
from fullswarm.drivers.can.port import CanPort
from fullswarm.errors import DriverError

GROUP = "239.74.163.2"
ODRIVE = "left=1&right=2&right_sign=-1&wheel_radius=0.05&base=0.3&watchdog=0.5"
VESC = "left=1&right=2&right_sign=-1&wheel_radius=0.05&base=0.3&gear=10&pole_pairs=7"
_channels = itertools.count()


def wait(condition: Callable[[], bool], limit_s: float, what: Callable[[], str] = str) -> float:
    """Wait until `condition`; return how long it took."""
    start_s = time.monotonic()
    while not condition():
        assert time.monotonic() - start_s < limit_s, what()
        time.sleep(0.002)
    return time.monotonic() - start_s


def wait_state(driver: CanBaseDriver, state: Lifecycle, limit_s: float = 4.0) -> float:
    return wait(lambda: driver.state is state, limit_s, lambda: f"{driver.state}, not {state}: {driver.fault}")


def multicast_refusal() -> str:
    """Return why this kernel does not carry multicast within the machine; empty when it does."""
    try:
        with can.Bus(
            interface="udp_multicast", channel=GROUP, port=free_port(), hop_limit=0, ignore_config=True
        ) as bus:
            bus.send(can.Message(arbitration_id=1, is_extended_id=False))
            return "" if bus.recv(timeout=1.0) else f"a datagram to {GROUP} does not come back"
    except (can.CanError, OSError) as error:
        return f"{error} ({error.__cause__})"


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port: int = probe.getsockname()[1]
        return port


@pytest.fixture(params=["virtual", "udp_multicast"])
def where(request: pytest.FixtureRequest) -> str:
    """Return the part of a URL that names a bus of its own."""
    if request.param == "virtual":
        return f"{next(_channels)}?interface=virtual"
    if reason := multicast_refusal():
        pytest.skip(f"no multicast on loopback: {reason}")
    return f"{GROUP}?interface=udp_multicast&port={free_port()}"


class Robot:
    """A driver and its emulated base."""

    def __init__(self, url: str) -> None:
        self.url = url
        self.emulated = EmulatedBase(url)
        self.driver = CanBaseDriver(url)

    @property
    def odrives(self) -> tuple[ODriveEmulator, ODriveEmulator]:
        left, right = self.emulated.left, self.emulated.right
        assert isinstance(left, ODriveEmulator)
        assert isinstance(right, ODriveEmulator)
        return left, right

    def idle(self) -> bool:
        return all(each.state is AxisState.IDLE for each in self.odrives)

    def speed(self) -> float:
        return max(abs(self.emulated.left.spin.speed_m_s), abs(self.emulated.right.spin.speed_m_s))

    def travelled_m(self) -> float:
        """Return how far the middle of the base has gone; a busy machine starts one wheel a little later."""
        return sum(self.emulated.body.travelled()) / 2.0

    def reading(self) -> Reading:
        reading = self.driver.read()
        assert reading is not None
        return reading

    def beyond(self, goal_m: float, sign: float) -> Callable[[], bool]:
        """Return what tells whether the odometry has passed `goal_m` in direction `sign`."""
        return lambda: sign * (self.reading().odometry.x_m - goal_m) > 0.0

    def activate(self) -> None:
        wait_state(self.driver, Lifecycle.READY)
        self.driver.activate()
        wait_state(self.driver, Lifecycle.ACTIVE, 1.0)

    def drive(self, twist: Twist, until: Callable[[], bool], limit_s: float = 4.0) -> Twist:
        """Command at 50 Hz until a condition holds; return what was applied last."""
        end_s, applied = time.monotonic() + limit_s, STAND
        while not until():
            assert time.monotonic() < end_s, f"{self.driver.state} {self.driver.fault} {self.driver.read()}"
            applied = self.driver.command(twist)
            time.sleep(0.02)
        return applied

    def moving(self) -> None:
        """Bring to ACTIVE and up to speed."""
        self.activate()
        self.drive(Twist(0.3, 0.0), lambda: self.speed() > 0.25)


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
    return make_robot(f"can+odrive://{next(_channels)}?interface=virtual&{ODRIVE}")


def there_and_back(robot: Robot) -> None:
    """Drive forwards and backwards; the odometry must agree with the body within 1 %."""
    for sign in (1.0, -1.0):
        before_m, began_m = robot.reading().odometry.x_m, robot.travelled_m()
        goal_m = before_m + sign * 0.15
        applied = robot.drive(Twist(0.4 * sign, 0.0), robot.beyond(goal_m, sign))
        assert applied.linear_m_s == pytest.approx(0.4 * sign, rel=1e-3)
        assert robot.reading().twist.linear_m_s == pytest.approx(0.4 * sign, rel=0.1)
        robot.drive(STAND, lambda: robot.speed() < 0.002 and abs(robot.reading().twist.linear_m_s) < 0.002)
        true_m = robot.travelled_m() - began_m
        assert true_m * sign > 0.15
        assert robot.reading().odometry.x_m - before_m == pytest.approx(true_m, rel=0.01)


def test_a_life(where: str, make_robot: Callable[[str], Robot]) -> None:
    robot = make_robot(f"can+odrive://{where}&{ODRIVE}")
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
    assert wait(lambda: robot.speed() < 0.01, 1.5) > 0.2  # silence is a stop
    assert robot.driver.state is Lifecycle.ACTIVE
    robot.drive(Twist(0.3, 0.0), lambda: robot.speed() > 0.25)
    robot.odrives[1].inject("CURRENT_LIMIT_VIOLATION")
    robot.drive(Twist(0.3, 0.0), lambda: robot.driver.state is Lifecycle.FAULT, 1.0)
    assert "right wheel (node 2) reports CURRENT_LIMIT_VIOLATION" in robot.driver.fault
    wait(robot.idle, 0.3)
    assert robot.driver.malformed == 0


def test_a_vesc_base(make_robot: Callable[[str], Robot]) -> None:
    robot = make_robot(f"can+vesc://{next(_channels)}?interface=virtual&{VESC}")
    robot.activate()
    there_and_back(robot)
    assert robot.driver.malformed == 0


def test_lost_heartbeats_are_a_fault_and_coming_back_is_ready(robot: Robot) -> None:
    robot.moving()
    robot.odrives[0].unplugged = True
    robot.drive(Twist(0.3, 0.0), lambda: robot.driver.state is Lifecycle.FAULT, 2.0)
    assert "no heartbeat from the left wheel (node 1)" in robot.driver.fault
    wait(robot.idle, 1.5)  # the right one was told, the left one has its watchdog
    robot.odrives[0].unplugged = False
    robot.drive(Twist(0.3, 0.0), lambda: robot.driver.state is Lifecycle.READY, 3.0)
    assert robot.idle()


def test_close_goes_over_zero_to_idle(robot: Robot) -> None:
    robot.moving()
    robot.driver.close()
    assert str(robot.driver.state) == "CLOSED"
    wait(lambda: robot.idle() and robot.speed() < 0.05, 0.3)
    robot.driver.close()
    robot.driver.open()  # and again, from zero
    wait(lambda: robot.driver.read() is not None, 1.0)
    assert robot.reading().odometry.x_m == pytest.approx(0.0, abs=0.02)


def test_bus_off_is_a_fault(robot: Robot) -> None:
    robot.moving()
    bus = port_of(robot.driver)._bus
    assert isinstance(bus, VirtualBus)
    bus.queue.put(can.Message(arbitration_id=0x40, is_error_frame=True, is_extended_id=False))
    wait_state(robot.driver, Lifecycle.FAULT)
    assert "bus-off" in robot.driver.fault
    wait(robot.idle, 1.5)


def test_a_stray_datagram_is_counted_and_ignored(make_robot: Callable[[str], Robot]) -> None:
    if reason := multicast_refusal():
        pytest.skip(f"no multicast on loopback: {reason}")
    port = free_port()
    robot = make_robot(f"can+odrive://{GROUP}?interface=udp_multicast&port={port}&{ODRIVE}")
    robot.activate()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 0)
        stranger.sendto(b"not a frame", (GROUP, port))
    wait(lambda: port_of(robot.driver).dropped == 1, 1.0)
    assert robot.driver.state is Lifecycle.ACTIVE


def port_of(driver: CanBaseDriver) -> CanPort:
    assert driver._port is not None
    return driver._port


def test_a_missing_adapter_is_said_by_open() -> None:
    driver = CanBaseDriver(f"can+odrive:///dev/no-such-adapter?interface=slcan&{ODRIVE}")
    with pytest.raises(DriverError, match="no-such-adapter"):
        driver.open()
    assert driver.state is Lifecycle.CLOSED
    driver.close()


class SlcanAdapter:
    """A USB adapter: ASCII frames on a pty at `path`, a virtual bus behind it. Closing it is unplugging it."""

    def __init__(self, path: Path, channel: str) -> None:
        self._path = path
        self._master, slave = os.openpty()
        tty.setraw(slave)
        path.symlink_to(os.ttyname(slave))
        self._slave = slave
        self._bus = can.Bus(interface="virtual", channel=channel, ignore_config=True)
        self._open = threading.Event()
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        pending = b""
        while not self._stopping.is_set():
            while select.select([self._master], [], [], 0.002)[0]:
                pending += os.read(self._master, 4096)
                *lines, pending = pending.split(b"\r")
                for line in filter(None, lines):
                    self._obey(line.decode())
            while (message := self._bus.recv(timeout=0)) is not None:
                if self._open.is_set():
                    text = f"t{message.arbitration_id:03X}{message.dlc}{message.data.hex()}\r"
                    os.write(self._master, text.encode())

    def _obey(self, line: str) -> None:
        if line[0] == "t":
            data = bytes.fromhex(line[5:])
            self._bus.send(can.Message(arbitration_id=int(line[1:4], 16), is_extended_id=False, data=data))
        elif line[0] == "r":
            message = can.Message(arbitration_id=int(line[1:4], 16), is_extended_id=False, is_remote_frame=True)
            self._bus.send(message)
        elif line[0] in "OC":
            (self._open.set if line[0] == "O" else self._open.clear)()
        os.write(self._master, b"\r")

    def close(self) -> None:
        self._path.unlink()  # first: the kernel gives the pty's number to whoever asks next
        self._stopping.set()
        self._thread.join()
        self._bus.shutdown()
        os.close(self._slave)
        os.close(self._master)


def test_an_slcan_adapter_unplugged_and_plugged_in_again(tmp_path: Path) -> None:
    channel = str(next(_channels))
    adapter = SlcanAdapter(tmp_path / "adapter", channel)
    driver = CanBaseDriver(f"can+odrive://{tmp_path}/adapter?interface=slcan&settle=0&{ODRIVE}")
    with EmulatedBase(f"can+odrive://{channel}?interface=virtual&{ODRIVE}") as base:
        driver.open()
        wait_state(driver, Lifecycle.READY)
        driver.activate()
        wait_state(driver, Lifecycle.ACTIVE, 1.0)
        adapter.close()
        wait_state(driver, Lifecycle.FAULT)
        left = base.left
        assert isinstance(left, ODriveEmulator)
        wait(lambda: left.state is AxisState.IDLE, 1.5)  # by its watchdog
        adapter = SlcanAdapter(tmp_path / "adapter", channel)
        wait_state(driver, Lifecycle.READY, 5.0)
        driver.close()
    adapter.close()
