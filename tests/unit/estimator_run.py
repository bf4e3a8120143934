"""A robot that drives in curves before an estimator, and what an estimator is told."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import strategies as st

from fullswarm.agent.pose.estimator import DirectEstimator, EkfEstimator, Estimator
from fullswarm.agent.pose.pose_filter import Displacement, Fix, OdometryNoise, Verdict
from fullswarm.config import AgentConfig
from fullswarm.drivers.base import NO_OBSTACLES, FleetReading, Pose
from fullswarm.geometry import wrap

TICK_S = 0.02
CONFIG = AgentConfig()
NOISE = OdometryNoise(CONFIG.odometry_sigma_m, CONFIG.odometry_sigma_rad)
FIX_M, FIX_RAD = 0.02, 0.03
MAKES: list[Callable[[], Estimator]] = [
    lambda: DirectEstimator(np.zeros((1, 3)), top_speed_m_s=[0.5]),
    lambda: EkfEstimator(np.zeros((1, 3)), np.full((1, 2), 0.05), top_speed_m_s=[0.5]),
]
both = pytest.mark.parametrize("make", MAKES, ids=["direct", "ekf"])
poses = st.tuples(*[st.floats(-20.0, 20.0)] * 2, st.floats(-math.pi, math.pi))
steps = st.tuples(*[st.floats(-0.5, 0.5)] * 3)


def reading(stamp_s: float, odometry: list[float], twist: tuple[float, float] = (0.0, 0.0)) -> FleetReading:
    return FleetReading(
        np.array([stamp_s]), np.full((1, 3), math.nan), np.array([odometry]), np.array([twist]),
        np.zeros(1, np.uint8), np.zeros(1, np.int64), np.full(1, -1.0), NO_OBSTACLES, np.full(1, math.nan),
    )  # fmt: skip


def moved(pose: list[float], ahead_m: float, left_m: float, turn_rad: float) -> list[float]:
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    x, y = pose[0] + cos * ahead_m - sin * left_m, pose[1] + sin * ahead_m + cos * left_m
    return [x, y, wrap(pose[2] + turn_rad)]


class Run:
    """A robot that drives in curves, with odometry and fixes as wrong as the filter is told that they are."""

    def __init__(self, estimator: Estimator, seed: int, speed_m_s: float = 0.4) -> None:
        self.rng = np.random.default_rng(seed)
        self.estimator, self.speed_m_s = estimator, speed_m_s
        self.truth = [1.0, -2.0, 0.5]
        self.odometry = [0.0, 0.0, 0.0]
        self.now_s = 0.0
        self.past = [(0.0, list(self.truth))]
        self.pose = self.tick()

    def tick(self) -> list[float]:
        self.now_s += TICK_S
        turn = 0.6 * math.sin(0.3 * self.now_s)
        ahead = self.speed_m_s * TICK_S
        position, heading = NOISE.variances(Displacement(ahead, 0.0, turn * TICK_S, TICK_S))
        error = self.rng.normal(0.0, np.sqrt([position, position, heading]))
        self.odometry = moved(self.odometry, ahead, 0.0, turn * TICK_S)
        self.truth = moved(self.truth, ahead + error[0], error[1], turn * TICK_S + error[2])
        self.past.append((self.now_s, list(self.truth)))
        self.pose = self.estimator.update(reading(self.now_s, self.odometry, (self.speed_m_s, turn)), TICK_S)[
            0
        ].tolist()
        return self.pose

    def fix(self, late_ticks: int = 0, off: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Verdict:
        at_s, truth = self.past[-1 - late_ticks]
        seen = np.array(truth) + off + self.rng.normal(0.0, [FIX_M, FIX_M, FIX_RAD])
        return self.estimator.take(0, Fix(at_s, Pose(seen[0], seen[1], wrap(seen[2])), FIX_M, FIX_RAD)).verdict

    def find(self) -> None:
        """Take so many fixes that the first ones are believed."""
        while self.fix() is not Verdict.ACCEPTED:
            pass

    def error(self) -> np.ndarray:
        error = np.array(self.pose) - self.truth
        error[2] = wrap(error[2])
        return error

    def error_m(self) -> float:
        return math.hypot(*self.error()[:2])
