"""Bodies that no agent commands: each goes from waypoint to waypoint, whatever is in its way.

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


class Way:
    """The way of one mover: it stops at each waypoint, as a person does who turns round."""

    def __init__(self, settings: MoverConfig) -> None:
        self._settings = settings
        points = np.array(settings.waypoints, float)
        if settings.repeat == "loop":
            points = np.vstack([points, points[:1]])
        elif settings.repeat == "back":
            points = np.vstack([points, points[-2::-1]])
        self._points = points
        self._lengths_m = np.hypot(*np.diff(points, axis=0).T)
        speed, accel = settings.speed_m_s, settings.accel_m_s2
        # Up to its speed and down again, or only as fast as the leg allows.
        self._top_m_s = np.minimum(speed, np.sqrt(accel * self._lengths_m))
        times_s = self._lengths_m / np.maximum(self._top_m_s, 1e-12) + self._top_m_s / accel
        self._ends_s = np.concatenate([[0.0], np.cumsum(times_s)])

    def at(self, time_s: float) -> Array:
        """Return where it is, (2,) m."""
        gone_s, whole_s = max(0.0, time_s - self._settings.start_s), float(self._ends_s[-1])
        first: Array = self._points[0]
        if not self._settings.speed_m_s > 0.0 or not whole_s > 0.0:
            return first
        gone_s = min(gone_s, whole_s) if self._settings.repeat == "once" else math.fmod(gone_s, whole_s)
        leg = min(int(np.searchsorted(self._ends_s, gone_s, side="right")) - 1, len(self._lengths_m) - 1)
        top, accel, length_m = float(self._top_m_s[leg]), self._settings.accel_m_s2, float(self._lengths_m[leg])
        if not length_m > 0.0:
            return np.array(self._points[leg])
        in_s, left_s = gone_s - self._ends_s[leg], self._ends_s[leg + 1] - gone_s
        ramp_s = top / accel
        if in_s < ramp_s:
            way_m = 0.5 * accel * in_s * in_s
        elif left_s < ramp_s:
            way_m = length_m - 0.5 * accel * left_s * left_s
        else:
            way_m = top * (in_s - 0.5 * ramp_s)
        found: Array = self._points[leg] + way_m / length_m * (self._points[leg + 1] - self._points[leg])
        return found


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
        self._ways = [Way(each) for each in self._settings]
        self.radius_m = np.array([each.radius_m for each in self._settings])
        self.fastest_m_s = max((each.speed_m_s for each in self._settings), default=0.0)
        self.place = np.zeros((len(self._settings), 2))
        self._put: dict[int, tuple[float, float]] = {}
        self.set_time(0.0)

    def __len__(self) -> int:
        return len(self._settings)

    def set_time(self, time_s: float) -> None:
        """Put all of them where they are at `time_s`."""
        for row, way in enumerate(self._ways):
            self.place[row] = self._put[row] if row in self._put else way.at(time_s)

    def put(self, row: int, x_m: float, y_m: float) -> None:
        """Have mover `row` at a place from the next `set_time` on, instead of on its way."""
        self._put[row] = x_m, y_m

    def bodies(self) -> Array:
        """Return centre x, y and radius of each, (m, 3) m."""
        return np.column_stack([self.place, self.radius_m])


def solid_rows(config: WorldConfig) -> Array:
    """Return boxes, walls, then the movers where they start, rows as in ``Reading.obstacles``, shape (k + m, 6)."""
    movers = Movers(config.movers)
    rows = np.zeros((len(movers), 6))
    rows[:, :2], rows[:, 5] = movers.place, movers.radius_m
    return np.vstack([static_obstacles(config), rows])
