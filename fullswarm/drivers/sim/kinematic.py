"""The kinematic engine: unicycles on exact arcs, solid discs, boxes and walls; no masses, no friction.

A list of pairs that may meet soon (`candidates`) is kept until bodies have moved far enough to change it; each
substep moves all bodies along their arcs, then pushes overlapping ones apart. See :mod:`kinematic_kernels`.
"""

from __future__ import annotations

import numpy as np

import fullswarm
from fullswarm.config import WorldConfig
from fullswarm.drivers.base import Array
from fullswarm.drivers.sim.engine import static_obstacles
from fullswarm.drivers.sim.kinematic_kernels import SCRATCH_COLUMNS, advance


def with_trigonometry(obstacles: Array) -> Array:
    """Return (k, 8): centre, half sizes, cos and sin of the yaw, corner radius, radius of the enclosing disc."""
    x, y, half_x, half_y, yaw, corner = obstacles.T
    reach = np.hypot(half_x, half_y) + corner
    return np.ascontiguousarray(np.stack([x, y, half_x, half_y, np.cos(yaw), np.sin(yaw), corner, reach], axis=1))


class KinematicEngine:
    """An :class:`~fullswarm.drivers.sim.engine.Engine` over arrays."""

    def __init__(self, config: WorldConfig, starts: Array) -> None:
        n = len(starts)
        self.firmware = f"kinematic {fullswarm.__version__}"
        self.pose = np.array(starts, dtype=float).reshape(n, 3)
        self.twist = np.zeros((n, 2))
        self.contacts = np.zeros(n, np.int64)
        self._obstacles = with_trigonometry(static_obstacles(config))
        self._scratch = np.zeros((n, SCRATCH_COLUMNS))
        self._state = np.array([0.0, -1.0])  # metres moved since the list was made, its skin (m); -1: no list
        self._counts = np.zeros(1, np.int64)
        self._grid = np.zeros(8 * n + 64, np.int64)
        self._radius_m, self._dt_s = float(config.radius_m), 1.0 / config.rate_hz
        self._substeps = int(config.substeps)
        self._allocate(16 * n + 64)
        self.pairs = self._pairs[:0]

    def _allocate(self, capacity: int) -> None:
        self._candidates = np.zeros((capacity, 4), np.int64)
        self._pairs = np.zeros((capacity, 2), np.int64)

    def step(self, twists: Array) -> None:
        """Advance one world step."""
        touching = self._advance(twists)
        while touching < 0:
            # Nothing was changed yet: the list of candidates did not fit.
            self._allocate(2 * len(self._candidates))
            touching = self._advance(twists)
        self.pairs = self._pairs[:touching]

    def _advance(self, twists: Array) -> int:
        return advance.run(
            self.pose,
            twists,
            self.twist,
            self.contacts,
            self._pairs,
            self._obstacles,
            self._scratch,
            self._candidates,
            self._grid,
            self._state,
            self._counts,
            self._radius_m,
            self._dt_s,
            self._substeps,
        )

    def close(self) -> None:
        """Do nothing: there is nothing to let go of."""
