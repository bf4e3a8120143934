"""The kinematic engine: unicycles on exact arcs, solid discs, boxes and walls; no masses, no friction.

A list of pairs that may meet soon (`candidates`) is kept until bodies have moved far enough to change it; each
substep moves all bodies along their arcs, then pushes overlapping ones apart. See :mod:`kinematic_kernels`.
"""

from __future__ import annotations

import numpy as np

import fullswarm
from fullswarm.config import WorldConfig
from fullswarm.drivers.sim.contacts import ContactReferee
from fullswarm.drivers.sim.kinematic_kernels import SCRATCH_COLUMNS, advance
from fullswarm.drivers.sim.obstacles import static_obstacles, with_trigonometry
from fullswarm.kernels import Array


class KinematicEngine:
    """An :class:`~fullswarm.drivers.sim.engine.Engine` over arrays."""

    def __init__(self, config: WorldConfig, starts: Array) -> None:
        n = len(starts)
        self.firmware = f"kinematic {fullswarm.__version__}"
        self.pose = np.array(starts, dtype=float).reshape(n, 3)
        self.twist = np.zeros((n, 2))
        self._obstacles = with_trigonometry(static_obstacles(config))
        self._substeps = int(config.substeps)
        self._dt_s = 1.0 / config.rate_hz
        # Each substep has two parts: bodies move, then they are pushed apart at once.
        part_s = np.repeat(np.arange(1, self._substeps + 1, dtype=np.float64), 2) * (self._dt_s / self._substeps)
        self.referee = ContactReferee(config, self._obstacles, n, part_s)
        self._scratch = np.zeros((n, SCRATCH_COLUMNS))
        self._state = np.array([0.0, -1.0])  # metres moved since the list was made, its skin (m); -1: no list
        self._counts = np.zeros(1, np.int64)
        self._grid = np.zeros(8 * n + 64, np.int64)

    def step(self, twists: Array) -> None:
        """Advance one world step."""
        while not self._advance(twists):
            # Nothing was changed yet: the list of candidates did not fit.
            self.referee.allocate(2 * len(self.referee.candidates))
        self.referee.publish()

    def _advance(self, twists: Array) -> bool:
        referee = self.referee
        return advance.run(
            self.pose,
            twists,
            self.twist,
            self._obstacles,
            self._scratch,
            referee.candidates,
            self._grid,
            self._state,
            self._counts,
            referee.radius_m,
            self._dt_s,
            self._substeps,
            referee.touch_m,
            referee.path,
            referee.near_room,
            referee.gap_room,
            referee.pair_room,
            referee.contacts,
            referee.found,
        )

    def close(self) -> None:
        """Do nothing: there is nothing to let go of."""
