"""Calculators (paper II.F.1): what each robot measures of itself. In: poses, contacts. Out: columns, coverage.

They run in the agent, for the n robots that it hosts: n is 1 on board, the whole swarm in lockstep. State is
allocated once; an update is a single kernel call. Everything is cumulative, so a lost message costs nothing.

What driving costs is a proxy, the same for the true bodies and for what robots measure of themselves. The motors give
the kinetic energy that a robot gains (braking gives nothing back) and what rolling takes:

    E = sum of max(0, T(t + dt) - T(t)) + c m g (|v - w b| + |v + w b|) / 2 dt,   T = m v^2 / 2 + m r^2 w^2 / 4

with wheels at b = 0.75 r from the middle, a body like a homogeneous disc and c = 0.02 (small rubber wheels on a hard
floor). Heat of the motors and electronics are left out: it compares behaviours, it sizes no battery.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fullswarm.bus.base import Bus
from fullswarm.kernels import Array, kernel
from fullswarm.keys import Keys
from fullswarm.messages import CoverageMeasurement
from fullswarm.perf.coverage import Bounds, GridFrame, pack

MASS_KG = 3.6
"""A Create with its battery."""
GRAVITY_M_S2 = 9.81
ROLLING = 0.02
"""Rolling resistance over weight."""
WHEEL_RADII = 0.75
"""Where the wheels are, from the middle, in radii of the body."""
STILL_M_S = 1e-3
"""A wheel that is slower does not count as turning."""


@kernel
def spend(twist: Array, radius: Array, mass: Array, energy: Array, dt_s: float) -> None:
    """Add what one period cost to `energy` (n, 2): joules so far; kinetic energy at the last call, NaN before it."""
    for i in range(twist.shape[0]):
        v, w = float(twist[i, 0]), float(twist[i, 1])
        if not (math.isfinite(v) and math.isfinite(w)):
            continue
        rim = radius[i] * w
        kinetic = mass[i] * (0.5 * v * v + 0.25 * rim * rim)
        gained = kinetic - energy[i, 1]
        if gained > 0.0:  # false at the first call
            energy[i, 0] += gained
        energy[i, 1] = kinetic
        wheel = WHEEL_RADII * rim
        way = 0.5 * (math.fabs(v - wheel) + math.fabs(v + wheel)) * dt_s
        energy[i, 0] += ROLLING * GRAVITY_M_S2 * mass[i] * way


@kernel
def smoothness(setpoints: Array, radius: Array, last: Array, sums: Array) -> None:
    """Add one period's changes of the set-points (n, 2) to `sums` (n, 3).

    Parameters
    ----------
    last : (n, 4) in and out: speed and turn rate, NaN before the first call, and the direction of the left and of the
        right wheel: -1, 1, or 0 while it has not turned yet
    sums : (n, 3) in and out: reversals, mean of both wheels; changes of the speed in m/s and of the turn rate in rad/s,
        each counted without its sign
    """
    for i in range(setpoints.shape[0]):
        v, w = float(setpoints[i, 0]), float(setpoints[i, 1])
        if not (math.isfinite(v) and math.isfinite(w)):
            continue
        if not math.isnan(last[i, 0]):
            if v == last[i, 0] and w == last[i, 1]:
                continue
            sums[i, 1] += math.fabs(v - last[i, 0])
            sums[i, 2] += math.fabs(w - last[i, 1])
        last[i, 0], last[i, 1] = v, w
        rim = WHEEL_RADII * radius[i] * w
        for side in range(2):
            wheel = v - rim if side == 0 else v + rim
            if math.fabs(wheel) > STILL_M_S:
                direction = 1.0 if wheel > 0.0 else -1.0
                if direction * last[i, 2 + side] < 0.0:  # a stop between the two directions changes nothing
                    sums[i, 0] += 0.5
                last[i, 2 + side] = direction


Counts = NDArray[np.int64]
Grid = NDArray[np.uint8]

FREE_S = 0.25
"""Contact must have been absent for this long before another one counts as a new event."""

SILENCE_S = 1.0
"""A position that did not change for longer explains no larger step than one of this age."""

# All kernels live in one file: numba's disk cache notices a change of the caller's file only.


@kernel
def travel(
    now_s: float, dt_s: float, position: Array, max_speed: Array, last: Array, moved_s: Array, distance: Array
) -> None:
    """Add each robot's step to its `distance` (n,).

    A step above twice what `max_speed` (n,) allows since the position last changed is a jump (a reset
    odometry, a re-localised pose): it is not travel. Counting from the last change keeps a robot that reports
    at 10 Hz to a 50 Hz loop honest; `dt_s`, the nominal period, is the least time assumed.
    """
    for i in range(position.shape[0]):
        x, y = float(position[i, 0]), float(position[i, 1])
        if not (math.isfinite(x) and math.isfinite(y)):
            continue
        if not math.isnan(last[i, 0]):
            dx, dy = x - float(last[i, 0]), y - float(last[i, 1])
            step = math.sqrt(dx * dx + dy * dy)  # a third of hypot's time
            if step == 0.0:
                continue
            elapsed_s = min(max(now_s - moved_s[i], dt_s), SILENCE_S)
            if step <= 2.0 * max_speed[i] * elapsed_s:
                distance[i] += step
        last[i, 0], last[i, 1] = x, y
        moved_s[i] = now_s


@kernel
def touch(now_s: float, contacts: Counts, touching: Grid, touched_s: Array, events: Counts) -> None:
    """Count in `events` (n,) each contact that begins at least `FREE_S` after the last one was seen."""
    for i in range(contacts.shape[0]):
        if contacts[i] > 0:
            # `touching`: a loop that hung during one long contact must not count it twice.
            if touching[i] == 0 and now_s - touched_s[i] >= FREE_S - 1e-9:
                events[i] += 1
            touching[i] = 1
            touched_s[i] = now_s
        else:
            touching[i] = 0


@kernel
def cover(position: Array, radius: Array, marked: Array, grid: Grid, x0: float, y0: float, cell: float) -> int:
    """Set the cells of `grid` whose centres lie in the robots' discs; return how many are new.

    A robot that moved less than a quarter cell since its last mark is skipped.
    """
    rows, columns = grid.shape
    near, per_m, new = 0.0625 * cell * cell, 1.0 / cell, 0
    for i in range(position.shape[0]):
        x, y = float(position[i, 0]), float(position[i, 1])
        if not (math.isfinite(x) and math.isfinite(y)):
            continue
        dx, dy = x - float(marked[i, 0]), y - float(marked[i, 1])
        if dx * dx + dy * dy < near:  # false while `marked` is NaN
            continue
        marked[i, 0], marked[i, 1] = x, y
        # In units of cells, with centres on whole numbers. Every cell of the bounding square is tested and
        # written: without a branch that is twice as fast as finding the ends of each row.
        column_x, row_y, reach = (x - x0) * per_m - 0.5, (y - y0) * per_m - 0.5, radius[i] * per_m
        row_from = int(min(max(row_y - reach, 0.0), float(rows)))
        row_end = int(min(max(row_y + reach + 1.0, 0.0), float(rows)))
        column_from = int(min(max(column_x - reach, 0.0), float(columns)))
        column_end = int(min(max(column_x + reach + 1.0, 0.0), float(columns)))
        for row in range(row_from, row_end):
            room = reach * reach - (row - row_y) * (row - row_y)
            for column in range(column_from, column_end):
                before = grid[row, column]
                after = before | ((column - column_x) * (column - column_x) <= room)
                grid[row, column] = after
                new += int(after) - int(before)
    return new


@kernel
def measure(
    now_s: float, dt_s: float, travelled: Array, pose: Array, contacts: Counts, twist: Array, setpoints: Array,
    max_speed: Array, last: Array, moved_s: Array, distance: Array,
    touching: Grid, touched_s: Array, events: Counts,
    mass: Array, energy: Array, last_setpoints: Array, changes: Array,
    radius: Array, marked: Array, grid: Grid, x0: float, y0: float, cell: float,
) -> int:  # fmt: skip
    """Run all five in one call: crossing into compiled code costs more than the work of a small swarm."""
    travel(now_s, dt_s, travelled, max_speed, last, moved_s, distance)
    touch(now_s, contacts, touching, touched_s, events)
    spend(twist, radius, mass, energy, dt_s)
    smoothness(setpoints, radius, last_setpoints, changes)
    return cover(pose, radius, marked, grid, x0, y0, cell)


class WorkCalculator:
    """Distance travelled by each of n robots since the start, in metres, in `distance_m` (n,)."""

    def __init__(self, n: int, max_speed_m_s: float | Sequence[float] | Array) -> None:
        self.max_speed_m_s = np.array(np.broadcast_to(np.asarray(max_speed_m_s, float), (n,)))
        self.distance_m = np.zeros(n)
        self.last = np.full((n, 2), math.nan)
        self.moved_s = np.full(n, math.nan)

    def update(self, now_s: float, position: Array, dt_s: float) -> None:
        """Take in positions (n, 2 or more) of any one frame; a row with NaN is skipped."""
        travel(now_s, dt_s, position, self.max_speed_m_s, self.last, self.moved_s, self.distance_m)


class CollisionCalculator:
    """Contact events of each of n robots since the start, in `events` (n,)."""

    def __init__(self, n: int) -> None:
        self.events = np.zeros(n, np.int64)
        self.touching = np.zeros(n, np.uint8)
        self.touched_s = np.full(n, -math.inf)

    def update(self, now_s: float, contacts: Counts) -> None:
        """Take in how many bodies each robot touches now, (n,)."""
        touch(now_s, contacts, self.touching, self.touched_s, self.events)


class CoverageCalculator:
    """Cells that the robots of one host have covered together, in `grid` (rows, columns) of 0 and 1."""

    def __init__(self, bounds_m: Bounds, cell_m: float, radii_m: Sequence[float] | Array) -> None:
        self.frame = GridFrame.over(bounds_m, cell_m)
        self.radii_m = np.array(radii_m, float)
        self.grid = np.zeros((self.frame.rows, self.frame.columns), np.uint8)
        self.marked = np.full((len(self.radii_m), 2), math.nan)
        self.covered = 0
        self._packed, self._packed_at = b"", -1

    def update(self, position: Array) -> None:
        """Mark what the robots at world positions (n, 2 or more) cover; a row with NaN is skipped."""
        frame = self.frame
        self.covered += cover(
            position, self.radii_m, self.marked, self.grid, frame.origin_x_m, frame.origin_y_m, frame.cell_m
        )

    def message(self, host: str, robots: tuple[str, ...], now_s: float) -> CoverageMeasurement:
        """Return the measurement of a host's robots, cumulative since the start."""
        frame = self.frame
        return CoverageMeasurement(
            host=host,
            robots=robots,
            origin_x_m=frame.origin_x_m,
            origin_y_m=frame.origin_y_m,
            cell_m=frame.cell_m,
            rows=frame.rows,
            columns=frame.columns,
            cells=self.packed(),
            stamp_s=now_s,
        )

    def packed(self) -> bytes:
        """Return the grid as it goes over the bus; packed again only when cells were added."""
        if self._packed_at != self.covered:
            self._packed, self._packed_at = pack(self.grid), self.covered
        return self._packed


