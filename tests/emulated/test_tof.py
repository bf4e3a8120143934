"""VL53L1X on an I2C bus at the end of a real link: scans, and each way in which they fail and the robot must stand.

What is around the robot is an independent description: a round room and a wall, by angle and distance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import FleetReading, Lifecycle, Pose
from fullswarm.drivers.fleet import OneRobot
from fullswarm.drivers.null.driver import NullDriver
from fullswarm.drivers.ranges import sensor_of
from fullswarm.emulators.tof.emulator import FIVE, TofEmulator
from tests.waiting import until

CLOCK = MonotonicClock()
DRIVES = np.array([[0.2, 0.0]])
ON = np.array([True])
HALF = math.radians(13.5)


def wall_ahead(place: Pose, angle_rad: float) -> float:
    """A wall across at 1 m ahead of the robot's middle, without end; behind it nothing."""
    along = math.cos(angle_rad)
    return (1.0 - place.x_m) / along if along > 1e-9 else math.inf


@contextmanager
def robot(bus: str, options: str = "") -> Iterator[tuple[TofEmulator, OneRobot]]:
    """Yield emulated sensors and a driving robot that has them."""
    with TofEmulator(f"vl53l1x://{bus}{FIVE}{options}", wall_ahead) as sensors:
        fleet = OneRobot("r1", NullDriver("null://r1"), sensor=sensor_of(sensors.url))
        try:
            assert fleet.lifecycle(0) is not Lifecycle.ACTIVE
            fleet.open()
            drive_until(fleet, lambda: fleet.lifecycle(0) is Lifecycle.ACTIVE)
            drive_until(fleet, lambda: not any(math.isnan(each) for each in distances(fleet)))
            yield sensors, fleet
        finally:
            fleet.close()


@pytest.fixture(params=["serial", "tcp"])
def bus(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    return str(tmp_path / "tof") if request.param == "serial" else "127.0.0.1:0"


def drive_until(fleet: OneRobot, condition: Callable[[], bool], within_s: float = 5.0) -> FleetReading:
    def turn() -> None:
        fleet.read()
        fleet.command(DRIVES, ON)

    until(condition, within_s, lambda: fleet.fault(0) or str(distances(fleet)), each=turn)
    return fleet.read()


def stands_and_drives_again(fleet: OneRobot, fault: str, mend: Callable[[], object]) -> None:
    began_s = CLOCK.now_s()
    drive_until(fleet, lambda: fleet.lifecycle(0) is Lifecycle.FAULT)
    assert CLOCK.now_s() - began_s < 1.0
    drive_until(fleet, lambda: fault in fleet.fault(0))
    assert not fleet.command(DRIVES, ON).any()
    mend()
    drive_until(fleet, lambda: fleet.lifecycle(0) is Lifecycle.ACTIVE)


def newer(fleet: OneRobot, stamp_s: float) -> bool:
    return fleet.read().ranges[0][1].stamp_s > stamp_s


def distances(fleet: OneRobot) -> list[float]:
    return [float(scan.distances_m[0]) for _, scan in fleet.read().ranges]


def test_scans_are_the_nearest_things_in_five_directions(bus: str) -> None:
    with robot(bus) as (_, fleet):
        assert fleet.descriptions[0].ranges_max_m == 1.3
        assert "ranges" in fleet.descriptions[0].capabilities
        scans = [scan for _, scan in fleet.read().ranges]
        assert [scan.name for scan in scans] == [f"ranges/{channel}" for channel in range(5)]
        for scan, towards in zip(scans, (90.0, 45.0, 0.0, -45.0, -90.0), strict=True):
            angle = math.radians(towards)
            assert (scan.mount.x_m, scan.mount.y_m) == pytest.approx(
                (0.1 * math.cos(angle), 0.1 * math.sin(angle)), abs=1e-3
            )
            assert scan.mount.heading_rad == pytest.approx(angle, abs=1e-3)
            assert scan.max_m == 1.3
            assert scan.cone_rad == pytest.approx(2.0 * HALF)
            nearest = math.cos(max(0.0, abs(angle) - HALF))
            away_m = (1.0 - scan.mount.x_m) / nearest
            assert scan.distances_m[0] == (pytest.approx(away_m, abs=2e-3) if away_m < 1.3 else math.inf)
        first_s = min(scan.stamp_s for scan in scans)
        drive_until(fleet, lambda: min(scan.stamp_s for _, scan in fleet.read().ranges) > first_s + 0.3)


def test_a_cable_that_is_pulled_stands_the_robot_until_it_is_back(bus: str) -> None:
    with robot(bus) as (sensors, fleet):
        sensors.unplug()
        stands_and_drives_again(fleet, "sensors 0, 1, 2, 3, 4 on", sensors.replug)


def test_one_sensor_without_power_stands_the_robot(bus: str) -> None:
    with robot(bus) as (sensors, fleet):
        sensors.wire_sensor("3", False)
        stands_and_drives_again(fleet, "does not answer", lambda: sensors.wire_sensor("3", True))
        assert len(fleet.read().ranges) == 5


def test_sensors_that_repeat_themselves_and_a_bus_that_is_silent_stand_the_robot(bus: str) -> None:
    with robot(bus) as (sensors, fleet):
        sensors.stick_sensors(True)
        stands_and_drives_again(fleet, "no new measurement", lambda: sensors.stick_sensors(False))
        sensors.mute(True)
        stands_and_drives_again(fleet, "does not answer", lambda: sensors.mute(False))


def test_what_is_not_measured_stands_nothing(bus: str) -> None:
    with robot(bus) as (sensors, fleet):
        sensors.sensors["2"].state = 6  # too noisy
        drive_until(fleet, lambda: math.isnan(distances(fleet)[2]))
        sensors.sees = lambda _place, _angle_rad: math.inf
        drive_until(fleet, lambda: distances(fleet)[:2] == [math.inf, math.inf])
        drive_until(fleet, lambda: fleet.lifecycle(0) is Lifecycle.ACTIVE)  # at once, unless this machine stood still


def test_garbage_on_the_link_costs_single_measurements_and_shows_nothing_wrong(bus: str) -> None:
    with robot(bus) as (sensors, fleet):
        sensors.faults.corrupt = 0.02
        true = {round(each, 2) for each in distances(fleet) if math.isfinite(each)}
        end_s = CLOCK.now_s() + 2.0
        while CLOCK.now_s() < end_s:
            sensors.garbage(b"\xa7R\x00\x00\xff\xa7R" + bytes(range(0x40, 0x70)))
            first_s = fleet.read().ranges[0][1].stamp_s
            drive_until(fleet, partial(newer, fleet, first_s))
            assert {round(each, 2) for each in distances(fleet) if math.isfinite(each)} <= true
        sensors.faults.corrupt = 0.0
        drive_until(fleet, lambda: fleet.lifecycle(0) is Lifecycle.ACTIVE)
