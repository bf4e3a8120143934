"""What watches the bodies of a live trial: their world where it is simulated, else what the robots say of themselves.

A world knows where bodies are and which of them touch. Robots know it as well as they can: poses from their estimator,
contacts from their bumpers; what they touched is then told by how near another robot was.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from fullswarm.bus.base import Bus
from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import Array, Limits
from fullswarm.drivers.sim.world import World
from fullswarm.evaluate.experiment.record import Contacts
from fullswarm.evaluate.trial import Referee
from fullswarm.keys import Keys
from fullswarm.messages import HealthReport, RobotHealth, RobotStates
from fullswarm.perf.truth import Truth

ENDLESS = Limits(speed_m_s=np.inf, turn_rad_s=np.inf, accel_m_s2=np.inf, turn_accel_rad_s2=np.inf)
NEAR_M = 0.1
"""A robot whose bumper is pressed has met another one when the gap between their estimated poses is below this."""
USUAL_RADIUS_M = 0.17
"""Of a robot that has not told its radius yet."""


class Witness(Protocol):
    """Sees n bodies."""

    def look(self) -> None:
        """Take in what has happened since the last look."""
        ...

    def touched(self) -> NDArray[np.bool_]:
        """Return who has touched anything since this was asked last, (n,)."""
        ...

    @property
    def pose(self) -> Array:
        """Where they are now, (n, 3) m, m, rad; NaN: unknown."""
        ...

    @property
    def radius_m(self) -> Array:
        """Their sizes, (n,)."""
        ...

    @property
    def events(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Contacts so far with robots and with obstacles, (n,) each."""
        ...

    @property
    def pairs_touched(self) -> int | None:
        """How many pairs of robots have touched; None: not known."""
        ...

    @property
    def robots_touched(self) -> int:
        """How many robots have touched anything."""
        ...

    def evidence(self) -> Contacts | None:
        """Return what is needed to count the contacts again; None: not known."""
        ...

    @property
    def above_limits(self) -> int:
        """How many commands were beyond the actuators' limits."""
        ...

    @property
    def truth(self) -> Truth | None:
        """What the bodies did; None: the robots' own data is all there is."""
        ...


