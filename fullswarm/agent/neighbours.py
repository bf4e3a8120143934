"""States heard from other robots, with their age; and whose states to listen to."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent import pairs
from fullswarm.bus.base import Bus, Subscription
from fullswarm.keys import ANY, WHOLE_SWARM_CELL, Keys, cells_within
from fullswarm.messages import RobotStates

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MANY_CELLS = 64


class Neighbours:
    """The newest state of every robot heard, as arrays that grow with the swarm.

    Attributes
    ----------
    heard : (m, 6) x, y, heading, speed, turn rate, radius as told
    arrival_s : (m,) when, on this machine's clock
    predicted : (m, 2) positions moved on to the time of the last `look`, filled by `within`; NaN when too old
    """

    def __init__(self, ids: tuple[str, ...], timeout_s: float) -> None:
        self._own = ids
        self._alone = ids if len(ids) == 1 else None
        self._timeout_s = timeout_s
        self._row_of: dict[str, int] = {}
        self._batch: tuple[tuple[str, ...], Index] | None = None
        self._newest: dict[str, tuple[int, float]] = {}
        self._now_s, self._stale = 0.0, True
        self.count = 0
        self.own_row = np.full(len(ids), -1, np.int64)
        self._lists: dict[float, tuple[Index, Index]] = {}
        self.heard = np.zeros((0, 6))
        self.arrival_s = np.zeros(0)
        self.predicted = np.zeros((0, 2))
        self.spread_m = np.zeros(0)
        self.accel_m_s2 = self.turn_rad_s = 0.0
        self._grow(max(16, len(ids)))

    def hear(self, states: RobotStates, now_s: float) -> None:
        """Take in the states of one host.

        Ignored: a message older than the last from that host, one whose columns do not fit together, and on board
        the own state; a robot with a number that is not finite counts as not heard.
        """
        if states.robots == self._alone:
            return
        newest = self._newest.get(states.host)
        # A sequence that falls while the sender's clock goes on means that the host was restarted. The same
        # sequence comes once per grid cell.
        if newest and states.sequence < newest[0] and states.stamp_s <= newest[1]:
            return
        if not _fits(states):
            return
        self._newest[states.host] = (states.sequence, states.stamp_s)
        if len(states.robots) == 1:
            self._hear_one(states, now_s)
            return
        rows = self._rows(states.robots)
        heard = self.heard
        heard[rows, 0] = states.x_m
        heard[rows, 1] = states.y_m
        heard[rows, 2] = states.heading_rad
        heard[rows, 3] = states.speed_m_s
        heard[rows, 4] = states.turn_rad_s
        heard[rows, 5] = states.radius_m
        self.arrival_s[rows] = np.where(np.isfinite(heard[rows].sum(axis=1)), now_s, -math.inf)

    def _hear_one(self, states: RobotStates, now_s: float) -> None:
        """Do the same for a host with one robot, number by number: what an agent does a hundred times a second."""
        row = self._row_of.get(states.robots[0])
        if row is None:
            row = int(self._rows(states.robots)[0])
        x_m, y_m, heading_rad = states.x_m[0], states.y_m[0], states.heading_rad[0]
        speed_m_s, turn_rad_s, radius_m = states.speed_m_s[0], states.turn_rad_s[0], states.radius_m[0]
        heard = self.heard
        heard[row, 0] = x_m
        heard[row, 1] = y_m
        heard[row, 2] = heading_rad
        heard[row, 3] = speed_m_s
        heard[row, 4] = turn_rad_s
        heard[row, 5] = radius_m
        finite = math.isfinite(x_m + y_m + heading_rad + speed_m_s + turn_rad_s + radius_m)
        self.arrival_s[row] = now_s if finite else -math.inf

    def look(self, now_s: float) -> None:
        """Say that `within` is about `now_s` from here on."""
        self._now_s, self._stale = now_s, True

    def _predict(self) -> None:
        """Move all heard positions on to the time of the last `look`: only when somebody asks."""
        self._stale, now_s = False, self._now_s
        pairs.predict.run(
            self.heard, self.arrival_s, self.count, now_s, self._timeout_s, self.accel_m_s2, self.turn_rad_s,
            self.predicted, self.spread_m,
        )  # fmt: skip

    def within(self, position: Array, reach_m: float) -> tuple[Index, Index]:
        """Find who is within `reach_m` of each own robot at the time of the last `look`.

        Returns
        -------
        start : (n + 1,)
        other : (capacity,) rows; neighbours of robot i are ``other[start[i]:start[i + 1]]``. Both are reused.
        """
        if self._stale:
            self._predict()
        count = self.count
        start, other = self._lists.get(reach_m) or (np.zeros(len(position) + 1, np.int64), np.zeros(64, np.int64))
        search = pairs.all_pairs if len(position) * count <= pairs.BRUTE_FORCE_BELOW else pairs.cell_pairs
        found = search.run(position, self.own_row, self.predicted, count, reach_m, start, other)
        if found > len(other):
            other = np.zeros(2 * found, np.int64)
            search(position, self.own_row, self.predicted, count, reach_m, start, other)
        self._lists[reach_m] = (start, other)
        return start, other

    def oldest_age_s(self, now_s: float) -> float:
        """Return the age of the stalest state that still counts; 0 when nobody is heard."""
        ages = now_s - self.arrival_s[: self.count]
        fresh = ages[ages <= self._timeout_s]
        return float(fresh.max()) if len(fresh) else 0.0

    def _rows(self, robots: tuple[str, ...]) -> Index:
        if self._batch is not None and self._batch[0] == robots:
            return self._batch[1]
        for robot in robots:
            if robot not in self._row_of:
                self._row_of[robot] = self.count
                self.count += 1
                if robot in self._own:
                    self.own_row[self._own.index(robot)] = self._row_of[robot]
        self._grow(self.count)
        rows = np.array([self._row_of[robot] for robot in robots], np.int64)
        if len(robots) > 1:
            self._batch = (robots, rows)
        return rows

    def _grow(self, count: int) -> None:
        if count > len(self.heard):
            more = max(count, 2 * len(self.heard)) - len(self.heard)
            self.heard = np.vstack([self.heard, np.zeros((more, 6))])
            self.arrival_s = np.concatenate([self.arrival_s, np.full(more, -math.inf)])
            self.spread_m = np.concatenate([self.spread_m, np.zeros(more)])
            self.predicted = np.vstack([self.predicted, np.full((more, 2), math.nan)])


def _fits(states: RobotStates) -> bool:
    """Tell whether the columns have one length: a stranger's message must not end an agent."""
    x_m, y_m, heading_rad = states.x_m, states.y_m, states.heading_rad
    speed_m_s, turn_rad_s, radius_m = states.speed_m_s, states.turn_rad_s, states.radius_m
    count = len(states.robots)
    fits = count == len(x_m) == len(y_m) == len(heading_rad)
    return fits and count == len(speed_m_s) == len(turn_rad_s) == len(radius_m)


