"""Presents the robots of a world in the same process as a fleet: what agents read and drive in lockstep."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from fullswarm.drivers.base import FleetReading, Lifecycle, Pose, RangeScan
from fullswarm.kernels import Array, kernel
from fullswarm.simulation.world import World, sense


@kernel
def admit(
    twists: Array,
    active: NDArray[np.bool_],
    limits: Array,
    target: Array,
    commanded_s: Array,
    applied: Array,
    now_s: float,
) -> int:
    """Take set-points (n, 2) clipped to `limits` for the rows in `active`, zero for the others.

    Returns
    -------
    int
        The last row whose twist is not finite (it gets zero), or -1.
    """
    bad = -1
    for i in range(twists.shape[0]):
        v, w = twists[i, 0], twists[i, 1]
        if not (math.isfinite(v) and math.isfinite(w)):
            bad = i
            v, w = 0.0, 0.0
        if not active[i]:
            v, w = 0.0, 0.0
        applied[i, 0] = max(-limits[i, 0], min(limits[i, 0], v))
        applied[i, 1] = max(-limits[i, 1], min(limits[i, 1], w))
        target[i, 0], target[i, 1] = applied[i, 0], applied[i, 1]
        commanded_s[i] = now_s
    return bad


class SimFleet:
    """A :class:`~fullswarm.drivers.base.Fleet` over a world's arrays. The owner of the world steps and closes it.

    Parameters
    ----------
    world
        Its bodies are the fleet, in its order.
    now_s
        Stamps the readings: the scheduler's clock, so that ages are right.
    sensing_radius_m
        How far a robot sees obstacles.
    row
        The fleet is this body alone, for an agent of its own; None: all bodies.
    """

    def __init__(
        self, world: World, now_s: Callable[[], float], sensing_radius_m: float = 3.0, *, row: int | None = None
    ) -> None:
        rows = slice(None) if row is None else slice(row, row + 1)
        self.ids = world.ids[rows]
        n = len(self.ids)
        self.urls = tuple(f"sim://{robot}" for robot in self.ids)
        self.descriptions = tuple(
            replace(each, bodies_range_m=float(sensing_radius_m) if each.bodies_range_m > 0.0 else 0.0)
            for each in world.descriptions[rows]
        )
        self._row = row
        self._world, self._now_s, self._sensing_radius_m = world, now_s, float(sensing_radius_m)
        # Views: the world's arrays are the same objects for its life.
        self._pose, self._limits = world.pose[rows], world.limits[rows]
        self._target, self._commanded_s = world.target[rows], world.commanded_s[rows]
        self._open = False
        self._active = np.zeros(n, np.bool_)
        self._applied = np.zeros((n, 2))
        self._seen = np.zeros(len(world.obstacles), np.bool_)
        # Which robots see obstacles as such, and which measure ranges: how often, and when next.
        whole = range(len(world.ids)) if row is None else (row,)
        self._eyes = np.array([place for place, body in enumerate(whole) if world.sensors[body] is None], np.int64)
        self._scanning = [(place, body) for place, body in enumerate(whole) if world.sensors[body] is not None]
        self._scan_due_s = dict.fromkeys((place for place, _ in self._scanning), -math.inf)
        self._scans: dict[int, RangeScan] = {}
        self._reading = FleetReading(
            stamp_s=np.full(n, -np.inf),
            pose=world.sensed_pose[rows],
            odometry=world.odometry[rows],
            twist=world.twist[rows],
            hazards=world.hazards[rows],
            contacts=world.contacts[rows],
            battery=np.full(n, -1.0) if world.batteries is None else world.batteries.charge[rows],
            obstacles=world.obstacles[self._seen],
            position_sigma_m=np.full(n, np.nan),
            charging=None if world.batteries is None else world.batteries.charging[rows].view(np.int8),
        )

    def open(self) -> None:
        """Make the robots READY."""
        self._open = True

    def read(self) -> FleetReading:
        """Return the state after the last world step; the arrays are the world's own."""
        reading, world = self._reading, self._world
        if self._open:
            reading.stamp_s.fill(self._now_s())
            eyes = self._pose if not self._scanning else self._pose[self._eyes]
            if len(self._seen) and sense.run(eyes, world.shapes, self._sensing_radius_m, self._seen):
                reading.obstacles = world.obstacles[self._seen]
            if self._scanning:
                self._scan()
            if self._row is not None or len(world.movers):
                reading.bodies = world.seen_bodies(self._row, self._sensing_radius_m)
        return reading

    def _scan(self) -> None:
        """Take a scan of each sensor that is due."""
        now_s, news = self._now_s(), False
        for place, body in self._scanning:
            sensor = self._world.sensors[body]
            if sensor is None or now_s < self._scan_due_s[place] - 1e-6:
                continue
            self._scan_due_s[place] = now_s + 1.0 / sensor.settings.rate_hz
            distances_m = self._world.scan(body)
            if distances_m is None:
                continue
            settings, news = sensor.settings, True
            self._scans[place] = RangeScan(
                stamp_s=now_s, angles_rad=sensor.angles_rad, distances_m=distances_m, max_m=settings.max_m,
                mount=Pose(settings.x_m, settings.y_m, settings.yaw_rad), sigma_m=settings.sigma_m,
                cone_rad=settings.cone_rad,
            )  # fmt: skip
        if news:
            self._reading.ranges = tuple(self._scans.items())

    def command(self, twists: Array, active: NDArray[np.bool_]) -> Array:
        """Set set-points; return what was applied, (n, 2), in an array that the next call reuses.

        A non-finite value raises ``ValueError``; that robot stops, the others obey.
        """
        if not self._open:
            self._applied.fill(0.0)
            return self._applied
        self._active[:] = active
        bad = admit.run(
            twists, self._active, self._limits, self._target, self._commanded_s, self._applied, self._world.time_s
        )
        if bad >= 0:
            raise ValueError(f"{self.ids[bad]}: a twist must be finite, not {twists[bad].tolist()}")
        return self._applied

    def lifecycle(self, row: int) -> Lifecycle:
        """Return the state of robot `row`: a simulated robot in its own process has no faults."""
        if not self._open:
            return Lifecycle.CLOSED
        return Lifecycle.ACTIVE if self._active[row] else Lifecycle.READY

    def fault(self, row: int) -> str:
        """Return the empty text."""
        del row
        return ""

    def fault_code(self, row: int) -> str:
        """Return the empty code."""
        del row
        return ""

    def firmware(self, row: int) -> str:
        """Return the engine and its version."""
        del row
        return self._world.firmware

    def locate(self, row: int, pose: Pose, position_sigma_m: float, heading_sigma_rad: float) -> None:
        """Do nothing: these robots sense their pose."""

    def seek_dock(self, row: int) -> bool:
        """Return False: a simulated body has no such sense."""
        del row
        return False

    def docked(self, row: int) -> bool:
        """Tell whether a body stands in a slot of a dock."""
        batteries = self._world.batteries
        return batteries is not None and bool(batteries.slot[row if self._row is None else self._row] >= 0)

    def actuate(self, row: int, name: str, value: object) -> None:
        """Bring an actuator of a body into a state."""
        self._world.actuate(row if self._row is None else self._row, name, value)

    def close(self) -> None:
        """Stop the bodies; the world stays open."""
        self._target.fill(0.0)
        self._active.fill(False)
        self._open = False
