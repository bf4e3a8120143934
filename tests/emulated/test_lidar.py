"""Lidar drivers against emulated lidars on real ports: scans, silence, damage, unplugging; and a robot that has one."""

from __future__ import annotations

import math
import socket
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from fullswarm.agent.motion.robot_controller import StopReason
from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import Lifecycle, RangeScan
from fullswarm.drivers.create_oi.driver import CreateDriver
from fullswarm.drivers.fleet import OneRobot
from fullswarm.drivers.lidar.driver import LidarDriver
from fullswarm.drivers.null.driver import NullDriver
from fullswarm.emulators.create_oi.emulator import CreateEmulator
from fullswarm.emulators.lidar.emulator import EmulatedLidar
from fullswarm.emulators.lidar.firmware import LdFirmware
from fullswarm.kernels import Array
from fullswarm.reasons import Code
from fullswarm.simulation.bodies import FreeBody
from tests.unit.rover_agent import RoverAgent
from tests.waiting import until

AHEAD = np.array([[1.5, 0.0, 0.5, 0.5, 0.0, 0.0]])
ROOM = np.vstack([AHEAD, [[0.0, 2.0, 4.0, 0.5, 0.0, 0.0]], [[-3.0, 0.0, 0.5, 4.0, 0.0, 0.0]]])
"""Its face is 1 m ahead; a wall is 1.5 m to the left, another 2.5 m behind."""
SCHEMES = ("ld19", "rplidar")


@contextmanager
def lidar(url: str, boxes: Array = ROOM) -> Iterator[tuple[EmulatedLidar, LidarDriver]]:
    with EmulatedLidar(url, boxes=boxes) as emulator:
        driver = LidarDriver(url)
        driver.open()
        try:
            yield emulator, driver
        finally:
            driver.close()


def newest(driver: LidarDriver) -> RangeScan | None:
    reading = driver.read()
    return reading.ranges[0] if reading else None


def scans(driver: LidarDriver, count: int = 2) -> RangeScan:
    """Wait for so many new scans, of which the last is returned: the first may have begun before."""
    for _ in range(count):
        before = newest(driver)
        until(lambda before=before: newest(driver) is not before, what=lambda: f"a scan: {driver.fault}")  # type: ignore[misc]
    found = newest(driver)
    assert found is not None
    return found


def towards(scan: RangeScan, degrees: float) -> float:
    """Return the distance of the ray nearest to a direction on the robot."""
    off = np.angle(np.exp(1j * (scan.angles_rad + scan.mount.heading_rad - math.radians(degrees))))
    return float(scan.distances_m[np.argmin(np.abs(off))])


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_scan_shows_what_is_there(tmp_path: Path, scheme: str) -> None:
    with lidar(f"{scheme}://{tmp_path}/lidar?heading_rad=1.5708&x_m=0.1&max_m=2") as (_, driver):
        scan = scans(driver)
        assert towards(scan, 0.0) == pytest.approx(0.9, abs=0.02)
        assert towards(scan, 90.0) == pytest.approx(1.5, abs=0.02)
        assert towards(scan, 180.0) == math.inf
        assert math.isnan(towards(scan, -90.0))
        assert driver.state is Lifecycle.READY
        assert driver.description.ranges_max_m == scan.max_m == 2.0


@pytest.mark.parametrize("scheme", SCHEMES)
def test_a_lidar_that_is_unplugged_is_a_fault_until_it_is_back(tmp_path: Path, scheme: str) -> None:
    with lidar(f"{scheme}://{tmp_path}/lidar") as (emulator, driver):
        scans(driver)
        emulator.unplug()
        until(lambda: driver.state is Lifecycle.FAULT)
        assert driver.fault_code == Code.RANGES
        until(lambda: "no such port" in driver.fault)
        emulator.replug()
        scans(driver)
        assert (driver.state, driver.fault) == (Lifecycle.READY, "")


@pytest.mark.parametrize("scheme", SCHEMES)
def test_damage_is_counted_and_makes_no_wrong_point(tmp_path: Path, scheme: str) -> None:
    with lidar(f"{scheme}://{tmp_path}/lidar") as (emulator, driver):
        first = scans(driver)
        seen = []
        for place in range(4):
            emulator.garbage(bytes([0x54, 0x2C, 0xA5, 0x5A, place, 255, 3, 2])[: 3 + place % 6])
            emulator.cut()
            seen.append(scans(driver, 1))
        assert driver.health.damaged > 0
        for scan in seen:
            for degrees in range(-40, 150, 10):
                assert towards(scan, degrees) == pytest.approx(towards(first, degrees), abs=0.12, nan_ok=True)


