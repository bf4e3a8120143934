"""What is believed of a robot's pose: a normal distribution over x, y and heading, and how motion widens it.

Plain numbers instead of arrays: an agent on board moves one belief fifty times a second, in about 3 µs.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fullswarm.geometry import wrap
from fullswarm.kernels import Array

Row = list[float]

CREEP_M = 0.005
CREEP_RAD = 0.01
"""Spread after one second at a stand: pushes and slips that no wheel feels, so that a belief never becomes certain."""

UNSEEN_RAD = 1.0
"""A heading with a larger standard deviation than this was not seen."""


@dataclass(frozen=True, slots=True)
class Motion:
    """From one pose to another, in the frame of the first: metres ahead and to the left, radians, seconds."""

    ahead_m: float = 0.0
    left_m: float = 0.0
    turn_rad: float = 0.0
    elapsed_s: float = 0.0


@dataclass(frozen=True, slots=True)
class OdometryNoise:
    """Standard deviation of odometry after one metre, and of its heading after one metre or one radian of turning.

    Variances grow with the way, so after four metres the spread is twice as wide.
    """

    position_m: float
    heading_rad: float

    def variances(self, motion: Motion) -> tuple[float, float]:
        """Return what a motion adds: m² per axis, rad²."""
        path_m = math.hypot(motion.ahead_m, motion.left_m)
        return (
            self.position_m**2 * path_m + CREEP_M**2 * motion.elapsed_s,
            self.heading_rad**2 * (path_m + abs(motion.turn_rad)) + CREEP_RAD**2 * motion.elapsed_s,
        )


@dataclass(slots=True)
class Belief:
    """Mean pose, world frame, and the six different numbers of its covariance (m², m rad, rad²)."""

    x_m: float
    y_m: float
    heading_rad: float
    xx: float
    yy: float
    hh: float
    xy: float = 0.0
    xh: float = 0.0
    yh: float = 0.0

    @classmethod
    def around(cls, pose: Row, position_sigma_m: float, heading_sigma_rad: float) -> Belief:
        """Return a belief with independent errors, `position_sigma_m` per axis."""
        return cls(pose[0], pose[1], pose[2], position_sigma_m**2, position_sigma_m**2, heading_sigma_rad**2)

    @property
    def mean(self) -> Row:
        """The pose: x, y (m), heading (rad)."""
        return [self.x_m, self.y_m, self.heading_rad]

    @property
    def position_sigma_m(self) -> float:
        """Standard deviation along the worse axis of the ellipse."""
        mean, half = 0.5 * (self.xx + self.yy), 0.5 * (self.xx - self.yy)
        return math.sqrt(mean + math.hypot(half, self.xy))

    def covariance(self) -> Array:
        """Return the covariance, (3, 3)."""
        return np.array(
            [[self.xx, self.xy, self.xh], [self.xy, self.yy, self.yh], [self.xh, self.yh, self.hh]],
        )

    def set(self, mean: Array, covariance: Array) -> None:
        """Take over a mean (3,) and a covariance (3, 3)."""
        self.x_m, self.y_m, self.heading_rad = float(mean[0]), float(mean[1]), wrap(float(mean[2]))
        (self.xx, self.xy, self.xh), (_, self.yy, self.yh), (_, _, self.hh) = covariance.tolist()

    def widen(self, position_m2: float, heading_rad2: float) -> None:
        """Add to the variances, per axis; less than zero takes away."""
        self.xx += position_m2
        self.yy += position_m2
        self.hh += heading_rad2

    @property
    def sound(self) -> bool:
        """Whether the covariance is one (Sylvester: all leading minors above zero)."""
        plane = self.xx * self.yy - self.xy * self.xy
        cross = self.xy * self.yh - self.yy * self.xh
        whole = self.hh * plane + self.xh * cross + self.yh * (self.xy * self.xh - self.xx * self.yh)
        return self.xx > 0.0 and plane > 0.0 and whole > 0.0

    def move(self, motion: Motion) -> None:
        """Move the mean, and turn the error of the heading into one of the position."""
        cos, sin = math.cos(self.heading_rad), math.sin(self.heading_rad)
        step_x = cos * motion.ahead_m - sin * motion.left_m
        step_y = sin * motion.ahead_m + cos * motion.left_m
        # F P Fᵀ with F = [[1, 0, -step_y], [0, 1, step_x], [0, 0, 1]], written out.
        self.xx += step_y * (step_y * self.hh - 2.0 * self.xh)
        self.yy += step_x * (step_x * self.hh + 2.0 * self.yh)
        self.xy += step_x * self.xh - step_y * self.yh - step_x * step_y * self.hh
        self.xh -= step_y * self.hh
        self.yh += step_x * self.hh
        self.x_m += step_x
        self.y_m += step_y
        self.heading_rad = wrap(self.heading_rad + motion.turn_rad)


def between(before: Row, after: Row, elapsed_s: float) -> Motion:
    """Return the motion that leads from one pose to another of the same frame."""
    dx, dy = after[0] - before[0], after[1] - before[1]
    cos, sin = math.cos(before[2]), math.sin(before[2])
    return Motion(cos * dx + sin * dy, cos * dy - sin * dx, wrap(after[2] - before[2]), elapsed_s)


def distance(one: Belief, other: Belief, more: tuple[float, float] = (0.0, 0.0)) -> float:
    """Return how far two independent beliefs are apart, in standard deviations (Mahalanobis).

    `more` is added to the variances: m² per axis, rad².
    """
    apart = np.array([one.x_m - other.x_m, one.y_m - other.y_m, wrap(one.heading_rad - other.heading_rad)])
    spread = one.covariance() + other.covariance() + np.diag([more[0], more[0], more[1]])
    return math.sqrt(max(float(apart @ np.linalg.solve(spread, apart)), 0.0))
