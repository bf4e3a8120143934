"""Watches the bodies of a trial: through their world where it is simulated, else by what the robots report.

A world knows where bodies are and which of them touch, whatever noise or network faults are injected. Robots report
poses from their estimator and contacts from their bumpers; what they touched is then inferred from the distance to the
nearest robot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.safety.barrier import box_gap
from fullswarm.bus.base import Bus
from fullswarm.config import SwarmConfig
from fullswarm.drivers.base import Limits
from fullswarm.evaluate.swarm import Numbers, finite
from fullswarm.evaluate.trial_folder import GRAIN_M, Contacts
from fullswarm.kernels import Array, Index, kernel
from fullswarm.keys import Keys
from fullswarm.messages import HealthReport, RobotHealth, RobotStates
from fullswarm.perf.calculators import CollisionCalculator
from fullswarm.perf.truth import Truth
from fullswarm.simulation.world import World


@kernel
def pair_index(i: int, j: int, n: int) -> int:
    """Return where the pair `i` < `j` of `n` robots stands in the order (0, 1), (0, 2), …, (1, 2), … of all pairs."""
    return i * n - i * (i + 1) // 2 + j - i - 1


@kernel
def approach(
    time_s: float, before: Array, pose: Array, radius: Array, near: Index, gaps: Array, least: Array, at_s: Array,
    judged: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Take in one step: pairs in `near` came as close as `gaps`, others moved straight from `before` to `pose`."""
    n = pose.shape[0]
    furthest = 0.0
    for i in range(n):
        dx, dy = pose[i, 0] - before[i, 0], pose[i, 1] - before[i, 1]
        furthest = max(furthest, dx * dx + dy * dy)
    slack = 2.0 * math.sqrt(furthest)
    for m in range(near.shape[0]):
        if near[m, 1] >= 0:
            pair = pair_index(min(near[m, 0], near[m, 1]), max(near[m, 0], near[m, 1]), n)
            judged[pair] = True
            if gaps[m] < least[pair]:
                least[pair], at_s[pair] = gaps[m], time_s
    pair = -1
    for i in range(n):
        for j in range(i + 1, n):
            pair += 1
            if judged[pair]:
                judged[pair] = False
                continue
            both = radius[i] + radius[j]
            x, y = pose[j, 0] - pose[i, 0], pose[j, 1] - pose[i, 1]
            far = least[pair] + both + slack
            if x * x + y * y >= far * far:
                continue
            x, y = before[j, 0] - before[i, 0], before[j, 1] - before[i, 1]
            along_x = pose[j, 0] - pose[i, 0] - x
            along_y = pose[j, 1] - pose[i, 1] - y
            length = along_x * along_x + along_y * along_y
            if length > 0.0:
                part = min(1.0, max(0.0, -(x * along_x + y * along_y) / length))
                x += part * along_x
                y += part * along_y
            gap = math.sqrt(x * x + y * y) - both
            if gap < least[pair]:
                least[pair], at_s[pair] = gap, time_s
    for i in range(n):
        before[i, 0], before[i, 1] = pose[i, 0], pose[i, 1]