def test_a_lidar_behind_a_serial_server_is_waited_for_on_the_link_thread() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = "{}:{}".format(*server.getsockname())
    driver = LidarDriver(f"ld19+tcp://{address}")
    driver.open()
    try:
        until(lambda: "no program listens there" in driver.fault)
        assert driver.state is Lifecycle.FAULT
        firmware, clock = LdFirmware(lambda angles: np.full(len(angles), 1.0), 12.0, -1.0), MonotonicClock()
        with socket.create_server(server_address(address)) as server:
            server.settimeout(10.0)
            with server.accept()[0] as line:

                def send() -> None:
                    firmware.step(clock.now_s())
                    line.sendall(b"".join(firmware.take(0)))

                until(lambda: driver.state is Lifecycle.READY, each=send)
    finally:
        driver.close()


def server_address(address: str) -> tuple[str, int]:
    host, _, port = address.partition(":")
    return host, int(port)


# ---------------------------------------------------------------- a robot with a lidar
def test_a_robot_has_ranges_when_all_its_sensors_have_sent(tmp_path: Path) -> None:
    urls = [f"ld19://{tmp_path}/a?max_m=5", f"rplidar://{tmp_path}/b"]
    fleet = OneRobot("r1", NullDriver("null://r1"), sensors=[LidarDriver(url) for url in urls])
    assert fleet.descriptions[0].ranges_max_m == 12.0
    fleet.open()
    try:
        assert "there is no such port" in fleet.ranges_fault(0)
        assert fleet.fault(0) == ""
        with EmulatedLidar(urls[0], boxes=ROOM), EmulatedLidar(urls[1], boxes=ROOM):
            until(lambda: len(fleet.read().ranges) == 2)
            assert [scan.name for _, scan in fleet.read().ranges] == ["ld19", "rplidar"]
            until(lambda: fleet.read().ranges is fleet.read().ranges)
    finally:
        fleet.close()


class WithLidar(RoverAgent):
    """A Create and its lidar, on one body."""

    def __init__(self, folder: Path, boxes: Array) -> None:
        self.body = FreeBody()
        self.create = CreateEmulator(body=self.body).start()
        url = f"ld19://{folder}/lidar"
        self.lidar = EmulatedLidar(url, self.body, boxes).start()
        self.sensors = [LidarDriver(url)]
        super().__init__(MonotonicClock(), lambda _: CreateDriver(self.create.url))
        self.ready()

    def close(self) -> None:
        super().close()
        self.lidar.close()
        self.create.close()


@pytest.fixture
def robot(tmp_path: Path) -> Iterator[Callable[[Array], WithLidar]]:
    made: list[WithLidar] = []

    def make(boxes: Array) -> WithLidar:
        made.append(WithLidar(tmp_path, boxes))
        return made[-1]

    yield make
    for each in made:
        each.close()


def test_a_robot_keeps_off_what_its_lidar_alone_sees(robot: Callable[[Array], WithLidar]) -> None:
    made = robot(AHEAD)
    made.drive(filtered=True)
    gaps_m: list[float] = []

    def slow_after_a_while() -> bool:
        state = made.body.state()
        gaps_m.append(math.hypot(max(abs(state.x_m - 1.5) - 0.5, 0.0), max(abs(state.y_m) - 0.5, 0.0)))
        return state.x_m > 0.4 and abs(state.speed_m_s) < 0.02

    made.until(slow_after_a_while)
    assert made.driver.state is Lifecycle.ACTIVE
    assert made.reason is StopReason.MOVING
    assert 0.175 < min(gaps_m) < 0.5


def test_a_robot_whose_lidar_dies_stops_says_why_and_goes_on_with_it(robot: Callable[[Array], WithLidar]) -> None:
    made = robot(np.array([[0.0, 3.0, 80.0, 0.5, 0.0, 0.0]]))
    made.until(lambda: made.reason is not StopReason.RANGES and len(made.fleet.read().ranges) == 1)
    made.drive()
    made.until(lambda: made.body.state().speed_m_s > 0.2)
    made.lidar.unplug()
    made.until(lambda: made.reason is StopReason.RANGES)
    made.until(lambda: made.body.state().speed_m_s == 0.0)
    made.until(lambda: made.health[-1].stop_code == Code.RANGES)
    assert "plug" in made.health[-1].stop_reason
    assert made.health[-1].fault_code == Code.RANGES
    made.lidar.replug()
    made.until(lambda: made.body.state().speed_m_s > 0.2)
    made.lidar.mute()
    made.until(lambda: made.reason is StopReason.RANGES and made.body.state().speed_m_s == 0.0)
