"""Sends the tiles of the occupancy grid to the other robots and keeps theirs, and makes maps for planners of both.

At most `MOST_TILES` tiles a second leave a host: those that have changed first, then all others in turn, so that a host
that joins late or misses a message has the whole map soon. What others measured counts where this host knows nothing,
or where it is no contradiction of its own free cells: planners use it, the safety filter does not.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import numpy as np
import structlog

from fullswarm.agent.mapping.grid import FREE_BELOW
from fullswarm.agent.mapping.sense import RangeSense
from fullswarm.agent.neighbours.obstacle_map import OWN, SHARED, ObstacleMap
from fullswarm.bus.base import Bus
from fullswarm.errors import MessageError
from fullswarm.kernels import Array, Flags
from fullswarm.keys import Keys
from fullswarm.maps.boxes import boxes
from fullswarm.maps.tiles import MOST_TILES, OCCUPIED, SIDE, UNKNOWN, GridPlace, pack, place_of, unpack
from fullswarm.messages import GridTiles
from fullswarm.runtime import Scheduler

log = structlog.get_logger()

SHARE_S = 1.0
PLAN_S = 1.0
"""A planner gets another map at most so often: to find ways on it takes some 10 ms."""
COARSE_M = 0.1
"""Least cell of a planner's map."""
GAP_CELLS = 1
"""Gaps up to twice this are closed: no robot fits through, and each would be a passage to examine."""
EDGE_M = 0.1
"""What is so near the edge of the arena is its wall, which planners know."""


class GridSharing:
    """The grids of the other hosts, and the maps of planners.

    Parameters
    ----------
    listed : hosts whose tiles are taken; those of strangers are not
    """

    def __init__(
        self, bus: Bus, keys: Keys, scheduler: Scheduler, host: str, sense: RangeSense, obstacle_map: ObstacleMap,
        bounds_m: Sequence[float], listed: Collection[str],
    ) -> None:  # fmt: skip
        self._bus, self._keys, self._scheduler, self._host = bus, keys, scheduler, host
        self._sense, self._map, self._bounds_m, self._listed = sense, obstacle_map, bounds_m, frozenset(listed)
        place = sense.grid.place
        self.others = np.full((place.rows, place.columns), UNKNOWN, np.uint8)
        self._next_tile = 0
        self._share_at_s = self._plan_at_s = -math.inf
        self._changed = False
        self._warned = False
        self._planned: Flags | None = None
        self._subscription = bus.subscribe(keys.grid(), GridTiles, self._on_tiles)

    def update(self, now_s: float) -> None:
        """Send what is due, and give planners a new map if there is one; called ten times a second."""
        self._changed |= bool(self._sense.grid.changed.any())
        if now_s >= self._share_at_s:
            self._share_at_s = now_s + SHARE_S
            self._share(now_s)
        if self._changed and now_s >= self._plan_at_s:
            self._plan_at_s, self._changed = now_s + PLAN_S, False
            self._plan()

    def _share(self, now_s: float) -> None:
        grid = self._sense.grid
        tiles = np.flatnonzero(grid.changed)[:MOST_TILES].tolist()
        grid.changed[tiles] = False
        states = grid.states()
        for _ in range(grid.place.tiles):
            if len(tiles) >= MOST_TILES:
                break
            self._next_tile = (self._next_tile + 1) % grid.place.tiles
            if self._next_tile not in tiles and grid.place.tile(states, self._next_tile).any():
                tiles.append(self._next_tile)
        if tiles:
            self._bus.publish(self._keys.grid(self._host), pack(grid.place, states, tiles, self._host, now_s))

    def _on_tiles(self, message: GridTiles) -> None:
        if message.host == self._host or message.host not in self._listed:
            return
        try:
            if place_of(message) != self._sense.grid.place:
                if not self._warned:
                    self._warned = True
                    log.warning("a grid of other bounds or cells is left out", host=message.host)
                return
            tiles = unpack(message)
        except MessageError as error:
            log.warning("a grid is left out", reason=str(error))
            return
        for number, states in tiles:
            known = self._sense.grid.place.tile(self.others, number)
            taken = np.where(states == UNKNOWN, known, states)
            self._changed |= not np.array_equal(taken, known)
            known[:] = taken

    def _plan(self) -> None:
        own = self._sense.occupied()
        both = own | ((self.others == OCCUPIED) & ~(self._sense.grid.odds < FREE_BELOW))
        place = self._sense.grid.place
        if self._planned is not None and np.array_equal(both, self._planned):
            return
        self._planned = both
        own_boxes = planning_boxes(own, place, self._bounds_m)
        shared = own_boxes if np.array_equal(own, both) else planning_boxes(both, place, self._bounds_m)
        self._map.set_measured({OWN: own_boxes, SHARED: shared})

    def close(self) -> None:
        """Drop the subscription."""
        self._subscription.close()


def planning_boxes(occupied: Flags, place: GridPlace, bounds_m: Sequence[float]) -> Array:
    """Return a planner's map of a grid: few boxes (k, 6), without the arena's edge, gaps and holes that hold no robot.

    Without SciPy gaps and holes stay; a planner that needs it says so itself.
    """
    factor = next(each for each in (1, 2, 4, 8, 16, SIDE) if each * place.cell_m >= COARSE_M or each == SIDE)
    rows, columns = place.rows // factor, place.columns // factor
    coarse = occupied.reshape(rows, factor, columns, factor).any(axis=(1, 3))
    cell_m = factor * place.cell_m
    x = place.x_min + (np.arange(columns) + 0.5) * cell_m
    y = place.y_min + (np.arange(rows) + 0.5) * cell_m
    inner_x = (x > bounds_m[0] + EDGE_M) & (x < bounds_m[2] - EDGE_M)
    inner_y = (y > bounds_m[1] + EDGE_M) & (y < bounds_m[3] - EDGE_M)
    coarse &= inner_y[:, None] & inner_x[None, :]
    if not coarse.any():
        return np.zeros((0, 6))
    try:
        from scipy import ndimage
    except ImportError:
        return boxes(coarse, place.x_min, place.y_min, cell_m)
    wide = ndimage.binary_closing(np.pad(coarse, 2), np.ones((3, 3)), iterations=GAP_CELLS)
    filled: Flags = ndimage.binary_fill_holes(wide)[2:-2, 2:-2]
    return boxes(filled, place.x_min, place.y_min, cell_m)