class EnergyCalculator:
    """What driving cost each of n robots since the start, in joules: see :mod:`fullswarm.perf.calculators`."""

    def __init__(self, n: int, mass_kg: float = MASS_KG) -> None:
        self.mass_kg = np.full(n, mass_kg)
        self.state = np.zeros((n, 2))
        self.state[:, 1] = math.nan
        self.energy_j = self.state[:, 0]
        self.unknown = np.full((n, 2), math.nan)


class SmoothnessCalculator:
    """How often the wheels of each of n robots reverse and how much its set-points change, summed since the start.

    Attributes
    ----------
    reversals : (n,) how often a wheel's commanded speed changed its sign, mean of both wheels
    speed_variation_m_s, turn_variation_rad_s : (n,) total variation of the commanded speed and turn rate
    """

    def __init__(self, n: int) -> None:
        self.last = np.zeros((n, 4))
        self.last[:, :2] = math.nan
        self.changes = np.zeros((n, 3))
        self.reversals, self.speed_variation_m_s, self.turn_variation_rad_s = self.changes.T
        self.unknown = np.full((n, 2), math.nan)

    def update(self, setpoints: Array, radius_m: Array) -> None:
        """Take in what the drivers applied in one period, (n, 2) m/s and rad/s; a row with NaN is skipped."""
        smoothness(setpoints, radius_m, self.last, self.changes)


