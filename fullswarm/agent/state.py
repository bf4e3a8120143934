"""What the robots of one agent are known to do now. The node writes it once per tick; everyone else reads it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from fullswarm.drivers.base import FleetReading
from fullswarm.kernels import Array


@dataclass(frozen=True, slots=True)
class Identity:
    """Who this agent is on the bus."""

    host: str  # key chunk: the robot's id on board, "lockstep" in a trial
    process: str  # unique per process start


@dataclass(slots=True)
class AgentState:
    """The n robots of one agent.

    Attributes
    ----------
    radius : (n,) m, footprints
    pose : (n, 3) m and rad, as estimated in the last tick; NaN where no pose is known
    reading : of the drivers, in the last tick; None before the first one
    twist : (n, 2) m/s and rad/s, measured
    setpoints : (n, 2) m/s and rad/s, applied by the drivers in the last tick
    """

    radius: Array
    pose: Array
    reading: FleetReading | None = None
    twist: Array = field(init=False)
    setpoints: Array = field(init=False)

    def __post_init__(self) -> None:
        self.twist, self.setpoints = np.zeros((len(self.pose), 2)), np.zeros((len(self.pose), 2))
