"""Where am I: the pose of each robot from what its driver reads."""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from fullswarm.agent.view import Array
from fullswarm.drivers.base import FleetReading
from fullswarm.errors import ConfigError, MissingExtra


class Estimator(Protocol):
    """Turns readings into poses."""

    def update(self, reading: FleetReading, dt_s: float) -> Array:
        """Return the poses (n, 3): x, y (m), heading (rad), world frame, after `dt_s` more."""
        ...


class DirectEstimator:
    """Takes the pose that a driver senses; where it senses none, odometry laid on the start pose.

    Parameters
    ----------
    start : (n, 3) poses at `open()`, for robots that know their odometry only
    """

    def __init__(self, start: Array) -> None:
        self._start = start.copy()
        self._cos, self._sin = np.cos(start[:, 2]), np.sin(start[:, 2])

    def update(self, reading: FleetReading, dt_s: float) -> Array:
        """Return the poses (n, 3)."""
        del dt_s
        pose = reading.pose
        # On board there is one robot, and reducing an array costs it five times as much as three numbers.
        if not math.isnan(sum(pose[0].tolist()) if len(pose) == 1 else pose.sum()):
            return pose
        dead_reckoned = np.empty_like(pose)
        x, y = reading.odometry[:, 0], reading.odometry[:, 1]
        dead_reckoned[:, 0] = self._start[:, 0] + self._cos * x - self._sin * y
        dead_reckoned[:, 1] = self._start[:, 1] + self._sin * x + self._cos * y
        turned = self._start[:, 2] + reading.odometry[:, 2]
        dead_reckoned[:, 2] = np.arctan2(np.sin(turned), np.cos(turned))
        return np.where(np.isnan(pose), dead_reckoned, pose)


class EkfEstimator:
    """Fuses odometry increments with noisy world poses by filterpy's extended Kalman filter, robot by robot.

    State (x, y, heading). Predicted with the increment of the driver's odometry, corrected with each new pose.

    Parameters
    ----------
    start : (n, 3) first guess
    position_sigma_m, heading_sigma_rad : standard deviation of a sensed pose
    """

    def __init__(self, start: Array, position_sigma_m: float, heading_sigma_rad: float) -> None:
        try:
            from filterpy.kalman import ExtendedKalmanFilter
        except ImportError as error:
            raise MissingExtra(
                "the estimator 'ekf' needs filterpy", hint="pip install 'fullswarm[estimation]'"
            ) from error
        if position_sigma_m <= 0 or heading_sigma_rad <= 0:
            raise ConfigError("the estimator 'ekf' needs the noise of the poses it fuses", where="world.noise")
        self._filters = []
        for row in start:
            ekf = ExtendedKalmanFilter(dim_x=3, dim_z=3)
            ekf.x = np.array(row, float)
            ekf.P = np.diag([position_sigma_m**2, position_sigma_m**2, heading_sigma_rad**2])
            ekf.R = np.diag([position_sigma_m**2, position_sigma_m**2, heading_sigma_rad**2])
            self._filters.append(ekf)
        self._odometry: Array | None = None
        self._stamp_s = np.full(len(start), -math.inf)

    def update(self, reading: FleetReading, dt_s: float) -> Array:
        """Return the fused poses (n, 3)."""
        del dt_s
        before = reading.odometry.copy() if self._odometry is None else self._odometry
        for row, ekf in enumerate(self._filters):
            if reading.stamp_s[row] <= self._stamp_s[row]:
                continue
            self._stamp_s[row] = reading.stamp_s[row]
            _predict(ekf, before[row], reading.odometry[row])
            if not np.isnan(reading.pose[row]).any():
                ekf.update(reading.pose[row], HJacobian=_identity, Hx=_itself, residual=_difference)
                ekf.x[2] = math.atan2(math.sin(ekf.x[2]), math.cos(ekf.x[2]))
        self._odometry = reading.odometry.copy()
        return np.array([ekf.x for ekf in self._filters])


def _predict(ekf: object, before: Array, after: Array) -> None:
    """Move the state by an odometry increment; its noise grows with the path (1 % of it, plus 1 mm)."""
    dx, dy = after[0] - before[0], after[1] - before[1]
    turn = math.atan2(math.sin(after[2] - before[2]), math.cos(after[2] - before[2]))
    x, y, heading = ekf.x  # type: ignore[attr-defined]  # filterpy ships no types
    rotation = heading - before[2]
    step = np.array(
        [math.cos(rotation) * dx - math.sin(rotation) * dy, math.sin(rotation) * dx + math.cos(rotation) * dy]
    )
    ekf.x = np.array([x + step[0], y + step[1], heading + turn])  # type: ignore[attr-defined]
    jacobian = np.array([[1.0, 0.0, -step[1]], [0.0, 1.0, step[0]], [0.0, 0.0, 1.0]])
    path = math.hypot(dx, dy)
    noise = np.diag([(0.01 * path + 0.001) ** 2, (0.01 * path + 0.001) ** 2, (0.02 * abs(turn) + 0.002) ** 2])
    ekf.P = jacobian @ ekf.P @ jacobian.T + noise  # type: ignore[attr-defined]


def _identity(_state: Array) -> Array:
    return np.eye(3)


def _itself(state: Array) -> Array:
    return state


def _difference(measured: Array, expected: Array) -> Array:
    error = measured - expected
    error[2] = math.atan2(math.sin(error[2]), math.cos(error[2]))
    return error