class Approaches:
    """The closest approach of each pair of n robots, from `pose` (n, 3) on.

    Attributes
    ----------
    least_m, at_s : (n (n - 1) / 2,) gap between the rims, and the end of the step in which it was; pairs in the order
        (0, 1), (0, 2), …, (1, 2), …
    """

    def __init__(self, pose: Array, radius_m: Array) -> None:
        n = len(pose)
        self._before, self._radius_m = np.array(pose[:, :2]), np.array(radius_m, float)
        self.least_m, self.at_s = np.full(n * (n - 1) // 2, math.inf), np.zeros(n * (n - 1) // 2)
        self._judged = np.zeros(n * (n - 1) // 2, np.bool_)

    def sample(self, time_s: float, pose: Array, near: Index, gaps_m: Array) -> None:
        """Take in one step.

        Parameters
        ----------
        time_s : its end
        pose : (n, 3) true
        near, gaps_m : (m, 2), (m,) pairs that a referee followed within the step (the second row < 0: no robot)
        """
        approach.run(
            time_s, self._before, pose, self._radius_m, near, gaps_m, self.least_m, self.at_s, self._judged
        )  # fmt: skip


TOLERANCE = 1e-9
ENDLESS = Limits(speed_m_s=np.inf, turn_rad_s=np.inf, accel_m_s2=np.inf, turn_accel_rad_s2=np.inf)
NEAR_M = 0.1
"""A robot whose bumper is pressed has met another one when the gap between their estimated poses is below this."""
USUAL_RADIUS_M = 0.17
"""Of a robot that has not reported its radius yet."""


class Referee:
    """Counts contacts and commands above the limits, after each step of the world, and keeps what proves the count.

    Parameters
    ----------
    world : its bodies are watched
    limits : what the driver of each robot reports as its limits

    Attributes
    ----------
    pairs : which pairs of robots have touched, as (row, higher row)
    touched : (n,) which robots have touched anything
    """

    def __init__(self, world: World, limits: Sequence[Limits]) -> None:
        count = len(world.ids)
        self._world = world
        self._most = np.array([(each.speed_m_s, each.turn_rad_s) for each in limits]) * (1.0 + TOLERANCE)
        self.robots, self.obstacles = CollisionCalculator(count), CollisionCalculator(count)
        self.pairs: set[tuple[int, int]] = set()
        self.touched = np.zeros(count, np.bool_)
        self._counts = np.zeros((2, count), np.int64)
        self._steps = 0
        self._approaches = Approaches(world.pose, world.radius_m)
        self._xy = [world.pose[:, :2].copy()]
        self._bends: list[tuple[int, NDArray[np.int64], Array]] = []
        self.above_limits = 0

    def sample(self) -> None:
        """Take in the last step."""
        world, counts, found = self._world, self._counts, self._world.referee
        self._steps += 1
        self._xy.append(world.pose[:, :2].copy())
        self._approaches.sample(self._steps * world.dt_s, world.pose, found.near, found.near_gap_m)
        counts[:] = 0
        if len(found.pairs):
            for first, second in found.pairs.tolist():
                if second >= 0:
                    counts[0, first] += 1
                    counts[0, second] += 1
                    self.pairs.add((min(first, second), max(first, second)))
                else:
                    counts[1, first] += 1
            rows = np.flatnonzero(found.contacts)
            self.touched[rows] = True
            self._bends.append((self._steps, rows, found.path[1:, rows].swapaxes(0, 1).copy()))
        self.robots.update(world.time_s, counts[0])
        self.obstacles.update(world.time_s, counts[1])
        if (np.abs(world.target) > self._most).any():
            self.above_limits += int((np.abs(world.target) > self._most).any(axis=1).sum())

    @property
    def closest_m(self) -> float:
        """The least gap between two robots so far; inf: there is one, or no step yet."""
        return float(self._approaches.least_m.min(initial=np.inf))

    def evidence(self) -> Contacts:
        """Return what is needed to count the contacts again."""
        world, found = self._world, self._world.referee
        bends = [(step, row, way) for step, rows, ways in self._bends for row, way in zip(rows, ways, strict=True)]
        xy = _grains(np.array(self._xy)) if bends else np.zeros((0, len(world.ids), 2), np.int32)
        steps, rows = (np.array([each[column] for each in bends], np.int32) for column in (0, 1))
        ways = _grains(np.array([way for *_, way in bends]).reshape(-1, len(found.part_s), 2))
        starts = xy[steps - 1, rows].reshape(-1, 1, 2)
        return Contacts(
            ids=world.ids,
            radius_m=world.radius_m.copy(),
            obstacles=np.array(world.obstacles),
            touch_m=found.touch_m,
            step_s=world.dt_s,
            closest_m=self._approaches.least_m.astype(np.float32),
            closest_s=np.round(self._approaches.at_s, 6),
            part_s=found.part_s,
            xy=np.diff(xy, axis=0, prepend=np.int32(0)),
            bend_step=steps,
            bend_robot=rows,
            bend=np.diff(ways, axis=1, prepend=starts),
        )


def _grains(at_m: Array) -> NDArray[np.int32]:
    return np.round(at_m / GRAIN_M).astype(np.int32)


class ContactTally(NamedTuple):
    """What a witness counts."""

    robot_events: Index  # (n,) contacts with robots, one for each of the two
    obstacle_events: Index  # (n,)
    pairs_touched: int | None  # pairs of robots that have touched; None: not known
    robots_touched: int  # robots that have touched anything
    above_limits: int  # commands beyond the actuators' limits; 0 where they cannot be seen


class Witness(Protocol):
    """Watches n bodies."""

    def begin(self) -> None:
        """Count from now on."""
        ...

    def sample(self) -> None:
        """Take in what has happened since the last call."""
        ...

    def touched(self) -> NDArray[np.bool_]:
        """Return which robots have touched anything since this was asked last, (n,)."""
        ...

    @property
    def pose(self) -> Array:
        """Where they are now, (n, 3) m, m, rad; NaN: unknown."""
        ...

    @property
    def radius_m(self) -> Array:
        """Their sizes, (n,)."""
        ...

    def tally(self) -> ContactTally:
        """Return what has been counted so far."""
        ...

    def evidence(self) -> Contacts | None:
        """Return what is needed to count the contacts again; None: not known."""
        ...

    def values(self) -> Numbers:
        """Return the true numbers of the swarm; none where the robots' own data is all there is."""
        ...

    def per_robot(self) -> Mapping[str, Numbers]:
        """Return the same by robot."""
        ...


class WorldWitness:
    """Watches the bodies of a simulated world; to be called after each of its steps.

    Parameters
    ----------
    goals : (n, 2), each reached within `goal_radius_m`
    cell_m : of the true coverage grid
    emulated : firmware stands between the commands and the bodies, so commands are not seen here
    """

    def __init__(self, world: World, goals: Array, goal_radius_m: float, cell_m: float, emulated: bool = False) -> None:
        self._world, self._steps = world, 0
        self._limits = [ENDLESS if emulated else each.limits for each in world.descriptions]
        self._touched = np.zeros(len(world.ids), bool)
        about = world.ids, self.radius_m, goals, goal_radius_m, world.config.bounds_m, cell_m
        # Kernels are compiled when they first run: not while robots drive in a world that this process steps.
        Truth(*about).sample(0.0, world.pose, world.twist, world.dt_s, world.contacts)
        Referee(world, self._limits).sample()
        self.truth: Truth = Truth(*about)
        self._referee = Referee(world, self._limits)

    def begin(self) -> None:
        """Watch from where the bodies are now."""
        self._referee = Referee(self._world, self._limits)

    def sample(self) -> None:
        """Take in one step of the world."""
        world = self._world
        self._steps += 1
        self._referee.sample()
        self.truth.sample(self._steps * world.dt_s, world.pose, world.twist, world.dt_s, world.contacts)
        self._touched |= world.contacts > 0

    def touched(self) -> NDArray[np.bool_]:
        """Return which robots have touched anything since this was asked last."""
        found, self._touched = self._touched, np.zeros(len(self._touched), bool)
        return found

    @property
    def pose(self) -> Array:
        """The true poses."""
        return self._world.pose

    @property
    def radius_m(self) -> Array:
        """The true sizes."""
        return self._world.radius_m

    def tally(self) -> ContactTally:
        """Return what the referee has counted."""
        found = self._referee
        return ContactTally(
            robot_events=found.robots.events,
            obstacle_events=found.obstacles.events,
            pairs_touched=len(found.pairs),
            robots_touched=int(found.touched.sum()),
            above_limits=found.above_limits,
        )

    def evidence(self) -> Contacts:
        """Return the referee's."""
        return self._referee.evidence()

    def values(self) -> dict[str, float]:
        """Return the true numbers; the smallest gap is the referee's, which looks into each step."""
        return finite({**self.truth.values(), "separation.min_m": self._referee.closest_m})

    def per_robot(self) -> dict[str, dict[str, float]]:
        """Return the same by robot."""
        return self.truth.per_robot()


class ReportedWitness:
    """Takes what robots report, in their states and health reports, from the moment it is made."""

    def __init__(self, bus: Bus, config: SwarmConfig) -> None:
        count = len(config.robots)
        self._rows = {robot: row for row, robot in enumerate(config.robots)}
        self._pose = np.full((count, 3), np.nan)
        self._radius_m = np.full(count, USUAL_RADIUS_M)
        self._touched = np.zeros(count, bool)
        self._reported = np.full(count, -1, np.int64)  # collisions in the newest report; -1: none yet
        self._events = np.zeros((2, count), np.int64)
        keys = Keys(config.swarm)
        self._subscriptions = [
            bus.subscribe(keys.state(), RobotStates, self._on_states, latest=True),
            bus.subscribe(keys.health(), HealthReport, self._on_health),
        ]

    def begin(self) -> None:
        """Forget the contacts from before."""
        self._events[:] = 0
        self._touched[:] = False

    def sample(self) -> None:
        """Do nothing: messages arrive by themselves."""

    def touched(self) -> NDArray[np.bool_]:
        """Return which robots have reported a contact since this was asked last."""
        found, self._touched = self._touched, np.zeros(len(self._touched), bool)
        return found

    @property
    def pose(self) -> Array:
        """The robots' own estimates."""
        return self._pose

    @property
    def radius_m(self) -> Array:
        """What their drivers report."""
        return self._radius_m

    def tally(self) -> ContactTally:
        """Return what the robots have counted, by what was nearest at the time; a bumper does not tell the pair."""
        return ContactTally(self._events[0], self._events[1], None, int(self._events.any(axis=0).sum()), 0)

    def evidence(self) -> None:
        """Robots keep none."""
        return

    def values(self) -> dict[str, float]:
        """Return nothing: robots can be wrong about themselves."""
        return {}

    def per_robot(self) -> dict[str, dict[str, float]]:
        """Return nothing, for the same reason."""
        return {}

    def close(self) -> None:
        """Subscribe to nothing more."""
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
        new = health.collisions - self._reported[row] if self._reported[row] >= 0 else 0
        self._reported[row] = health.collisions
        self._touched[row] |= health.contacts > 0 or new > 0
        if new > 0:
            self._events[0 if self._beside_another(row) else 1, row] += new

    def _beside_another(self, row: int) -> bool:
        apart_m = np.hypot(*(self._pose[:, :2] - self._pose[row, :2]).T) - self._radius_m - self._radius_m[row]
        apart_m[row] = np.inf
        return bool((apart_m < NEAR_M).any())  # a pose that is not known is not near


def in_safe_set(world: World, margin_m: float) -> bool:
    """Return whether every gap between bodies, boxes, walls and the arena's edge is at least the filter's margin."""
    position, radius_m = world.pose[:, :2], world.radius_m
    apart = position[:, None] - position[None, :]
    distance = np.hypot(apart[..., 0], apart[..., 1])
    np.fill_diagonal(distance, np.inf)
    if (distance < radius_m[:, None] + radius_m[None, :] + margin_m).any():
        return False
    clearance_m = (radius_m + margin_m)[:, None]
    low, high = np.array(world.config.bounds_m).reshape(2, 2)
    inside: NDArray[np.bool_] = (position >= low + clearance_m) & (position <= high - clearance_m)
    return bool(inside.all()) and all(
        box_gap.run(x, y, world.obstacles, row)[0] >= each_m + margin_m
        for (x, y), each_m in zip(position, radius_m, strict=True)
        for row in range(len(world.obstacles))
    )
