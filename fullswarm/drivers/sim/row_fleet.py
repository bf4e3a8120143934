"""One robot of a world in the same process: what an agent of its own sees and drives in lockstep."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fullswarm.drivers.base import Array, Description, FleetReading, Lifecycle, Pose
from fullswarm.drivers.sim.world import World
from fullswarm.drivers.sim.world_kernels import admit, sense


class RowFleet:
    """A :class:`~fullswarm.drivers.base.Fleet` of one robot over its row of a world's arrays.

    Parameters
    ----------
    world
        Whoever made it steps and closes it.
    row
        Whose row.
    now_s
        Stamps the readings: the scheduler's clock.
    sensing_radius_m
        How far the robot sees obstacles.
    """

    def __init__(self, world: World, row: int, now_s: Callable[[], float], sensing_radius_m: float = 3.0) -> None:
        self._world, self._now_s, self._sensing_radius_m = world, now_s, float(sensing_radius_m)
        self._rows = rows = slice(row, row + 1)
        self.ids = world.ids[rows]
        self.urls = tuple(f"sim://{robot}" for robot in self.ids)
        self.descriptions: tuple[Description, ...] = (world.description,)
        self._open = False
        self._active = np.zeros(1, np.bool_)
        self._applied = np.zeros((1, 2))
        self._seen = np.zeros(len(world.obstacles), np.bool_)
        self._reading = FleetReading(
            stamp_s=np.full(1, -np.inf),
            pose=world.sensed_pose[rows],
            odometry=world.odometry[rows],
            twist=world.twist[rows],
            hazards=world.hazards[rows],
            contacts=world.contacts[rows],
            battery=np.full(1, -1.0),
            obstacles=world.obstacles[self._seen],
        )

    def open(self) -> None:
        """Make the robot READY."""
        self._open = True

    def read(self) -> FleetReading:
        """Return the state after the last world step; the arrays are the world's own."""
        reading, world = self._reading, self._world
        if self._open:
            reading.stamp_s.fill(self._now_s())
            if sense.run(world.pose[self._rows], world.shapes, self._sensing_radius_m, self._seen):
                reading.obstacles = world.obstacles[self._seen]
        return reading

    def command(self, twists: Array, active: NDArray[np.bool_]) -> Array:
        """Set the set-point; return what was applied, (1, 2), in an array that the next call reuses.

        A non-finite value raises ``ValueError``, and the robot stops.
        """
        if not self._open:
            self._applied.fill(0.0)
            return self._applied
        self._active[:] = active
        world, rows = self._world, self._rows
        bad = admit.run(
            twists, self._active, world.limits[rows], world.target[rows], world.commanded_s[rows], self._applied,
            world.time_s,
        )  # fmt: skip
        if bad >= 0:
            raise ValueError(f"{self.ids[0]}: a twist must be finite, not {twists[bad].tolist()}")
        return self._applied

    def lifecycle(self, row: int) -> Lifecycle:
        """Return the state: a simulated robot has no faults."""
        del row
        if not self._open:
            return Lifecycle.CLOSED
        return Lifecycle.ACTIVE if self._active[0] else Lifecycle.READY

    def fault(self, row: int) -> str:
        """Return the empty text."""
        del row
        return ""

    def firmware(self, row: int) -> str:
        """Return the engine and its version."""
        del row
        return self._world.firmware

    def locate(self, row: int, pose: Pose, position_sigma_m: float, heading_sigma_rad: float) -> None:
        """Do nothing: these robots sense their pose."""

    def close(self) -> None:
        """Stop the body; the world stays open."""
        self._world.target[self._rows] = 0.0
        self._active.fill(False)
        self._open = False
