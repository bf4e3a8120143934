"""Records the true poses of a laboratory's robots, as a trajectory for pictures and as a table for analysis."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from fullswarm.errors import MissingExtra
from fullswarm.evaluate.trial_folder import Trajectory
from fullswarm.kernels import Array
from fullswarm.simulation.world import World

if TYPE_CHECKING:
    from pandas import DataFrame


class Recording:
    """Rows of poses, twists, contacts and behaviours, one each `period_s` of simulated time.

    Parameters
    ----------
    now_s : time of the laboratory
    behaviours : returns the behaviour that each robot runs
    """

    def __init__(
        self, world: World, period_s: float, now_s: Callable[[], float], behaviours: Callable[[], tuple[str, ...]]
    ) -> None:
        self._world, self._now_s, self._behaviours = world, now_s, behaviours
        self._every = max(1, round(period_s / world.dt_s))
        self._steps = itertools.count(1)
        self._touched = np.zeros(len(world.ids), bool)
        self._time_s: list[float] = []
        self._pose: list[Array] = []
        self._twist: list[Array] = []
        self._touching: list[np.ndarray[Any, np.dtype[np.bool_]]] = []
        self._ran: list[tuple[str, ...]] = []
        self._take()

    def on_step(self) -> None:
        """Take in one step of the world."""
        self._touched |= self._world.contacts > 0
        if next(self._steps) % self._every == 0:
            self._take()

    def _take(self) -> None:
        self._time_s.append(self._now_s())
        self._pose.append(self._world.pose.copy())
        self._twist.append(self._world.twist.copy())
        self._touching.append(self._touched.copy())
        self._ran.append(self._behaviours())
        self._touched[:] = False

    def trajectory(self, goals: Array, goal_radius_m: float) -> Trajectory:
        """Return all rows and the present, for pictures.

        Parameters
        ----------
        goals : (n, 2) m, NaN: none
        """
        world, count = self._world, len(self._world.ids)
        now = self._now_s() > self._time_s[-1] + 1e-9
        return Trajectory(
            ids=world.ids,
            time_s=np.array([*self._time_s, *([self._now_s()] if now else [])], float),
            pose=np.array([*self._pose, *([world.pose] if now else [])], np.float32).reshape(-1, count, 3),
            touching=np.array([*self._touching, *([self._touched] if now else [])], bool).reshape(-1, count),
            goals=goals,
            goal_radius_m=goal_radius_m,
            radius_m=np.array(world.radius_m, float),
            boxes=np.array(world.config.boxes, float).reshape(-1, 5),
            bounds_m=np.array(world.config.bounds_m, float),
        )

    def to_dataframe(self) -> DataFrame:
        """Return one row per robot and sample: time, robot, pose, twist, contact, behaviour.

        Raises
        ------
        MissingExtra
            pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise MissingExtra("a table needs pandas", hint="pip install 'fullswarm[lab]'") from error
        count, rows = len(self._world.ids), len(self._time_s)
        pose, twist = np.array(self._pose).reshape(-1, 3), np.array(self._twist).reshape(-1, 2)
        return pd.DataFrame(
            {
                "time_s": np.repeat(self._time_s, count),
                "robot": list(self._world.ids) * rows,
                "x_m": pose[:, 0],
                "y_m": pose[:, 1],
                "heading_rad": pose[:, 2],
                "speed_m_s": twist[:, 0],
                "turn_rad_s": twist[:, 1],
                "contact": np.array(self._touching).ravel(),
                "behaviour": list(itertools.chain.from_iterable(self._ran)),
            }
        )