class WorldWitness:
    """Sees the bodies of a simulated world after each of its steps, from the first look on.

    Parameters
    ----------
    goals : (n, 2), each reached within `goal_radius_m`
    cell_m : of the true coverage grid
    emulated : firmware stands between the commands and the bodies, so commands are not seen here
    """

    def __init__(self, world: World, goals: Array, goal_radius_m: float, cell_m: float, emulated: bool = False) -> None:
        self._world = world
        self._began_s: float | None = None
        self._limits = ENDLESS if emulated else world.description.limits
        self._referee = Referee(world, self._limits)
        self._touched = np.zeros(len(world.ids), bool)
        about = world.ids, self.radius_m, goals, goal_radius_m, world.config.bounds_m, cell_m
        # Kernels are compiled when they first run: not while robots drive in a world that this process steps.
        Truth(*about).look(0.0, world.pose, world.twist, world.dt_s, world.contacts)
        Referee(world, self._limits).look()
        self.truth: Truth = Truth(*about)

    def look(self) -> None:
        """Begin, unless that is done: the world calls by itself, so that no step is missed on a busy machine."""
        if self._began_s is None:
            self._began_s = self._world.time_s
            self._referee = Referee(self._world, self._limits)
            self._world.watchers.append(self._take_in)

    def _take_in(self) -> None:
        """Take in one step of the world."""
        world = self._world
        self._referee.look()
        self.truth.look(world.time_s - (self._began_s or 0.0), world.pose, world.twist, world.dt_s, world.contacts)
        self._touched |= world.contacts > 0

    def touched(self) -> NDArray[np.bool_]:
        """Return who has touched anything since this was asked last."""
        found, self._touched = self._touched, np.zeros(len(self._touched), bool)
        return found

    @property
    def pose(self) -> Array:
        """The true poses."""
        return self._world.pose

    @property
    def radius_m(self) -> Array:
        """The world's bodies are all of one size."""
        return np.full(len(self._world.ids), self._world.config.radius_m)

    @property
    def events(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Contacts as the world's referee tells them."""
        return self._referee.robots.events, self._referee.obstacles.events

    @property
    def pairs_touched(self) -> int:
        """Pairs of robots."""
        return len(self._referee.pairs)

    @property
    def robots_touched(self) -> int:
        """Robots that touched robots or obstacles."""
        return int(self._referee.touched.sum())

    def evidence(self) -> Contacts:
        """Return the referee's."""
        return self._referee.evidence()

    @property
    def above_limits(self) -> int:
        """Set-points beyond the limits of simulated robots; 0 for emulated ones."""
        return self._referee.above_limits


class HeardWitness:
    """Believes what robots say: their states and health reports, from the moment it is made."""

    def __init__(self, bus: Bus, config: SwarmConfig) -> None:
        count = len(config.robots)
        self._rows = {robot: row for row, robot in enumerate(config.robots)}
        self._pose = np.full((count, 3), np.nan)
        self._radius_m = np.full(count, USUAL_RADIUS_M)
        self._touched = np.zeros(count, bool)
        self._heard = np.full(count, -1, np.int64)  # collisions in the newest report; -1: none yet
        self._events = np.zeros((2, count), np.int64)
        keys = Keys(config.swarm)
        self._subscriptions = [
            bus.subscribe(keys.state(), RobotStates, self._on_states, latest=True),
            bus.subscribe(keys.health(), HealthReport, self._on_health),
        ]

    def look(self) -> None:
        """Nothing to do: messages come by themselves."""

    def touched(self) -> NDArray[np.bool_]:
        """Return who has told of a contact since this was asked last."""
        found, self._touched = self._touched, np.zeros(len(self._touched), bool)
        return found

    @property
    def pose(self) -> Array:
        """The robots' own estimates."""
        return self._pose

    @property
    def radius_m(self) -> Array:
        """What their drivers tell."""
        return self._radius_m

    @property
    def events(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Contacts that the robots count, by what was nearest at the time."""
        return self._events[0], self._events[1]

    @property
    def pairs_touched(self) -> None:
        """A bumper does not tell what pressed it."""
        return None

    @property
    def robots_touched(self) -> int:
        """Robots that have counted a contact."""
        return int((self._events.sum(axis=0) > 0).sum())

    def evidence(self) -> None:
        """Robots keep none."""
        return

    @property
    def above_limits(self) -> int:
        """The commands of a robot are not visible outside it."""
        return 0

    @property
    def truth(self) -> None:
        """Robots can be wrong about themselves."""
        return None

    def close(self) -> None:
        """Hear no more."""
        for subscription in self._subscriptions:
            subscription.close()

    def _on_states(self, states: RobotStates) -> None:
        columns = zip(states.robots, states.x_m, states.y_m, states.heading_rad, states.radius_m, strict=False)
        for robot, x_m, y_m, heading_rad, radius_m in columns:
            row = self._rows.get(robot)
            if row is not None:
                self._pose[row] = x_m, y_m, heading_rad
                self._radius_m[row] = radius_m

    def _on_health(self, report: HealthReport) -> None:
        for health in report.robots:
            row = self._rows.get(health.robot)
            if row is not None:
                self._book(row, health)

    def _book(self, row: int, health: RobotHealth) -> None:
        new = health.collisions - self._heard[row] if self._heard[row] >= 0 else 0
        self._heard[row] = health.collisions
        self._touched[row] |= health.contacts > 0 or new > 0
        if new > 0:
            self._events[0 if self._beside_another(row) else 1, row] += new

    def _beside_another(self, row: int) -> bool:
        apart_m = np.hypot(*(self._pose[:, :2] - self._pose[row, :2]).T) - self._radius_m - self._radius_m[row]
        apart_m[row] = np.inf
        return bool((apart_m < NEAR_M).any())  # a pose that is not known is not near
