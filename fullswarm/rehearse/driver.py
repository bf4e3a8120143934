"""Stands between an agent and its simulated robot: records what is commanded, and lies when a fault says so."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fullswarm.drivers.base import FleetReading, Lifecycle, Pose
from fullswarm.kernels import Array
from fullswarm.rehearse.process import InjectedCrash
from fullswarm.simulation.fleet import SimFleet
from fullswarm.simulation.world import World

FROZEN, STALE, REFUSES, RAISES, UNPLUGGED = "frozen pose", "stale stamp", "refuses twists", "raises", "unplugged"
LIES = (FROZEN, STALE, REFUSES, RAISES, UNPLUGGED)
FAULT_S = 0.3
"""A driver without its robot is in FAULT after so long, as those of the package are."""


@dataclass(slots=True)
class Lie:
    """What a robot's driver does wrong now, and since when (true time); "" is nothing."""

    kind: str = ""
    since_s: float = 0.0


class RehearsedFleet:
    """A :class:`~fullswarm.drivers.base.Fleet` of one simulated robot.

    Parameters
    ----------
    own_s : the clock of the robot's computer, which stamps readings
    true_s : the simulated time
    lie : of this robot's driver; it outlives the agent
    on_command : called with each set-point, m/s and rad/s, that reaches the robot
    """

    def __init__(
        self, world: World, row: int, own_s: Callable[[], float], true_s: Callable[[], float], sensing_radius_m: float,
        lie: Lie, on_command: Callable[[float, float], None],
    ) -> None:  # fmt: skip
        self._inner = SimFleet(world, own_s, sensing_radius_m, row=row)
        self.ids, self.urls, self.descriptions = self._inner.ids, self._inner.urls, self._inner.descriptions
        self._true_s, self._lie, self._on_command = true_s, lie, on_command
        self._kept: FleetReading | None = None
        self._was_faulty = False

    def open(self) -> None:
        """Make the robot READY."""
        self._inner.open()

    def read(self) -> FleetReading:
        """Return the state after the last world step, or what the lie makes of it."""
        kind = self._lie.kind
        if kind in (FROZEN, STALE, UNPLUGGED):
            if self._kept is None:
                reading = self._inner.read()
                self._kept = replace(
                    reading, stamp_s=reading.stamp_s.copy(), pose=reading.pose.copy(),
                    odometry=reading.odometry.copy(), twist=reading.twist.copy(), hazards=reading.hazards.copy(),
                    contacts=reading.contacts.copy(),
                )  # fmt: skip
            if kind == FROZEN:
                self._kept.stamp_s = self._inner.read().stamp_s.copy()
            return self._kept
        self._kept = None
        return self._inner.read()

    def command(self, twists: Array, active: NDArray[np.bool_]) -> Array:
        """Set the set-point; return what was applied."""
        kind = self._lie.kind
        if kind == RAISES:
            raise InjectedCrash(f"{self.ids[0]}: the driver fails")
        if kind == UNPLUGGED:
            return np.zeros((1, 2))
        if kind == REFUSES or self._was_faulty:
            twists = np.zeros((1, 2))
        applied = self._inner.command(twists, active)
        self._on_command(float(applied[0, 0]), float(applied[0, 1]))
        return applied

    def lifecycle(self, row: int) -> Lifecycle:
        """Return the state; after a FAULT it is READY until the agent has let go of it."""
        if self._lie.kind == UNPLUGGED and self._true_s() > self._lie.since_s + FAULT_S:
            self._was_faulty = True
            return Lifecycle.FAULT
        state = self._inner.lifecycle(row)
        if self._was_faulty:
            if state is not Lifecycle.ACTIVE:
                self._was_faulty = False
            return Lifecycle.READY
        return state

    def fault(self, row: int) -> str:
        """Return why it is in FAULT."""
        return "the robot does not answer" if self.lifecycle(row) is Lifecycle.FAULT else ""

    def fault_code(self, row: int) -> str:
        """Return no code."""
        return self._inner.fault_code(row)

    def ranges_fault(self, row: int) -> str:
        """Return that of the world."""
        return self._inner.ranges_fault(row)

    def firmware(self, row: int) -> str:
        """Return that of the world."""
        return self._inner.firmware(row)

    def locate(self, row: int, pose: Pose, position_sigma_m: float, heading_sigma_rad: float) -> None:
        """Do nothing: it senses its pose."""
        self._inner.locate(row, pose, position_sigma_m, heading_sigma_rad)

    def seek_dock(self, row: int) -> bool:
        """Return what the body's fleet says."""
        return self._inner.seek_dock(row)

    def docked(self, row: int) -> bool:
        """Tell whether the body stands in a slot of a dock."""
        return self._inner.docked(row)

    def actuate(self, row: int, name: str, value: object) -> None:
        """Bring an actuator into a state."""
        self._inner.actuate(row, name, value)

    def close(self) -> None:
        """Stop the body."""
        self._inner.close()
