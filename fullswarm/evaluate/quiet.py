"""Finds when a trial has come to rest: while it runs, and from its trajectory."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.evaluate.trial_folder import Trajectory
from fullswarm.kernels import Array

QUIET_S, END_S = 2.0, 3.0
"""So long without motion is quiet, and ends a trial in which all robots have arrived or settled."""
MOVED_M, TURNED_RAD = 0.002, 0.01
"""More than this from one row of the trajectory to the next, a fifth of a second later, is motion."""
PROGRESS_M = 0.02
"""A robot that is nearer to its goal by so much than ever before has made progress."""
REST_M, REST_RAD = 0.02, 0.05
"""Robots at rest may move by so much in all: their own estimates are noisy."""


class Rest:
    """Measures for how long no robot has moved."""

    def __init__(self) -> None:
        self._pose: Array | None = None
        self._since_s = 0.0

    def lasts_s(self, now_s: float, pose: Array) -> float:
        """Take in the poses (n, 3) now; return for how long they have been the same, but for noise."""
        before = self._pose
        if before is None or _moved(before, pose, REST_M, REST_RAD).any():
            self._pose, self._since_s = pose.copy(), now_s
        return now_s - self._since_s


def quiet_after_s(trajectory: Trajectory) -> float | None:
    """Return how long robots went on moving after the last progress of any of them towards its goal.

    Returns
    -------
    float or None
        Seconds. None: they moved within the last `QUIET_S`, or every robot that has a goal is there at the end.
    """
    time_s, pose, goals = trajectory.time_s, trajectory.pose, trajectory.goals
    goal_m = np.hypot(pose[:, :, 0] - goals[:, 0], pose[:, :, 1] - goals[:, 1])
    aimed = np.isfinite(goals).all(axis=1)
    if not len(time_s) or (aimed.any() and (goal_m[-1, aimed] <= trajectory.goal_radius_m).all()):
        return None
    motion = _moved(pose[:-1], pose[1:], MOVED_M, TURNED_RAD).any(axis=1)
    last_motion_s = float(time_s[1:][motion][-1]) if motion.any() else 0.0
    if time_s[-1] - last_motion_s < QUIET_S:
        return None
    least, last_progress_s = goal_m[0].copy(), 0.0
    for at_s, row in zip(time_s.tolist(), goal_m, strict=True):
        nearer = row < least - PROGRESS_M
        if nearer.any():
            least[nearer], last_progress_s = row[nearer], at_s
    return round(max(0.0, last_motion_s - last_progress_s), 3)


def _moved(before: NDArray[Any], after: NDArray[Any], most_m: float, most_rad: float) -> NDArray[np.bool_]:
    way = np.hypot(after[..., 0] - before[..., 0], after[..., 1] - before[..., 1])
    turn = np.abs(np.remainder(after[..., 2] - before[..., 2] + math.pi, 2.0 * math.pi) - math.pi)
    moved: NDArray[np.bool_] = (way > most_m) | (turn > most_rad)
    return moved
