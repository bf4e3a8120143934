"""Keeps the static obstacles that robots know: from the given map, from their own sensors, from other robots.

An obstacle is a row of six numbers as in ``Reading.obstacles``. It is known once it was seen within the sensing radius
and is never forgotten: the arena is taken for static. What another host has seen counts until that host's next report:
so a false one does not stay, and it is neither taken for an own sighting nor passed on. What hosts report that are not
of the fleet file is forgotten with them.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.safety.barrier import box_gap
from fullswarm.bus.base import Bus
from fullswarm.config import SwarmConfig
from fullswarm.kernels import Array, kernel
from fullswarm.keys import Keys
from fullswarm.messages import SeenObstacles
from fullswarm.recent import Names
from fullswarm.runtime import Scheduler

GIVEN, SHARED, OWN = "given", "shared", "own"
SHARE_PERIOD_S = 2.0
STRANGERS, MOST_TOLD = 64, 64
"""Hosts that are not of the fleet file, and obstacles of each, at most."""
MOST = 1000
"""Obstacles that robots have sensed, that one host reports, and that are known together, at most: a sender on the bus
must not fill a robot's memory."""


@kernel
def notice(position: Array, obstacles: Array, count: int, reach_m: float, seen: NDArray[np.bool_]) -> int:
    """Mark in `seen` (n, capacity) which of the obstacles each robot sees; return how many marks are new."""
    new = 0
    for i in range(position.shape[0]):
        for k in range(count):
            if not seen[i, k] and box_gap(position[i, 0], position[i, 1], obstacles, k)[0] <= reach_m:
                seen[i, k] = True
                new += 1
    return new


class ObstacleMap:
    """The obstacles that n robots know.

    Parameters
    ----------
    given : (k, 6) the map; may be empty
    """

    def __init__(self, count: int, given: Array) -> None:
        self.given = given
        self._index: dict[bytes, int] = {}
        self._rows = np.zeros((16, 6))
        self._seen = np.zeros((count, 16), bool)
        self._last: Array | None = None
        self._known: dict[tuple[str, int], Array] = {}
        self._told: dict[str, Array] = {}
        self._measured: dict[str, Array] = {}

    def add_sensed(self, position: Array, obstacles: Array, reach_m: float) -> int:
        """Take in what the robots sense now, (k, 6) of all of them together; return how much of it is new."""
        if obstacles is not self._last:
            self._last = obstacles
            for row in obstacles:
                self._add(row)
        new = notice.run(position, self._rows, len(self._index), reach_m, self._seen)
        if new:
            self._known.clear()
        return int(new)

    def seen(self) -> Array:
        """Return what these robots have seen themselves, (k, 6)."""
        return self._rows[: len(self._index)][self._seen[:, : len(self._index)].any(axis=0)]

    def add_told(self, host: str, obstacles: Array, most: int = MOST_TOLD) -> None:
        """Take in what another host has seen, (k, 6), in place of what it reported before; only rows that are boxes."""
        rows, before = obstacles[_sound(obstacles)][:most], self._told.get(host)
        if before is None or not np.array_equal(rows, before):
            self._told[host] = rows
            self._known.clear()

    def forget_told(self, host: str) -> None:
        """Forget what a host has reported."""
        if self._told.pop(host, None) is not None:
            self._known.clear()

    def set_measured(self, rows: Mapping[str, Array]) -> None:
        """Set what range sensors have measured, (k, 6) of OWN and of SHARED, in place of what they had before."""
        self._measured = dict(rows)
        self._known.clear()

    def known(self, row: int, source: str) -> Array:
        """Return the obstacles (k, 6) that robot `row` knows from `source`: GIVEN, SHARED or OWN."""
        if source == GIVEN:
            return self.given
        key = (source, row if source == OWN else 0)
        found = self._known.get(key)
        if found is None:
            rows = self._rows[: len(self._index)]
            own = source == OWN
            found = rows[self._seen[row, : len(rows)]] if own else self._union(rows)
            if source in self._measured:
                found = np.concatenate([found, self._measured[source]])
            self._known[key] = found
        return found

    def _union(self, rows: Array) -> Array:
        """Return the rows and what others have reported, each obstacle once; of the longest reports not all."""
        reports = list(self._told.values())
        if len(rows) + sum(map(len, reports)) > MOST:
            reports.sort(key=len)  # one host that reports too much takes no room from the others
        table = np.concatenate([rows, *reports])
        _, first = np.unique(_rounded(table), axis=0, return_index=True)
        return table[np.sort(first)[:MOST]]

    def _add(self, row: Array) -> None:
        name = _rounded(row).tobytes()
        if name in self._index or len(self._index) >= MOST:
            return
        place = self._index[name] = len(self._index)
        if place == len(self._rows):
            self._rows = np.vstack([self._rows, np.zeros_like(self._rows)])
            self._seen = np.hstack([self._seen, np.zeros_like(self._seen)])
        self._rows[place] = row


def _rounded(rows: Array) -> Array:
    """Return what is the same for copies of an obstacle that were rounded elsewhere; there is one zero."""
    return np.asarray(np.round(rows, 3) + 0.0)


def _sound(obstacles: Array) -> NDArray[np.bool_]:
    """Tell which rows are boxes."""
    sizes = np.column_stack([obstacles[:, 2:4], obstacles[:, 5]])
    return np.asarray(np.isfinite(obstacles).all(axis=1) & (sizes >= 0.0).all(axis=1), np.bool_)


def map_of(config: SwarmConfig) -> Array:
    """Return the map that the fleet file gives, (k, 6): its boxes; the arena's edge is known anyway."""
    boxes = config.world.boxes if config.world else ()
    rows = [(x, y, size_x / 2, size_y / 2, yaw, 0.0) for x, y, size_x, size_y, yaw in boxes]
    return np.array(rows, float).reshape(-1, 6)


class ObstacleSharing:
    """Publishes the obstacles that these robots have sensed, and adds those of other robots to their map."""

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, host: str, obstacle_map: ObstacleMap,
        listed: Collection[str] = (),
    ) -> None:  # fmt: skip
        self._bus, self._keys, self._scheduler, self._host, self._map = bus, keys, scheduler, host, obstacle_map
        self._names = Names(STRANGERS, obstacle_map.forget_told, listed)
        self._share_at_s = -math.inf
        self._subscription = bus.subscribe(keys.obstacles(), SeenObstacles, self._on_obstacles, latest=True)

    def add_sensed(self, now_s: float, position: Array, obstacles: Array, reach_m: float) -> None:
        """Add what the robots sense now; publish when something is new or it is time."""
        self._names.sweep(now_s)
        if not len(obstacles):
            return
        new = self._map.add_sensed(position, obstacles, reach_m)
        if new or now_s >= self._share_at_s:
            self._share_at_s = now_s + SHARE_PERIOD_S
            rows = tuple(tuple(row) for row in self._map.seen().tolist())
            message = SeenObstacles(host=self._host, rows=rows, stamp_s=now_s)
            self._bus.publish(self._keys.obstacles(self._host), message)

    def _on_obstacles(self, seen: SeenObstacles) -> None:
        if seen.host == self._host or not self._names.admit(seen.host, self._scheduler.now_s()):
            return
        rows = np.array(seen.rows, float).reshape(-1, 6)
        self._map.add_told(seen.host, rows, MOST if seen.host in self._names.listed else MOST_TOLD)

    def close(self) -> None:
        """Drop the subscription."""
        self._subscription.close()
