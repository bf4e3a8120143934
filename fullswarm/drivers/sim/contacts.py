"""The referee of a world: which bodies touched during a step, decided alike for every engine.

Two bodies, or a body and an obstacle, touch when their rims come within `touch_m` of each other anywhere on the paths
that they took, substep by substep. An engine gives the paths; it is not asked what it thinks of contacts, because a
solver pushes fast bodies apart before they meet and forgets short contacts within a step.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fullswarm.config import WorldConfig
from fullswarm.drivers.sim.contact_kernels import may_touch, sweep
from fullswarm.kernels import Array

TOUCH_M = 0.002
"""Bodies of 0.17 m that meet at 4 + 4 m/s are pushed by Bullet at a gap of up to 1.5 mm, see `touch_m`."""
PUSHED = 3.0
"""The gap of two bodies shrinks by at most so many times the way of the fastest one: it and one pushed by others."""


def touch_m(config: WorldConfig) -> float:
    """Return the gap at or below which two bodies of a world touch.

    Bullet keeps two bodies of radius r apart along the line through their centres at the start of a substep. When they
    also move past each other by s in it, as in a graze, a gap of hypot(2 r, s) - 2 r stays.
    """
    substep_s = 1.0 / (config.rate_hz * config.substeps)
    both_m = 2.0 * config.radius_m
    return max(TOUCH_M, 1e-4 + math.hypot(both_m, 2.0 * config.speed_limit_m_s * substep_s) - both_m)


class ContactReferee:
    """Judges the paths of n bodies, step by step.

    Attributes
    ----------
    part_s : (p,) when the parts of a step end, since its start
    path : (p + 1, n, 2) m, written by the engine: centres at the start of a step and after each part of it
    contacts : (n,) bodies and obstacles that each body touched during the last step; the same array at all times
    pairs : (m, 2) who touched; the second is -1-k for obstacle k
    near, near_gap_m : (m, 2), (m,) pairs that were so close that they might have touched, and their smallest gaps
    """

    def __init__(self, config: WorldConfig, obstacles: Array, count: int, part_s: Array) -> None:
        self.radius_m, self.touch_m = float(config.radius_m), touch_m(config)
        self.obstacles = obstacles
        self.part_s, self.path = part_s, np.zeros((len(part_s) + 1, count, 2))
        self.contacts = np.zeros(count, np.int64)
        self.found = np.zeros(2, np.int64)
        self._anchor, self._state = np.full((count, 2), math.inf), np.array([-1.0])
        self._counts, self._grid = np.zeros(1, np.int64), np.zeros(8 * count + 64, np.int64)
        self._marked = np.zeros(count, np.bool_)
        self._listed = 0
        self.allocate(16 * count + 64)
        self._sweep()  # compiles it, where kernels are: not when the first two robots meet

    def allocate(self, capacity: int) -> None:
        """Make room for so many candidates."""
        self.candidates = np.zeros((capacity, 4), np.int64)
        self.near_room, self.gap_room = np.zeros((capacity, 2), np.int64), np.zeros(capacity)
        self.pair_room = np.zeros((capacity, 2), np.int64)

    def reach_m(self, furthest_m: float) -> float:
        """Return the gap from which bodies can touch in a step in which the fastest one drives `furthest_m`."""
        return PUSHED * furthest_m + self.touch_m

    def look_ahead(self, pose: Array, furthest_m: float) -> list[int]:
        """Return the rows of the bodies that may touch something in the next step, in which none drives further."""
        listed = self._look(pose, furthest_m)
        while listed < 0:
            self.allocate(2 * len(self.candidates))
            listed = self._look(pose, furthest_m)
        self._listed = listed
        rows: list[int] = np.flatnonzero(self._marked).tolist() if listed else []
        return rows

    def _look(self, pose: Array, furthest_m: float) -> int:
        return may_touch.run(
            pose, self.obstacles, self.radius_m, self.reach_m(furthest_m), self._anchor, self._state, self._counts,
            self.candidates, self._grid, self.near_room, self._marked,
        )  # fmt: skip

    def judge(self) -> None:
        """Take in the paths of those whom `look_ahead` has named."""
        if self._listed or len(self.near):
            self._sweep()

    def _sweep(self) -> None:
        sweep.run(
            self.path, self.obstacles, self.radius_m, self.touch_m, math.inf, self.near_room, self._listed,
            self.near_room, self.gap_room, self.pair_room, self.contacts, self.found,
        )  # fmt: skip
        self.publish()

    def publish(self) -> None:
        """Show what the kernel has found."""
        listed, touching = self.found.tolist()
        self.near: NDArray[np.int64] = self.near_room[:listed]
        self.near_gap_m: Array = self.gap_room[:listed]
        self.pairs: NDArray[np.int64] = self.pair_room[:touching]
