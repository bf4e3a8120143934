"""Estimates the pose of each robot from its driver's readings and from fixes.

A pose that a driver senses is taken as it is. Elsewhere odometry is laid on the start pose, and on each fix that
comes: the last one as it is (``estimator = "direct"``, base install) or all of them by their certainty (``"ekf"``).
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from fullswarm.agent.pose.pose_filter import UNSEEN_RAD, Fix, PoseEstimate, PoseFilter, Taken, breaks_of
from fullswarm.config import AgentConfig, SwarmConfig
from fullswarm.drivers.base import POSE_SIGMA_M, Fleet, FleetReading
from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.kernels import Array

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
        self._filters = [PoseFilter(*row, config or AgentConfig(), _replace) for row in rows]
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
            self._filters[0].begin_at(PoseEstimate.around(self._sensed, USUAL_SIGMA, USUAL_SIGMA))
            self._sensed = None
        rows = zip(
            self._filters, reading.stamp_s.tolist(), reading.odometry.tolist(), reading.twist.tolist(),
            reading.pose.tolist(), breaks_of(reading), strict=True,
        )  # fmt: skip
        poses = []
        for pose_filter, stamp_s, odometry, twist, pose, breaks in rows:
            pose_filter.follow(stamp_s, odometry, twist, breaks)
            poses.append(pose_filter.estimate.mean if math.isnan(sum(pose)) else pose)
        return np.array(poses)

    def take(self, row: int, fix: Fix) -> Taken:
        """Judge a fix of robot `row` and go on from it."""
        return self._filters[row].take(fix)

    def sigma(self, row: int) -> tuple[float, float]:
        """Return the standard deviations of position (m) and heading (rad); -1 when nothing is known."""
        return self._filters[row].sigma


def _replace(estimate: PoseEstimate, seen: PoseEstimate) -> None:
    """Take the measurement as it is; a heading that was not seen stays what odometry makes of it."""
    heading_rad, hh = estimate.heading_rad, estimate.hh
    unseen = seen.hh >= UNSEEN_RAD**2
    estimate.set(np.array(seen.mean), seen.covariance())
    if unseen:
        estimate.heading_rad, estimate.hh, estimate.xh, estimate.yh = heading_rad, hh, 0.0, 0.0


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


class Corrector:
    """Pulls a estimate towards a measurement of the same pose, each by its certainty.

    Raises
    ------
    MissingExtra
        filterpy is not installed.
    """

    def __init__(self) -> None:
        try:
            from filterpy.kalman import ExtendedKalmanFilter  # half a second, with SciPy: only on use
        except ImportError as error:
            raise MissingExtra(
                "the estimator 'ekf' needs filterpy", hint="pip install 'fullswarm[estimation]'"
            ) from error
        self._filter = ExtendedKalmanFilter(dim_x=3, dim_z=3)

    def __call__(self, estimate: PoseEstimate, seen: PoseEstimate) -> None:
        """Correct `estimate` by the independent measurement `seen`."""
        ekf = self._filter
        ekf.x, ekf.P = np.array(estimate.mean), estimate.covariance()
        ekf.update(
            np.array(seen.mean), HJacobian=_identity, Hx=_itself, R=seen.covariance(), residual=_difference
        )  # fmt: skip
        estimate.set(ekf.x, ekf.P)


class EkfEstimator:
    """Fuses odometry with fixes, or with the noisy poses that a driver senses, robot by robot.

    Parameters
    ----------
    start : (n, 3) poses at ``open()``
    position_sigma_m, heading_sigma_rad : standard deviation of a pose that a driver senses
    placed : (n,) whether the robot was placed on its start pose; all when None
    top_speed_m_s : (n,)
    """

    fuses = True

    def __init__(
        self,
        start: Array,
        position_sigma_m: float,
        heading_sigma_rad: float,
        config: AgentConfig | None = None,
        placed: list[bool] | None = None,
        top_speed_m_s: list[float] | None = None,
    ) -> None:
        if position_sigma_m <= 0 or heading_sigma_rad <= 0:
            raise ConfigError("the estimator 'ekf' needs the noise of the poses it fuses", where="world.noise")
        count = len(start)
        self._sigma = position_sigma_m, heading_sigma_rad
        self._correct = Corrector()
        rows = zip(start.tolist(), placed or [True] * count, top_speed_m_s or [math.inf] * count, strict=True)
        self._filters = [PoseFilter(*row, config or AgentConfig(), self._correct) for row in rows]

    def update(self, reading: FleetReading, dt_s: float) -> Array:
        """Return the fused poses (n, 3)."""
        del dt_s
        rows = zip(
            self._filters, reading.stamp_s.tolist(), reading.odometry.tolist(), reading.twist.tolist(),
            reading.pose.tolist(), breaks_of(reading), reading.position_sigma_m.tolist(), strict=True,
        )  # fmt: skip
        for pose_filter, stamp_s, odometry, twist, pose, breaks, sigma_m in rows:
            if not pose_filter.follow(stamp_s, odometry, twist, breaks) or math.isnan(sum(pose)):
                continue
            usual_m, heading_rad = self._sigma
            seen = PoseEstimate.around(pose, usual_m if math.isnan(sigma_m) else sigma_m, heading_rad)
            if pose_filter.anchored:
                self._correct(pose_filter.estimate, seen)
            else:
                pose_filter.estimate, pose_filter.anchored = seen, True
        return np.array([pose_filter.estimate.mean for pose_filter in self._filters])

    def take(self, row: int, fix: Fix) -> Taken:
        """Judge a fix of robot `row` and fuse it."""
        return self._filters[row].take(fix)

    def sigma(self, row: int) -> tuple[float, float]:
        """Return the standard deviations of position (m) and heading (rad); -1 when nothing is known."""
        return self._filters[row].sigma


def _identity(_state: Array) -> Array:
    return np.eye(3)


def _itself(state: Array) -> Array:
    return state


def _difference(measured: Array, expected: Array) -> Array:
    error = measured - expected
    error[2] = math.atan2(math.sin(error[2]), math.cos(error[2]))
    return error