class Calculators:
    """The calculators of the robots `ids`, updated by one kernel call and published together.

    Parameters
    ----------
    ids
        The n robots of this host, in the order of the rows.
    bounds_m, cell_m
        The arena and the cell size of the coverage grid; the same for every host of a swarm.
    radii_m
        Radius of each robot's footprint, (n,).
    max_speed_m_s
        What the robots can do, one for all or (n,); faster steps are taken for jumps of the sensor.

    Raises
    ------
    ConfigError
        The arena is empty or has too many cells.
    """

    def __init__(
        self,
        ids: Sequence[str],
        bounds_m: Bounds,
        cell_m: float,
        radii_m: Sequence[float] | Array,
        max_speed_m_s: float | Sequence[float] | Array,
    ) -> None:
        self.ids = tuple(ids)
        self.work = WorkCalculator(len(self.ids), max_speed_m_s)
        self.collision = CollisionCalculator(len(self.ids))
        self.coverage = CoverageCalculator(bounds_m, cell_m, radii_m)
        self.energy = EnergyCalculator(len(self.ids))
        self.smoothness = smooth = SmoothnessCalculator(len(self.ids))
        self._with_grid = False
        work, collision, coverage, frame = self.work, self.collision, self.coverage, self.coverage.frame
        self._kept = (
            work.max_speed_m_s, work.last, work.moved_s, work.distance_m,
            collision.touching, collision.touched_s, collision.events, self.energy.mass_kg, self.energy.state,
            smooth.last, smooth.changes,
            coverage.radii_m, coverage.marked, coverage.grid, frame.origin_x_m, frame.origin_y_m, frame.cell_m,
        )  # fmt: skip

    @property
    def energy_j(self) -> Array:
        """What driving cost per robot since the start, (n,)."""
        return self.energy.energy_j

    @property
    def collisions(self) -> Counts:
        """Contact events per robot since the start, (n,); for health reports."""
        return self.collision.events

    @property
    def distance_m(self) -> Array:
        """Distance travelled per robot since the start, (n,)."""
        return self.work.distance_m

    def update(
        self,
        now_s: float,
        pose: Array,
        contacts: Counts,
        dt_s: float,
        odometry: Array | None = None,
        twist: Array | None = None,
        setpoints: Array | None = None,
    ) -> None:
        """Take in one control period.

        Parameters
        ----------
        now_s, dt_s
            The agent's time and its nominal period.
        pose
            World x, y, … (n, 2 or more), NaN where unknown.
        contacts
            Bodies touched now, int64 (n,).
        odometry
            Positions to measure the distance by, (n, 2 or more); `pose` when None. Noise of a pose adds up
            to metres that no robot drove, so odometry is the better source where there is any.
        twist
            Speed and turn rate as measured, (n, 2), NaN where unknown; None: no energy is counted.
        setpoints
            Speed and turn rate that the drivers applied, (n, 2); None: no reversals are counted.
        """
        self.coverage.covered += measure.run(
            now_s, dt_s, pose if odometry is None else odometry, pose, contacts,
            self.energy.unknown if twist is None else twist,
            self.smoothness.unknown if setpoints is None else setpoints, *self._kept,
        )  # fmt: skip

    def columns(self) -> dict[str, Array]:
        """Return the numbers per robot, (n,) each, by their names in ``metrics.py``; cumulative since the start."""
        smooth = self.smoothness
        return {
            "distance_m": self.distance_m,
            "events": self.collisions.astype(float),
            "energy_j": self.energy_j,
            "reversals": smooth.reversals,
            "speed_variation_m_s": smooth.speed_variation_m_s,
            "turn_variation_rad_s": smooth.turn_variation_rad_s,
        }

    def publish(self, bus: Bus, keys: Keys, host: str, now_s: float, *, whole: bool = True) -> None:
        """Publish the grid of `host`, cumulative since the start; unless `whole` every second time only.

        It is larger than all else together.
        """
        self._with_grid = whole or not self._with_grid
        if self._with_grid:
            bus.publish(keys.measurement("coverage", host), self.coverage.message(host, self.ids, now_s))
