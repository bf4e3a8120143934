"""Evaluates a trajectory at any time: poses between its samples, contacts, what has happened so far."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fullswarm.errors import ConfigError
from fullswarm.evaluate.trial_folder import Trajectory
from fullswarm.kernels import Array, Flags

APART_S = 0.25
"""A new contact needs so long without one, as in `Outcome`; here as far as the samples show."""


@dataclass(frozen=True, slots=True)
class Moment:
    """The world at one time."""

    time_s: float
    pose: Array  # (n, 3) m, m, rad
    touching: Flags  # (n,)
    arrived: int  # robots inside their goal disc now
    contacts: int  # onsets until now
    marks: Array  # (contacts, 2) m, where they were


class Timeline:
    """Looks things up in a trajectory.

    Raises
    ------
    ConfigError
        The trajectory holds no sample or no robot.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        if not trajectory.pose.size or len(trajectory.time_s) != len(trajectory.pose):
            raise ConfigError("the trajectory is empty")
        self.trajectory = trajectory
        self._time_s = np.asarray(trajectory.time_s, np.float64)
        self._pose = np.asarray(trajectory.pose, np.float64)
        begun = onsets(self._time_s, trajectory.touching)
        rows, robots = np.nonzero(begun)  # in the order of time
        self._marks = self._pose[rows, robots, :2]
        self._marks_until = np.cumsum(begun.sum(axis=1))

    @property
    def start_s(self) -> float:
        """Time of the first sample."""
        return float(self._time_s[0])

    @property
    def end_s(self) -> float:
        """Time of the last sample."""
        return float(self._time_s[-1])

    @property
    def robots(self) -> int:
        """How many robots there are."""
        return len(self._pose[0])

    def window(self, from_s: float | None, until_s: float | None) -> tuple[float, float]:
        """Return the part of the trial that is asked for and recorded.

        Raises
        ------
        ConfigError
            It is empty, or outside of the trial.
        """
        first = self.start_s if from_s is None else max(from_s, self.start_s)
        last = self.end_s if until_s is None else min(until_s, self.end_s)
        if first > last:
            raise ConfigError(
                f"nothing was recorded from {first:g} s until {last:g} s",
                where="--from, --until",
                hint=f"the trial goes from {self.start_s:g} s until {self.end_s:g} s",
            )
        return first, last

    def at(self, time_s: float, since_s: float | None = None) -> Moment:
        """Return the moment; robots count as touching that touched anything after `since_s`."""
        row, share = self._place(time_s)
        last = min(row + 1, len(self._time_s) - 1)
        pose, step = self._pose[row].copy(), self._pose[last] - self._pose[row]
        step[:, 2] = (step[:, 2] + math.pi) % (2.0 * math.pi) - math.pi
        pose += share * step
        pose[:, 2] = (pose[:, 2] + math.pi) % (2.0 * math.pi) - math.pi
        first = row if since_s is None else min(row, int(np.searchsorted(self._time_s, since_s, side="right")))
        count = int(self._marks_until[row])
        goals, radius_m = self.trajectory.goals, self.trajectory.goal_radius_m
        return Moment(
            time_s=time_s,
            pose=pose,
            touching=np.logical_or.reduce(self.trajectory.touching[first : row + 1], axis=0),
            arrived=int((np.hypot(*(pose[:, :2] - goals).T) <= radius_m).sum()),
            contacts=count,
            marks=self._marks[:count],
        )

    def trails(self, from_s: float, moment: Moment) -> list[Array]:
        """Return each robot's way (k, 2) in metres from a time until a moment."""
        row, _ = self._place(moment.time_s)
        first = min(row, int(np.searchsorted(self._time_s, from_s)))
        ways = self._pose[first : row + 1, :, :2].transpose(1, 0, 2)
        return list(np.concatenate((ways, moment.pose[:, None, :2]), axis=1))

    def _place(self, time_s: float) -> tuple[int, float]:
        """Return the sample at or before a time, and the share of the way to the next one."""
        row = max(0, int(np.searchsorted(self._time_s, time_s, side="right")) - 1)
        if row + 1 >= len(self._time_s):
            return row, 0.0
        before, after = self._time_s[row], self._time_s[row + 1]
        return row, min(1.0, max(0.0, float((time_s - before) / (after - before))))


def onsets(time_s: Array, touching: Flags) -> Flags:
    """Return (t, n) where contacts begin: touching after at least `APART_S` without."""
    begun = np.zeros_like(touching)
    last_s = np.full(touching.shape[1], -np.inf)
    for row in np.flatnonzero(touching.any(axis=1)):
        now = touching[row]
        begun[row] = now & (time_s[row] - last_s >= APART_S - 1e-9)
        last_s[now] = time_s[row]
    return begun
