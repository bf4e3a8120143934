"""Where am I: the pose of each robot from what its driver reads and from what others see of it.

A driver that senses the world pose is believed. Elsewhere odometry is laid on the start pose, and on each fix that
comes: the last one as it is (``estimator = "direct"``, base install) or all of them by their certainty (``"ekf"``).
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from fullswarm.agent.belief import UNSEEN_RAD, Belief
from fullswarm.agent.ekf import EkfEstimator
from fullswarm.agent.track import Fix, Taken, Track, breaks_of
from fullswarm.config import AgentConfig, SwarmConfig
from fullswarm.drivers.base import POSE_SIGMA_M, Fleet, FleetReading
from fullswarm.kernels import Array

__all__ = ["DirectEstimator", "EkfEstimator", "Estimator", "estimator_for"]

USUAL_SIGMA = POSE_SIGMA_M
"""Standard deviation (m, rad) of the pose that a real driver senses, unless its reading states it."""


class Estimator(Protocol):
    """Turns readings and fixes into poses."""

    fuses: bool
    """The poses that a driver senses are filtered too, so their certainty is known."""

    def update(self, reading: FleetReading, dt_s: float) -> Array:
        """Return the poses (n, 3): x, y (m), heading (rad), world frame, after `dt_s` more."""
        ...

    def take(self, row: int, fix: Fix) -> Taken:
        """Judge a fix of a robot whose driver senses no pose, and use it from the next update on."""
        ...

    def sigma(self, row: int) -> tuple[float, float]:
        """Return the standard deviations of position (m) and heading (rad); -1 when nothing is known."""
        ...


class DirectEstimator:
    """Takes the pose that a driver senses; where it senses none, the last fix or the start pose, and odometry since.

    Parameters
    ----------
    start : (n, 3) poses at `open()`, for robots that know their odometry only
    placed : (n,) whether the robot was placed on its start pose; all when None
    top_speed_m_s : (n,)
    """

    fuses = False

    def __init__(
        self,
        start: Array,
        config: AgentConfig | None = None,
        placed: list[bool] | None = None,
        top_speed_m_s: list[float] | None = None,
    ) -> None:
        count = len(start)
        rows = zip(start.tolist(), placed or [True] * count, top_speed_m_s or [math.inf] * count, strict=True)
        self._tracks = [Track(*row, config or AgentConfig(), _replace) for row in rows]
        self._sensed: list[float] | None = None

    def update(self, reading: FleetReading, dt_s: float) -> Array:
        """Return the poses (n, 3)."""
        del dt_s
        pose = reading.pose
        # On board there is one robot, and reducing an array costs it five times as much as three numbers.
        if len(pose) == 1:
            values = pose[0].tolist()
            if not math.isnan(sum(values)):
                self._sensed = values
                return pose
        elif not math.isnan(pose.sum()):
            return pose
        return self._dead_reckon(reading)

    def _dead_reckon(self, reading: FleetReading) -> Array:
        if self._sensed is not None:
            # The driver has lost the pose that it sensed until now: odometry goes on from there.
            self._tracks[0].begin_at(Belief.around(self._sensed, USUAL_SIGMA, USUAL_SIGMA))
            self._sensed = None
        rows = zip(
            self._tracks, reading.stamp_s.tolist(), reading.odometry.tolist(), reading.twist.tolist(),
            reading.pose.tolist(), breaks_of(reading), strict=True,
        )  # fmt: skip
        poses = []
        for track, stamp_s, odometry, twist, pose, breaks in rows:
            track.follow(stamp_s, odometry, twist, breaks)
            poses.append(track.belief.mean if math.isnan(sum(pose)) else pose)
        return np.array(poses)

    def take(self, row: int, fix: Fix) -> Taken:
        """Judge a fix of robot `row` and go on from it."""
        return self._tracks[row].take(fix)

    def sigma(self, row: int) -> tuple[float, float]:
        """Return the standard deviations of position (m) and heading (rad); -1 when nothing is known."""
        return self._tracks[row].sigma


def _replace(belief: Belief, seen: Belief) -> None:
    """Take the measurement as it is; a heading that was not seen stays what odometry makes of it."""
    heading_rad, hh = belief.heading_rad, belief.hh
    unseen = seen.hh >= UNSEEN_RAD**2
    belief.set(np.array(seen.mean), seen.covariance())
    if unseen:
        belief.heading_rad, belief.hh, belief.xh, belief.yh = heading_rad, hh, 0.0, 0.0


def estimator_for(config: SwarmConfig, fleet: Fleet, start: Array) -> Estimator:
    """Return the estimator that the fleet file asks for, for the robots of `fleet` starting at `start` (n, 3).

    Raises
    ------
    MissingExtra
        ``estimator = "ekf"`` without filterpy.
    ConfigError
        ``estimator = "ekf"`` for simulated robots that sense their pose without any noise.
    """
    poses = {each.id: each.pose for each in config.robot}
    placed = [poses.get(robot) is not None for robot in fleet.ids]
    top_speeds = [each.limits.speed_m_s for each in fleet.descriptions]
    if config.agent.estimator == "direct":
        return DirectEstimator(start, config.agent, placed, top_speeds)
    simulated = any(each.make == "sim" for each in fleet.descriptions)
    noise = config.world_or_default.noise if simulated else None
    sigma = (noise.position_m, noise.heading_rad) if noise else (USUAL_SIGMA, USUAL_SIGMA)
    return EkfEstimator(start, *sigma, config.agent, placed, top_speeds)
