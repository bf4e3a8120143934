"""Bodies that no agent commands: each goes along its waypoints at a constant speed, whatever is in its way.

To the engines and the referee a mover is a solid disc among the obstacles that is elsewhere in each step; it pushes
and is not pushed. Its rows come after those of boxes and walls.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from fullswarm.config import MoverConfig, WorldConfig
from fullswarm.kernels import Array
from fullswarm.simulation.obstacles import static_obstacles


class Movers:
    """The movers of a world.

    Attributes
    ----------
    radius_m : (m,)
    place : (m, 2) where they are, after the last `set_time`
    fastest_m_s : the greatest of their speeds
    """

    def __init__(self, settings: Sequence[MoverConfig]) -> None:
        self._settings = tuple(settings)
        self._points = [np.array(each.waypoints, float) for each in self._settings]
        for row, each in enumerate(self._settings):
            if each.repeat == "loop":
                self._points[row] = np.vstack([self._points[row], self._points[row][:1]])
        self._ends_m = [np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(way, axis=0).T))]) for way in self._points]
        self.radius_m = np.array([each.radius_m for each in self._settings])
        self.fastest_m_s = max((each.speed_m_s for each in self._settings), default=0.0)
        self.place = np.zeros((len(self._settings), 2))
        self.set_time(0.0)

    def __len__(self) -> int:
        return len(self._settings)

    def set_time(self, time_s: float) -> None:
        """Put all of them where they are at `time_s`."""
        for row, (each, points, ends_m) in enumerate(zip(self._settings, self._points, self._ends_m, strict=True)):
            gone_m, length_m = max(0.0, time_s - each.start_s) * each.speed_m_s, float(ends_m[-1])
            if length_m > 0.0 and each.repeat == "loop":
                gone_m = math.fmod(gone_m, length_m)
            elif length_m > 0.0 and each.repeat == "back":
                gone_m = math.fmod(gone_m, 2.0 * length_m)
                gone_m = min(gone_m, 2.0 * length_m - gone_m)
            self.place[row, 0] = np.interp(gone_m, ends_m, points[:, 0])
            self.place[row, 1] = np.interp(gone_m, ends_m, points[:, 1])

    def bodies(self) -> Array:
        """Return centre x, y and radius of each, (m, 3) m."""
        return np.column_stack([self.place, self.radius_m])


def solid_rows(config: WorldConfig) -> Array:
    """Return boxes, walls, then the movers where they start, rows as in ``Reading.obstacles``, shape (k + m, 6)."""
    movers = Movers(config.movers)
    rows = np.zeros((len(movers), 6))
    rows[:, :2], rows[:, 5] = movers.place, movers.radius_m
    return np.vstack([static_obstacles(config), rows])
