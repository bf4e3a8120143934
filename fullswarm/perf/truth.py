"""Measures what the true bodies did: poses and twists after each step of the world, numbers named as a summary's.

A referee's account, free of noise, of odometry's drift and of the network: what the swarm reports of itself is compared
with it. One call of one kernel per step; nothing is allocated. A supervisory process (paper II.F.1) publishes it as the
measurement of the host ``truth``:

    truth = Truth(...)                                       # fed with `sample` after each step of the world
    node = SupervisorCalculator(bus, keys, scheduler, truth)
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fullswarm.bus.base import Bus
from fullswarm.kernels import Array, kernel
from fullswarm.keys import TRUTH, Keys
from fullswarm.messages import RobotMeasurement
from fullswarm.perf import shape
from fullswarm.perf.calculators import MASS_KG, Counts, CoverageCalculator, Grid, cover, spend, touch
from fullswarm.perf.coverage import Bounds
from fullswarm.perf.metrics import SHAPE
from fullswarm.runtime import Scheduler

# Columns of the state, one row per robot.
X, Y, HEADING, DISTANCE, ENTERED, SPENT, KINETIC = range(7)
# Numbers of the whole swarm.
LEAST_GAP, ROOM, BEGAN = range(3)


@kernel
def smallest_gap(pose: Array, radius: Array) -> float:
    """Return the smallest distance between the rims of two bodies, negative when they overlap."""
    least = math.inf
    for i in range(pose.shape[0]):
        for j in range(i):
            dx, dy = pose[i, 0] - pose[j, 0], pose[i, 1] - pose[j, 1]
            reach = least + radius[i] + radius[j]
            apart = dx * dx + dy * dy
            if reach > 0.0 and apart < reach * reach:
                least = math.sqrt(apart) - radius[i] - radius[j]
    return least


@kernel
def observe(
    time_s: float, pose: Array, twist: Array, contacts: Counts, radius: Array, mass: Array, goals: Array,
    goal_radius: float, state: Array, swarm: Array, touching: Grid, touched_s: Array, events: Counts,
    dt_s: float, marked: Array, grid: Grid, x0: float, y0: float, cell: float,
) -> int:  # fmt: skip
    """Take in one step; return how many cells of `grid` are new.

    Parameters
    ----------
    state : (n, 7) where the body was, its way, since when it is at its goal (NaN: it is not), its energy
    swarm : (3,) smallest gap so far, how far two bodies may approach before it can be undercut, first time
    """
    if math.isnan(swarm[BEGAN]):
        swarm[BEGAN] = time_s - dt_s
    furthest = 0.0
    for i in range(pose.shape[0]):
        x, y = float(pose[i, 0]), float(pose[i, 1])
        if not math.isnan(state[i, X]):
            dx, dy = x - state[i, X], y - state[i, Y]
            step = math.sqrt(dx * dx + dy * dy)
            state[i, DISTANCE] += step
            furthest = max(furthest, step)
        state[i, X], state[i, Y], state[i, HEADING] = x, y, float(pose[i, 2])
        gx, gy = x - goals[i, 0], y - goals[i, 1]
        if gx * gx + gy * gy <= goal_radius * goal_radius:  # false for a goal of NaN
            if math.isnan(state[i, ENTERED]):
                state[i, ENTERED] = time_s - swarm[BEGAN]
        else:
            state[i, ENTERED] = math.nan
    spend(twist, radius, mass, state[:, SPENT:], dt_s)
    # Two bodies approach by two steps at most: while that leaves the smallest gap alone the pairs are not compared.
    swarm[ROOM] -= 2.0 * furthest
    if swarm[ROOM] <= 0.0 and pose.shape[0] > 1:
        gap = smallest_gap(pose, radius)
        swarm[LEAST_GAP] = min(swarm[LEAST_GAP], gap)
        swarm[ROOM] = gap - swarm[LEAST_GAP]
    touch(time_s, contacts, touching, touched_s, events)
    return cover(pose, radius, marked, grid, x0, y0, cell)


class Truth:
    """What n bodies did since the first sample.

    Parameters
    ----------
    ids
        The robots, in the order of the rows.
    radius_m : (n,)
    goals : (n, 2)
        NaN for a robot that has none.
    goal_radius_m
        A robot whose centre is so close has arrived.
    bounds_m, cell_m
        The arena and the cell size of the coverage grid.
    mass_kg : one for all or (n,)

    Raises
    ------
    ConfigError
        The arena is empty or has too many cells.
    """

    def __init__(
        self,
        ids: Sequence[str],
        radius_m: Array,
        goals: Array,
        goal_radius_m: float,
        bounds_m: Bounds,
        cell_m: float,
        mass_kg: float | Array = MASS_KG,
    ) -> None:
        n = len(ids)
        self.ids = tuple(ids)
        self.coverage = CoverageCalculator(bounds_m, cell_m, radius_m)
        self._radius = np.array(np.broadcast_to(np.asarray(radius_m, float), (n,)))
        self._mass = np.array(np.broadcast_to(np.asarray(mass_kg, float), (n,)))
        self._goals, self._goal_radius_m = np.array(goals, float).reshape(n, 2), float(goal_radius_m)
        self._state = np.zeros((n, 7))
        self._state[:, [X, Y, HEADING, ENTERED, KINETIC]] = math.nan
        self._swarm = np.array([math.inf, 0.0, math.nan])
        self.events = np.zeros(n, np.int64)
        self._touching, self._touched_s = np.zeros(n, np.uint8), np.full(n, -math.inf)
        self._untouched, self.contacts_seen = np.zeros(n, np.int64), False
        self._bounds_m = bounds_m

    def sample(self, time_s: float, pose: Array, twist: Array, dt_s: float, contacts: Counts | None = None) -> None:
        """Take in one step of the world.

        Parameters
        ----------
        time_s, dt_s
            The world's time after the step, and the step. Times of arrival count from the beginning of the first.
        pose : (n, 3) true
        twist : (n, 2) true, m/s and rad/s
        contacts : (n,) bodies and obstacles touched; without them there is no ``collisions``
        """
        self.contacts_seen |= contacts is not None
        coverage, frame = self.coverage, self.coverage.frame
        coverage.covered += observe.run(
            time_s, pose, twist, self._untouched if contacts is None else contacts, self._radius, self._mass,
            self._goals, self._goal_radius_m, self._state, self._swarm, self._touching, self._touched_s, self.events,
            dt_s, coverage.marked, coverage.grid, frame.origin_x_m, frame.origin_y_m, frame.cell_m,
        )  # fmt: skip

    def leave_out(self, rows: NDArray[np.bool_]) -> None:
        """Take their goals from robots, (n,): they cannot arrive, and have not."""
        self._goals[rows] = math.nan
        self._state[rows, ENTERED] = math.nan

    @property
    def distance_m(self) -> NDArray[np.float64]:
        """The way of each robot, (n,) m."""
        return self._state[:, DISTANCE]

    @property
    def arrived(self) -> NDArray[np.bool_]:
        """Which robots are at their goals now, (n,)."""
        return ~np.isnan(self._state[:, ENTERED])

    def values(self) -> dict[str, float]:
        """Return the swarm's numbers; what has no meaning (a gap of one robot, the time of no robot) is left out."""
        n, frame, distance_m = len(self.ids), self.coverage.frame, self.distance_m
        total_m, covered = math.fsum(distance_m), self.coverage.covered
        values = {
            "work.total_m": total_m,
            "work.mean_m": total_m / n if n else 0.0,
            "work.max_m": float(distance_m.max(initial=0.0)),
            "coverage.fraction": covered / frame.cells,
            "coverage.area_m2": covered * frame.cell_area_m2,
            "energy.total_j": math.fsum(self._state[:, SPENT]),
        }
        if self.contacts_seen:
            values["collisions.events"] = float(self.events.sum())
            values["collisions.robots_touched"] = float((self.events > 0).sum())
        if math.isfinite(self._swarm[LEAST_GAP]):
            values["separation.min_m"] = float(self._swarm[LEAST_GAP])
        if self._have_goals:
            values |= self._arrival()
        seen = self._state[np.isfinite(self._state[:, X])]
        now = shape.values(seen[:, X], seen[:, Y], seen[:, HEADING], self._bounds_m)
        return values | {f"{SHAPE}.{name}": value for name, value in now.items()}

    def columns(self) -> dict[str, Array]:
        """Return the numbers per robot, (n,) each, by their names in ``metrics.py``."""
        state = self._state
        columns = {
            "x_m": state[:, X],
            "y_m": state[:, Y],
            "heading_rad": state[:, HEADING],
            "distance_m": state[:, DISTANCE],
            "energy_j": state[:, SPENT],
        }
        if self.contacts_seen:
            columns["events"] = self.events.astype(float)
        if self._have_goals:
            columns |= {"goal_m": self._goal_m(), "arrived_s": state[:, ENTERED]}
        return columns

    @property
    def _have_goals(self) -> bool:
        return bool(np.isfinite(self._goals).all(axis=1).any())

    def _goal_m(self) -> Array:
        apart = self._state[:, [X, Y]] - self._goals
        distance_m: Array = np.sqrt((apart * apart).sum(axis=1))
        return distance_m

    def per_robot(self) -> dict[str, dict[str, float]]:
        """Return the numbers by robot; one that is not at its goal has no ``arrival.arrived_s``."""
        numbers = {"work.distance_m": self.distance_m, "energy.energy_j": self._state[:, SPENT]}
        if self.contacts_seen:
            numbers["collisions.events"] = self.events.astype(float)
        table = {name: dict(zip(self.ids, column.tolist(), strict=True)) for name, column in numbers.items()}
        entered_s = self._state[:, ENTERED].tolist()
        table["arrival.arrived_s"] = {
            robot: time_s for robot, time_s in zip(self.ids, entered_s, strict=True) if not math.isnan(time_s)
        }
        return table

    def _arrival(self) -> dict[str, float]:
        times_s = self._state[self.arrived, ENTERED]
        goal_m = self._goal_m()
        values = {"arrival.fraction": len(times_s) / max(1, int(np.isfinite(self._goals).all(axis=1).sum()))}
        if np.isfinite(goal_m).any():
            values["formation.error_m"] = math.sqrt(float(np.nanmean(goal_m * goal_m)))
        if len(times_s):
            values["arrival.mean_s"] = math.fsum(times_s) / len(times_s)
            values["arrival.last_s"] = float(times_s.max())
        return values


PERIOD_S = 0.5


class SupervisorCalculator:
    """Publishes work, collisions, coverage, energy and arrival of all true bodies, twice a second.

    Parameters
    ----------
    process
        Unique per start of the process that sees the bodies.
    """

    def __init__(self, bus: Bus, keys: Keys, scheduler: Scheduler, truth: Truth, process: str = TRUTH) -> None:
        self._bus, self._keys, self._scheduler, self._truth = bus, keys, scheduler, truth
        self._process = process
        self._timer = scheduler.every(PERIOD_S, self.publish)

    def publish(self) -> None:
        """Publish everything now."""
        truth, now_s, keys = self._truth, self._scheduler.now_s(), self._keys
        ids = truth.ids
        self._bus.publish(keys.measurement("coverage", TRUTH), truth.coverage.message(TRUTH, ids, now_s))
        columns = {name: tuple(column.tolist()) for name, column in truth.columns().items()}
        numbers = RobotMeasurement(host=TRUTH, process=self._process, robots=ids, columns=columns, stamp_s=now_s)
        self._bus.publish(keys.measurement("robots", TRUTH), numbers)

    def close(self) -> None:
        """Publish the final numbers. Closing twice is fine."""
        self.publish()
        self._timer.cancel()
