"""Finds the robots at standstill that are not on their way: a planner must lead around them.

A robot counts when it has not moved for some seconds and either says that it is driving nowhere, or says nothing, or is
silent. One that waits for its turn states where it is driving to, and is no obstacle. It stops counting when it moves
or states an aim.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fullswarm.agent.neighbours.estimates import Neighbours
from fullswarm.drivers.base import NO_OBSTACLES
from fullswarm.kernels import Array, Flags, kernel

STANDING_S = 3.0
MOVED_M = 0.1
"""A robot that is so far from where it was has moved; less is noise of its pose."""
AIM_M = 0.05
PERIOD_S = 0.5
FORGET_S = 5.0
"""After so long without a look it is not known who moved in between."""
RADIUS_STEP_M = 0.05
"""A silent robot's disc counts in steps of this, so that a plan around it stays valid for a while."""


class Watched(NamedTuple):
    """Where each robot stands and since when: `place` (m, 2), `since_s` (m,), `stands` (m,)."""

    place: Array
    since_s: Array
    stands: Flags


@kernel
def watch(now_s: float, places: Array, aims: Array, arrival_s: Array, count: int, watched: Watched) -> int:
    """Update `watched` for the first `count` robots; return how many changes there are among those that stand."""
    place, since_s, stands = watched
    changes = 0
    for row in range(count):
        x = places[row, 0]
        y = places[row, 1]
        known = math.isfinite(x + y) and math.isfinite(arrival_s[row])
        aim_x = aims[row, 0]
        aim_y = aims[row, 1]
        # The aim was stated from where the robot was then; a silent one has none any more.
        going = math.isfinite(aim_x + aim_y) and math.hypot(aim_x - x, aim_y - y) > AIM_M
        going = going and now_s - arrival_s[row] < STANDING_S
        if not known or not math.hypot(x - place[row, 0], y - place[row, 1]) <= MOVED_M:
            place[row, 0] = x
            place[row, 1] = y
            since_s[row] = now_s
        still = known and not going and now_s - since_s[row] >= STANDING_S
        changes += still != stands[row]
        stands[row] = still
    return changes


class Standing:
    """Watches the neighbours while a control law asks for it."""

    def __init__(self, neighbours: Neighbours) -> None:
        self._neighbours = neighbours
        self._watched = Watched(np.zeros((0, 2)), np.zeros(0), np.zeros(0, bool))
        self._last_s = -math.inf
        self._rows: list[int] = []
        self._discs = NO_OBSTACLES

    def around(self, own: int) -> Array:
        """Return the robots that stand now as rounded boxes (k, 6), without own robot `own`."""
        now_s = self._neighbours.now_s
        if not 0.0 <= now_s - self._last_s < PERIOD_S:
            self._look(now_s)
        if not self._rows:
            return NO_OBSTACLES
        mine = int(self._neighbours.own_row[own])
        if mine in self._rows:
            return self._discs[[row != mine for row in self._rows]]
        return self._discs

    def _look(self, now_s: float) -> None:
        neighbours, count = self._neighbours, self._neighbours.count
        neighbours.refresh(now_s)
        if len(self._watched.since_s) < len(neighbours.states) or not 0.0 <= now_s - self._last_s < FORGET_S:
            size = len(neighbours.states)
            self._watched = Watched(np.full((size, 2), math.nan), np.full(size, now_s), np.zeros(size, bool))
        self._last_s = now_s
        changes = watch.run(now_s, neighbours.places, neighbours.aims, neighbours.arrival_s, count, self._watched)
        if changes or self._rows:
            self._rows = np.flatnonzero(self._watched.stands[:count]).tolist()
            self._discs = self._as_obstacles(self._rows)

    def _as_obstacles(self, rows: list[int]) -> Array:
        neighbours = self._neighbours
        discs = np.zeros((len(rows), 6))
        discs[:, :2] = np.round(self._watched.place[rows], 2)
        silent = np.isnan(neighbours.predicted[rows, 0])
        spread_m = np.where(silent, neighbours.spread_m[rows], 0.0)
        discs[:, 5] = neighbours.states[rows, 5] + np.ceil(spread_m / RADIUS_STEP_M) * RADIUS_STEP_M
        return discs
