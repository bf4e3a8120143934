"""Finds robots at standstill that are not on their way, and objects at standstill: a planner must lead around them.

A robot counts when it has not moved for some seconds and either says that it is driving nowhere, or says nothing, or is
silent. One that waits for its turn states where it is driving to, and is no obstacle. It stops counting when it moves
or states an aim. An object may be a robot that fell silent: what is left of its disc elsewhere does not say where.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fullswarm.agent.neighbours.estimates import Neighbours
from fullswarm.agent.neighbours.objects import MOST, Objects
from fullswarm.drivers.base import NO_OBSTACLES
from fullswarm.kernels import Array, Flags, kernel

STANDING_S = 3.0
MOVED_M = 0.1
"""A robot that is so far from where it was has moved; less is noise of its pose."""
AIM_M = 0.05
PERIOD_S = 0.5
FORGET_S = 5.0
"""After so long without a look it is not known who moved in between."""
RADIUS_STEP_M, OBJECT_STEP_M = 0.05, 0.02
"""Discs of silent robots and of objects count in steps of this, so that a plan around them stays valid for a while."""


class Watched(NamedTuple):
    """Where each robot stands and since when: `place` (m, 2), `since_s` (m,), `stands` (m,)."""

    place: Array
    since_s: Array
    stands: Flags


@kernel
def watch(now_s: float, places: Array, aims: Array, arrival_s: Array, count: int, watched: Watched) -> None:
    """Update `watched` for the first `count` robots or objects."""
    place, since_s, stands = watched
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
        stands[row] = known and not going and now_s - since_s[row] >= STANDING_S


def _nothing(size: int, now_s: float) -> Watched:
    return Watched(np.full((size, 2), math.nan), np.full(size, now_s), np.zeros(size, bool))


class Standing:
    """Watches neighbours and objects while a control law asks for it."""

    def __init__(self, neighbours: Neighbours, objects: Objects) -> None:
        self._neighbours, self._objects = neighbours, objects
        self._watched, self._watched_objects = _nothing(0, 0.0), _nothing(MOST, 0.0)
        self._last_s = -math.inf
        self._rows: list[int] = []
        self._discs = NO_OBSTACLES

    def around(self, own: int) -> Array:
        """Return the robots that stand now as rounded boxes (k, 6), without own robot `own`."""
        now_s = self._neighbours.now_s
        if not 0.0 <= now_s - self._last_s < PERIOD_S:
            self._look(now_s)
        if not len(self._discs):
            return NO_OBSTACLES
        mine = int(self._neighbours.own_row[own])
        if mine in self._rows:
            return np.delete(self._discs, self._rows.index(mine), axis=0)
        return self._discs

    def _look(self, now_s: float) -> None:
        neighbours, count = self._neighbours, self._neighbours.count
        neighbours.refresh(now_s)
        forgotten = not 0.0 <= now_s - self._last_s < FORGET_S
        if len(self._watched.since_s) < len(neighbours.states) or forgotten:
            self._watched = _nothing(len(neighbours.states), now_s)
        if forgotten:
            self._watched_objects = _nothing(MOST, now_s)
        self._last_s = now_s
        watch.run(now_s, neighbours.places, neighbours.aims, neighbours.arrival_s, count, self._watched)
        self._rows = np.flatnonzero(self._watched.stands[:count]).tolist()
        self._discs = self._as_obstacles(self._rows)
        used = int(self._objects.used[0])
        if used:
            aims, arrival_s = np.full((used, 2), math.nan), np.zeros(used)
            watch.run(now_s, self._objects.rows, aims, arrival_s, used, self._watched_objects)
            still = np.flatnonzero(self._watched_objects.stands[:used])
            objects = np.zeros((len(still), 6))
            objects[:, :2] = np.round(self._watched_objects.place[still], 2)
            objects[:, 5] = np.ceil(self._objects.rows[still, 4] / OBJECT_STEP_M - 1e-6) * OBJECT_STEP_M
            self._discs = np.vstack([self._discs, objects])

    def _as_obstacles(self, rows: list[int]) -> Array:
        neighbours = self._neighbours
        discs = np.zeros((len(rows), 6))
        discs[:, :2] = np.round(self._watched.place[rows], 2)
        silent = np.isnan(neighbours.predicted[rows, 0])
        spread_m = np.where(silent, neighbours.spread_m[rows], 0.0)
        discs[:, 5] = neighbours.states[rows, 5] + np.ceil(spread_m / RADIUS_STEP_M) * RADIUS_STEP_M
        return discs
