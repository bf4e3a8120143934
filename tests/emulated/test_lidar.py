"""A lidar on a real port beside a robot's driver: scans, and each way in which it fails and the robot must stand."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import FleetReading, Lifecycle
from fullswarm.drivers.fleet import OneRobot
from fullswarm.drivers.lidar.sensor import LidarSensor
from fullswarm.drivers.lidar.settings import parse_url
from fullswarm.drivers.null.driver import NullDriver
from fullswarm.emulators.lidar.emulator import LidarEmulator
from tests.waiting import until

CLOCK = MonotonicClock()
DRIVES = np.array([[0.2, 0.0]])
ON = np.array([True])


def ahead(angle_rad: float) -> float:
    """A wall 1.5 m ahead, 2 m wide; nothing else but a far round wall."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return 1.5 / c if c > 0.0 and abs(1.5 * s / c) < 1.0 else 6.0


@contextmanager
def robot(kind: str, options: str = "") -> Iterator[tuple[LidarEmulator, OneRobot]]:
    """Yield a lidar and a driving robot that has it."""
    with LidarEmulator(kind, ahead) as lidar:
        fleet = OneRobot("r1", NullDriver("null://r1"), sensor=LidarSensor(parse_url(lidar.url + options)))
        try:
            assert fleet.lifecycle(0) is not Lifecycle.ACTIVE
            fleet.open()
            drive_until(fleet, lambda: fleet.lifecycle(0) is Lifecycle.ACTIVE)
            yield lidar, fleet
        finally:
            fleet.close()


def drive_until(fleet: OneRobot, condition: object, within_s: float = 5.0) -> FleetReading:
    def turn() -> None:
        fleet.read()
        fleet.command(DRIVES, ON)

    until(condition, within_s, each=turn)  # type: ignore[arg-type]
    return fleet.read()


@pytest.mark.parametrize("kind", ["ld19", "rplidar"])
def test_scans_are_of_the_surroundings_and_newer_ones_follow(kind: str) -> None:
    with robot(kind, "?at=0.1,0,1.5708&max=4") as (_, fleet):
        assert fleet.descriptions[0].ranges_max_m == 4.0
        assert "ranges" in fleet.descriptions[0].capabilities
        reading = fleet.read()
        ((row, scan),) = reading.ranges
        assert (row, scan.mount.x_m, scan.max_m) == (0, 0.1, 4.0)
        middle = np.abs(np.array([math.remainder(each, math.tau) for each in scan.angles_rad])) < 0.5
        assert scan.distances_m[middle] * np.cos(scan.angles_rad[middle]) == pytest.approx(1.5, abs=0.01)
        assert np.isinf(scan.distances_m).sum() > 150, "beyond 4 m nothing is believed"
        first_s = scan.stamp_s
        drive_until(fleet, lambda: fleet.read().ranges[0][1].stamp_s > first_s + 0.3)
        assert 0.0 < fleet.read().ranges[0][1].duration_s < 0.4


@pytest.mark.parametrize("kind", ["ld19", "rplidar"])
def test_a_lidar_that_is_unplugged_stands_the_robot_until_it_is_back(kind: str) -> None:
    with robot(kind) as (lidar, fleet):
        lidar.unplug()
        began_s = CLOCK.now_s()
        drive_until(fleet, lambda: fleet.lifecycle(0) is Lifecycle.FAULT)
        assert CLOCK.now_s() - began_s < 1.0
        assert "measures nothing: the port is gone" in fleet.fault(0)
        assert not fleet.command(DRIVES, ON).any()
        lidar.replug()
        drive_until(fleet, lambda: fleet.lifecycle(0) is Lifecycle.ACTIVE)


def test_a_motor_that_is_held_and_a_cover_stand_the_robot() -> None:
    with robot("ld19") as (lidar, fleet):
        lidar.block(True)
        drive_until(fleet, lambda: fleet.lifecycle(0) is Lifecycle.FAULT)
        assert "no turn for 0.5 s" in fleet.fault(0)
        lidar.block(False)
        drive_until(fleet, lambda: fleet.lifecycle(0) is Lifecycle.ACTIVE)
        lidar.surround(lambda _: math.inf)
        drive_until(fleet, lambda: fleet.lifecycle(0) is Lifecycle.FAULT)
        assert "is covered: 0 % of its rays" in fleet.fault(0)
    with robot("ld19", "?least=0") as (lidar, fleet):
        lidar.surround(lambda _: math.inf)
        drive_until(fleet, lambda: np.isnan(fleet.read().ranges[0][1].distances_m).all())
        assert fleet.lifecycle(0) is Lifecycle.ACTIVE


def test_an_rplidar_that_was_reset_is_told_to_scan_again() -> None:
    with robot("rplidar") as (lidar, fleet):
        lidar.do(lambda: setattr(lidar.lidar, "scans", False))
        drive_until(fleet, lambda: fleet.lifecycle(0) is Lifecycle.FAULT)
        drive_until(fleet, lambda: fleet.lifecycle(0) is Lifecycle.ACTIVE)


def test_garbage_between_packets_costs_no_turn_and_is_counted() -> None:
    with robot("ld19") as (lidar, fleet):
        for _ in range(20):
            lidar.garbage(bytes(range(0x40, 0x70)))
            first_s = fleet.read().ranges[0][1].stamp_s
            drive_until(fleet, lambda at_s=first_s: fleet.read().ranges[0][1].stamp_s > at_s)
        assert fleet.lifecycle(0) is Lifecycle.ACTIVE
        distances = fleet.read().ranges[0][1].distances_m
        assert np.nanmin(distances) > 1.4
        lidar.block(True)
        drive_until(fleet, lambda: "bytes were none of its packets" in fleet.fault(0))
