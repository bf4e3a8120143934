"""One driver seen as a fleet of one, so that the agent has a single code path over arrays."""

from __future__ import annotations

import contextlib
import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import structlog
from numpy.typing import NDArray

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.actuators import Actuates, checked
from fullswarm.drivers.base import (
    NO_OBSTACLES,
    Description,
    Docks,
    Driver,
    FleetReading,
    Lifecycle,
    Pose,
    RangeScan,
    Reading,
    TakesFixes,
    Twist,
)
from fullswarm.errors import DriverError
from fullswarm.kernels import Array

if TYPE_CHECKING:
    from fullswarm.drivers.ranges import RangeSensor

log = structlog.get_logger()

RETRY_S = 0.5
UNKNOWN = Pose(math.nan, math.nan, math.nan)


class OneRobot:
    """A :class:`~fullswarm.drivers.base.Fleet` of a single :class:`~fullswarm.drivers.base.Driver`.

    A port that is not there yet (a robot that is switched on after its computer) is a FAULT that people see, and is
    tried again twice a second; it does not end the agent.

    Parameters
    ----------
    sensor : range sensor on board beside the driver. While it measures nothing the robot counts as in FAULT: what it
        was to keep off by its ranges it cannot see.
    """

    def __init__(
        self, robot: str, driver: Driver, clock: Clock | None = None, sensor: RangeSensor | None = None
    ) -> None:
        self.ids: tuple[str, ...] = (robot,)
        self.urls: tuple[str, ...] = (driver.url,)
        described = driver.description
        if sensor is not None:
            described = replace(described, ranges_max_m=max(described.ranges_max_m, sensor.max_m))
        self.descriptions: tuple[Description, ...] = (described,)
        self._driver, self._sensor = driver, sensor
        self._scans: tuple[RangeScan, ...] = ()
        self._fixable = driver if isinstance(driver, TakesFixes) else None
        self._clock = clock or MonotonicClock()
        self._absent: DriverError | None = None
        self._again_s = math.inf
        self._activating = False
        self._last: Reading | None = None
        self._ranges: tuple[RangeScan, ...] = ()
        self._breaks = np.zeros(1, np.int64)
        self._reading = FleetReading(
            stamp_s=np.full(1, -math.inf),
            pose=np.full((1, 3), math.nan),
            odometry=np.zeros((1, 3)),
            twist=np.zeros((1, 2)),
            hazards=np.zeros(1, np.uint8),
            contacts=np.zeros(1, np.int64),
            battery=np.full(1, -1.0),
            obstacles=NO_OBSTACLES,
            position_sigma_m=np.full(1, math.nan),
            odometry_breaks=self._breaks,
            charging=np.full(1, -1, np.int8),
        )

    def open(self) -> None:
        """Open the driver, or try again later."""
        if self._sensor is not None:
            self._sensor.start()
        try:
            self._driver.open()
        except DriverError as error:
            if self._absent is None or str(error) != str(self._absent):
                log.warning("the robot's port cannot be opened; the agent keeps trying", reason=str(error))
            self._absent, self._again_s = error, self._clock.now_s() + RETRY_S
        else:
            self._absent, self._again_s = None, math.inf

    def read(self) -> FleetReading:
        """Return the newest reading as arrays of one row."""
        if self._absent is not None and self._clock.now_s() >= self._again_s:
            self.open()
        new, rows = self._driver.read(), self._reading
        if self._sensor is not None and self._sensor.scans is not self._scans:
            self._scans = self._sensor.scans
            rows.ranges = tuple((0, scan) for scan in (*self._ranges, *self._scans))
        if new is None or new is self._last:
            return rows
        self._last = new
        rows.stamp_s[0] = new.stamp_s
        _write(rows.pose, new.pose or UNKNOWN)
        _write(rows.odometry, new.odometry)
        self._breaks[0] = new.odometry_breaks
        rows.twist[0, 0] = new.twist.linear_m_s
        rows.twist[0, 1] = new.twist.angular_rad_s
        rows.hazards[0] = int(new.hazards)
        rows.contacts[0] = new.contacts
        rows.battery[0] = -1.0 if new.battery is None else new.battery
        if rows.charging is not None:
            rows.charging[0] = -1 if new.charging is None else int(new.charging)
        rows.obstacles = new.obstacles
        rows.bodies = new.bodies
        if new.ranges is not self._ranges:
            self._ranges = new.ranges
            rows.ranges = tuple((0, scan) for scan in (*new.ranges, *self._scans))
        rows.position_sigma_m[0] = math.nan if new.position_sigma_m is None else new.position_sigma_m
        return rows

    def command(self, twists: Array, active: NDArray[np.bool_]) -> Array:
        """Command the driver, activating or deactivating it first where `active` asks for it."""
        driver, state = self._driver, self._driver.state
        drives = bool(active[0]) and not self._blind
        if drives and state is Lifecycle.READY:
            driver.activate()
            self._activating = True
        elif not drives and (state is Lifecycle.ACTIVE or (self._activating and state is Lifecycle.READY)):
            # In READY an attempt to arm may be under way: it must not end after an e-stop.
            driver.deactivate()
            self._activating = False
        desired = Twist(float(twists[0, 0]), float(twists[0, 1])) if drives else Twist()
        applied = driver.command(desired)
        return np.array([[applied.linear_m_s, applied.angular_rad_s]])

    def lifecycle(self, row: int) -> Lifecycle:
        """Return the driver's state; FAULT while its port is not there, or its range sensor measures nothing."""
        del row
        return self._driver.state if self._absent is None and not self._blind else Lifecycle.FAULT

    def fault(self, row: int) -> str:
        """Return the driver's fault, or its range sensor's."""
        del row
        return (self._driver.fault if self._absent is None else str(self._absent)) or self._blind

    def fault_code(self, row: int) -> str:
        """Return the code of the driver's fault, if it has one."""
        del row
        return str(getattr(self._driver, "fault_code", "") if self._absent is None else self._absent.code)

    def firmware(self, row: int) -> str:
        """Return the device's firmware."""
        del row
        return self._driver.firmware

    def locate(self, row: int, pose: Pose, position_sigma_m: float, heading_sigma_rad: float) -> None:
        """Pass a fix on to a driver that takes them."""
        del row
        if self._fixable is not None:
            self._fixable.locate(pose, position_sigma_m, heading_sigma_rad)

    def seek_dock(self, row: int) -> bool:
        """Let the robot find its dock by itself, if its driver can."""
        del row
        driver = self._driver
        if not isinstance(driver, Docks):
            return False
        if driver.state is Lifecycle.ACTIVE and not driver.docking and not driver.docked:
            with contextlib.suppress(DriverError):  # it has just left ACTIVE: asked again at the next tick
                driver.dock()
        return True

    def docked(self, row: int) -> bool:
        """Tell whether the robot reports that it stands on a dock."""
        del row
        return isinstance(self._driver, Docks) and self._driver.docked

    def actuate(self, row: int, name: str, value: object) -> None:
        """Check a value against the driver's description, and pass it on."""
        del row
        found = checked(self._driver.description.actuators, name, value)
        if not isinstance(self._driver, Actuates):
            hint = "its driver needs a method actuate(name, value)"
            raise DriverError(f"its driver cannot set '{name}'", where=self._driver.url, hint=hint)
        self._driver.actuate(name, found)

    def close(self) -> None:
        """Close the driver and the range sensor."""
        self._driver.close()
        if self._sensor is not None:
            self._sensor.close()

    @property
    def _blind(self) -> str:
        """Why its range sensor measures nothing; empty: it measures, or there is none."""
        return "" if self._sensor is None else self._sensor.trouble


def _write(row: Array, pose: Pose) -> None:
    """Write number by number: on board this is done fifty times a second, and a tuple costs twice as much."""
    row[0, 0] = pose.x_m
    row[0, 1] = pose.y_m
    row[0, 2] = pose.heading_rad
