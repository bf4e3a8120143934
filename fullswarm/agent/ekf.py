"""The extended Kalman filter of filterpy, for robots whose fixes or sensed poses are noisy. Extra ``[estimation]``."""

from __future__ import annotations

import math

import numpy as np

from fullswarm.agent.belief import Belief
from fullswarm.agent.track import Fix, Taken, Track, breaks_of
from fullswarm.config import AgentConfig
from fullswarm.drivers.base import FleetReading
from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.kernels import Array


class Corrector:
    """Pulls a belief towards a measurement of the same pose, each by its certainty.

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

    def __call__(self, belief: Belief, seen: Belief) -> None:
        """Correct `belief` by the independent measurement `seen`."""
        ekf = self._filter
        ekf.x, ekf.P = np.array(belief.mean), belief.covariance()
        ekf.update(
            np.array(seen.mean), HJacobian=_identity, Hx=_itself, R=seen.covariance(), residual=_difference
        )  # fmt: skip
        belief.set(ekf.x, ekf.P)


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
        self._tracks = [Track(*row, config or AgentConfig(), self._correct) for row in rows]

    def update(self, reading: FleetReading, dt_s: float) -> Array:
        """Return the fused poses (n, 3)."""
        del dt_s
        rows = zip(
            self._tracks, reading.stamp_s.tolist(), reading.odometry.tolist(), reading.twist.tolist(),
            reading.pose.tolist(), breaks_of(reading), reading.position_sigma_m.tolist(), strict=True,
        )  # fmt: skip
        for track, stamp_s, odometry, twist, pose, breaks, sigma_m in rows:
            if not track.follow(stamp_s, odometry, twist, breaks) or math.isnan(sum(pose)):
                continue
            usual_m, heading_rad = self._sigma
            seen = Belief.around(pose, usual_m if math.isnan(sigma_m) else sigma_m, heading_rad)
            if track.anchored:
                self._correct(track.belief, seen)
            else:
                track.belief, track.anchored = seen, True
        return np.array([track.belief.mean for track in self._tracks])

    def take(self, row: int, fix: Fix) -> Taken:
        """Judge a fix of robot `row` and fuse it."""
        return self._tracks[row].take(fix)

    def sigma(self, row: int) -> tuple[float, float]:
        """Return the standard deviations of position (m) and heading (rad); -1 when nothing is known."""
        return self._tracks[row].sigma


def _identity(_state: Array) -> Array:
    return np.eye(3)


def _itself(state: Array) -> Array:
    return state


def _difference(measured: Array, expected: Array) -> Array:
    error = measured - expected
    error[2] = math.atan2(math.sin(error[2]), math.cos(error[2]))
    return error