class Listening:
    """Subscriptions to the states of the grid cells around the own robots; they follow as the robots move."""

    def __init__(self, bus: Bus, keys: Keys, cell_m: float, hear: Callable[[RobotStates], None]) -> None:
        self._bus, self._keys, self._cell_m, self._hear = bus, keys, cell_m, hear
        self._cells: dict[str, Subscription] = {}

    def follow(self, position: Array, reach_m: float) -> None:
        """Subscribe to the cells within `reach_m` of `position` (n, 2), drop those left behind.

        Where that would be more than `MANY_CELLS`, one subscription to all cells is cheaper.
        """
        wanted = {WHOLE_SWARM_CELL} if self._cell_m <= 0.0 else self._around(position, reach_m)
        for cell in wanted - self._cells.keys():
            self._cells[cell] = self._bus.subscribe(self._keys.state(cell), RobotStates, self._hear, latest=True)
        for cell in self._cells.keys() - wanted:
            self._cells.pop(cell).close()

    def _around(self, position: Array, reach_m: float) -> set[str]:
        if (2.0 * reach_m / self._cell_m + 1.0) ** 2 > MANY_CELLS:
            return {ANY}
        wanted: set[str] = set()
        for x_m, y_m in position.tolist():
            if math.isfinite(x_m) and math.isfinite(y_m):
                wanted |= cells_within(x_m, y_m, reach_m, self._cell_m)
            if len(wanted) > MANY_CELLS:
                return {ANY}
        return wanted

    def close(self) -> None:
        """Drop all subscriptions."""
        for subscription in self._cells.values():
            subscription.close()
        self._cells.clear()
