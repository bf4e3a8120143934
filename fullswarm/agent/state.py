"""The arrays of an agent's n robots that more than one part reads, each with the one part that writes it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from fullswarm.drivers.base import NO_OBSTACLES, FleetReading
from fullswarm.kernels import Array, Flags, Index


@dataclass(frozen=True, slots=True)
class Identity:
    """Name of this agent on the bus."""

    host: str  # key chunk: the robot's id on board, "lockstep" in a trial
    process: str  # unique per process start


@dataclass(slots=True)
class AgentState:
    """The n robots of one agent.

    Attributes
    ----------
    radius : (n,) m, footprints
    pose : (n, 3) m and rad, as estimated in the last tick, NaN where no pose is known; by the node
    reading : of the drivers, in the last tick, None before the first one; by the node
    sigma : (n, 2) standard deviations of `pose`: m along the worse axis, rad; by the node
    twist : (n, 2) m/s and rad/s, measured; by the node
    setpoints : (n, 2) m/s and rad/s, applied by the drivers in the last tick; by the node
    estop : (n,) latched e-stops; by ``EStops``
    stop_reason : (n,) ``StopReason`` of the last tick; by ``RobotController``
    battery_low : (n,) too low to drive; by ``Reflexes``
    at_standstill, standstill_since_s : (n,) see ``Standstill``, which writes them
    driver_ready : (n,) drivers READY or ACTIVE in the last tick; by ``DriverWatch``
    obstacles : (k, 6) static ones that the robots sense now, or the map in their place; rows as in
        ``Reading.obstacles``; the same array until it changes; by the node
    aim : (n, 2) m, where each control law says that it is driving to next, NaN where it says nothing; by
        ``DesiredMotion``
    """

    radius: Array
    pose: Array
    estop: Flags
    stop_reason: Index
    battery_low: Flags
    at_standstill: Flags
    standstill_since_s: Array
    reading: FleetReading | None = None
    obstacles: Array = field(default_factory=lambda: NO_OBSTACLES)
    sigma: Array = field(init=False)
    twist: Array = field(init=False)
    setpoints: Array = field(init=False)
    driver_ready: Flags = field(init=False)
    aim: Array = field(init=False)

    def __post_init__(self) -> None:
        count = len(self.pose)
        self.sigma, self.twist, self.setpoints = np.zeros((count, 2)), np.zeros((count, 2)), np.zeros((count, 2))
        self.driver_ready = np.zeros(count, bool)
        self.aim = np.full((count, 2), math.nan)
