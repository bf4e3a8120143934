"""One robot's pose between its odometry and what is measured from outside: dead reckoning, late fixes, outliers."""

from __future__ import annotations

import enum
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fullswarm.config import AgentConfig
from fullswarm.drivers.base import FleetReading, Pose
from fullswarm.geometry import wrap
from fullswarm.kernels import Array

Row = list[float]

CREEP_M = 0.005
CREEP_RAD = 0.01
"""Standard deviation added in one second at standstill: pushes and slips that no wheel measures."""

UNSEEN_RAD = 1.0
"""A heading with a larger standard deviation than this was not seen."""


@dataclass(frozen=True, slots=True)
class Displacement:
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

    def variances(self, motion: Displacement) -> tuple[float, float]:
        """Return what a motion adds: m² per axis, rad²."""
        path_m = math.hypot(motion.ahead_m, motion.left_m)
        return (
            self.position_m**2 * path_m + CREEP_M**2 * motion.elapsed_s,
            self.heading_rad**2 * (path_m + abs(motion.turn_rad)) + CREEP_RAD**2 * motion.elapsed_s,
        )


@dataclass(slots=True)
class PoseEstimate:
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
    def around(cls, pose: Row, position_sigma_m: float, heading_sigma_rad: float) -> PoseEstimate:
        """Return a estimate with independent errors, `position_sigma_m` per axis."""
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

    def move(self, motion: Displacement) -> None:
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


def fuse(estimate: PoseEstimate, seen: PoseEstimate) -> None:
    """Correct `estimate` by an independent measurement of the same pose (extended Kalman filter, identity model).

    With S = P + R and K = P S⁻¹: x += K (z - x), P := P - K P. Plain numbers: three by three arrays cost ten times
    as much, 50 times per second and robot.
    """
    p = estimate
    sxx, syy, shh = p.xx + seen.xx, p.yy + seen.yy, p.hh + seen.hh
    sxy, sxh, syh = p.xy + seen.xy, p.xh + seen.xh, p.yh + seen.yh
    # Cofactors of S, which is symmetric.
    ixx, ixy, ixh = syy * shh - syh * syh, sxh * syh - sxy * shh, sxy * syh - sxh * syy
    iyy, iyh, ihh = sxx * shh - sxh * sxh, sxy * sxh - sxx * syh, sxx * syy - sxy * sxy
    determinant = sxx * ixx + sxy * ixy + sxh * ixh
    if not determinant > 0.0:
        raise ArithmeticError("the covariance of a pose is not positive definite")
    rows = (p.xx, p.xy, p.xh), (p.xy, p.yy, p.yh), (p.xh, p.yh, p.hh)
    gains = [
        (
            (x * ixx + y * ixy + h * ixh) / determinant,
            (x * ixy + y * iyy + h * iyh) / determinant,
            (x * ixh + y * iyh + h * ihh) / determinant,
        )
        for x, y, h in rows
    ]
    dx, dy, dh = seen.x_m - p.x_m, seen.y_m - p.y_m, wrap(seen.heading_rad - p.heading_rad)
    (xx, xy, xh), (yx, yy, yh), (hx, hy, hh) = gains
    p.x_m += xx * dx + xy * dy + xh * dh
    p.y_m += yx * dx + yy * dy + yh * dh
    p.heading_rad = wrap(p.heading_rad + hx * dx + hy * dy + hh * dh)
    (pxx, pxy, pxh), (_, pyy, pyh), (_, _, phh) = rows
    p.xx = pxx - (xx * pxx + xy * pxy + xh * pxh)
    p.xy = pxy - (xx * pxy + xy * pyy + xh * pyh)
    p.xh = pxh - (xx * pxh + xy * pyh + xh * phh)
    p.yy = pyy - (yx * pxy + yy * pyy + yh * pyh)
    p.yh = pyh - (yx * pxh + yy * pyh + yh * phh)
    p.hh = phh - (hx * pxh + hy * pyh + hh * phh)


def between(before: Row, after: Row, elapsed_s: float) -> Displacement:
    """Return the motion that leads from one pose to another of the same frame."""
    dx, dy = after[0] - before[0], after[1] - before[1]
    cos, sin = math.cos(before[2]), math.sin(before[2])
    return Displacement(cos * dx + sin * dy, cos * dy - sin * dx, wrap(after[2] - before[2]), elapsed_s)


def distance(one: PoseEstimate, other: PoseEstimate, more: tuple[float, float] = (0.0, 0.0)) -> float:
    """Return how far two independent estimates are apart, in standard deviations (Mahalanobis).

    `more` is added to the variances: m² per axis, rad².
    """
    apart = np.array([one.x_m - other.x_m, one.y_m - other.y_m, wrap(one.heading_rad - other.heading_rad)])
    spread = one.covariance() + other.covariance() + np.diag([more[0], more[0], more[1]])
    return math.sqrt(max(float(apart @ np.linalg.solve(spread, apart)), 0.0))


AHEAD_S = 0.1
"""A fix may be newer than the last reading; the robot is taken to have moved on as measured for so long at most."""

SPARE_S = 0.2
"""Odometry is remembered for this much longer than a fix may be late: readings may come seldom."""

SLIP, PUSH_M_S, PUSH_RAD_S = 0.3, 0.15, 0.5
"""Standard deviations of slip, as a share of the way, and of being pushed, for the judgement of fixes."""

SLACK_M, SLACK_RAD, SLACK_S = 0.5, 0.5, 0.5
"""No more way, turning and time than this excuses a fix that does not fit."""

JUMP_M = 0.05
UNKNOWN_M = 1000.0
UNKNOWN_RAD = math.pi
BREAK_RAD_S = 4.0
"""A small robot turns no faster, for all that is known of a time that the odometry has lost."""


class Verdict(enum.Enum):
    """What became of a fix."""

    ACCEPTED = "accepted"
    REANCHORED = "re-anchored"  # the pose jumped to it
    OUTLIER = "outlier"
    TOO_OLD = "too old"
    PENDING = "the first ones have to agree"


@dataclass(frozen=True, slots=True)
class Fix:
    """A pose that was measured from outside, and when, on this machine's clock."""

    at_s: float
    pose: Pose
    position_sigma_m: float
    heading_sigma_rad: float


@dataclass(frozen=True, slots=True)
class Taken:
    """The verdict, what the fix says of the robot's pose by now, and how far the estimate has jumped."""

    verdict: Verdict
    pose: Pose
    jump_m: float = 0.0


@dataclass(slots=True)
class Slack:
    """What may have happened since a fix although no model of noise knows it: wheels that slip, a robot pushed."""

    since_s: float
    way_m: float = 0.0
    turned_rad: float = 0.0

    def add(self, motion: Displacement) -> None:
        """Note what the wheels have done."""
        self.way_m += math.hypot(motion.ahead_m, motion.left_m)
        self.turned_rad += abs(motion.turn_rad)

    def variances(self, now_s: float) -> tuple[float, float]:
        """Return m² per axis and rad²: four standard deviations hold wheels that have done nothing but slip."""
        passed_s = min(max(now_s - self.since_s, 0.0), SLACK_S)
        position_m = SLIP * min(self.way_m, SLACK_M) + PUSH_M_S * passed_s
        heading_rad = SLIP * min(self.turned_rad + self.way_m, SLACK_RAD) + PUSH_RAD_S * passed_s
        return position_m**2, heading_rad**2


@dataclass(slots=True)
class Rival:
    """Where fixes that do not fit say that the robot is, one after the other."""

    estimate: PoseEstimate
    since_s: float
    slack: Slack
    count: int = 1


def breaks_of(reading: FleetReading) -> list[int]:
    """Return how often the odometry of each robot has lost motion."""
    breaks = reading.odometry_breaks
    return [0] * len(reading.stamp_s) if breaks is None else breaks.tolist()


class PoseFilter:
    """Follows one robot.

    Parameters
    ----------
    start : pose at ``open()``; the pose is odometry laid on it until something better is known
    placed : the robot was put there; else nothing is known
    top_speed_m_s : what it can do; odometry that jumps further has been reset
    correct : pulls the first estimate towards the second, an independent measurement of the same pose
    """

    def __init__(
        self,
        start: Row,
        placed: bool,
        top_speed_m_s: float,
        config: AgentConfig,
        correct: Callable[[PoseEstimate, PoseEstimate], None],
    ) -> None:
        sigma = (config.start_sigma_m, config.start_sigma_rad) if placed else (UNKNOWN_M, UNKNOWN_RAD)
        self.estimate = PoseEstimate.around(start, *sigma)
        self.anchored = False
        self._placed = placed
        self._config, self._correct, self._top_speed_m_s = config, correct, top_speed_m_s
        self._noise = OdometryNoise(config.odometry_sigma_m, config.odometry_sigma_rad)
        self._horizon_s = config.fix_max_delay_s + config.fix_latency_s + SPARE_S
        self._history: deque[tuple[float, Row]] = deque()
        self._odometry: Row | None = [0.0, 0.0, 0.0]
        self._stamp_s = -math.inf
        self._breaks = 0
        self._twist: Row = [0.0, 0.0]
        self._slack = Slack(-math.inf)
        self._rival: Rival | None = None

    @property
    def sigma(self) -> tuple[float, float]:
        """Standard deviations of position (m, worse axis) and heading (rad); -1, -1 when nothing is known."""
        spread_m = self.estimate.position_sigma_m
        return (spread_m, math.sqrt(self.estimate.hh)) if spread_m < UNKNOWN_M else (-1.0, -1.0)

    @property
    def assumed_sigma(self) -> tuple[float, float]:
        """Standard deviations for the safety filter: where nothing is known, those of a robot put on its start pose."""
        position_m, heading_rad = self.sigma
        if position_m < 0.0:
            return self._config.start_sigma_m, self._config.start_sigma_rad
        return position_m, min(heading_rad, UNKNOWN_RAD)

    # ------------------------------------------------------------------ odometry
    def follow(self, stamp_s: float, odometry: Row, twist: Row, breaks: int = 0) -> bool:
        """Move on by the odometry since the last reading; tell whether this one is new.

        `breaks` is how often the odometry has lost motion so far; then anything may have happened meanwhile.
        """
        if stamp_s <= self._stamp_s:
            return False
        before, elapsed_s = self._odometry, stamp_s - self._stamp_s
        broken, self._breaks = breaks > self._breaks, breaks
        self._odometry, self._stamp_s, self._twist = odometry, stamp_s, twist
        if before is not None:
            known = math.isfinite(elapsed_s)
            motion = between(before, odometry, elapsed_s if known else 0.0)
            way_m = math.hypot(motion.ahead_m, motion.left_m)
            if known and way_m > 2.0 * self._top_speed_m_s * elapsed_s + JUMP_M:
                self._history.clear()  # the odometry was reset: it says nothing about the way
            else:
                self._move(self.estimate, self._slack, motion)
                if self._rival is not None:
                    self._move(self._rival.estimate, self._rival.slack, motion)
            if broken and known:
                self._doubt(elapsed_s)
        history = self._history
        history.append((stamp_s, odometry))
        while history[0][0] < stamp_s - self._horizon_s:
            history.popleft()
        return True

    def _doubt(self, lost_s: float) -> None:
        """Widen the estimate by wherever the robot can have driven to in a time that the odometry has lost."""
        self._history.clear()
        self._rival = None
        way_m = min(self._top_speed_m_s * lost_s, UNKNOWN_M)
        turn_rad = min(BREAK_RAD_S * lost_s, UNKNOWN_RAD)
        # Evenly spread to either side: the variance is a third of the square.
        self.estimate.widen(way_m**2 / 3.0, turn_rad**2 / 3.0)

    def _move(self, estimate: PoseEstimate, slack: Slack, motion: Displacement) -> None:
        estimate.move(motion)
        estimate.widen(*self._noise.variances(motion))
        slack.add(motion)

    def begin_at(self, estimate: PoseEstimate) -> None:
        """Start anew from a pose that the driver has sensed; the odometry counts from its next reading."""
        self.estimate, self.anchored = estimate, True
        self._odometry, self._rival, self._slack = None, None, Slack(-math.inf)
        self._history.clear()

    def _since(self, at_s: float) -> Displacement | None:
        """Return how the robot has moved from then until the last reading; None when that is forgotten."""
        history = self._history
        if not history:
            return Displacement()
        newest_s, newest = history[-1]
        if at_s >= newest_s:
            return self._back(min(at_s - newest_s, AHEAD_S))
        if at_s < history[0][0]:
            return None
        later_s, later = newest_s, newest
        for stamp_s, odometry in reversed(history):
            if stamp_s <= at_s:
                share = (at_s - stamp_s) / (later_s - stamp_s)
                then = [old + share * (new - old) for old, new in zip(odometry[:2], later[:2], strict=True)]
                then.append(odometry[2] + share * wrap(later[2] - odometry[2]))
                return between(then, newest, newest_s - at_s)
            later_s, later = stamp_s, odometry
        return None

    def _back(self, ahead_s: float) -> Displacement:
        """Return the motion from `ahead_s` after the last reading back to it, at the speed measured then."""
        way_m, turn_rad = -self._twist[0] * ahead_s, -self._twist[1] * ahead_s
        half = 0.5 * turn_rad
        return Displacement(way_m * math.cos(half), way_m * math.sin(half), turn_rad, ahead_s)

    # ------------------------------------------------------------------ fixes
    def take(self, fix: Fix) -> Taken:
        """Judge a fix and, if it fits, correct the estimate by it: both moved to the time of the last reading.

        What the odometry did wrong since a late fix is in the estimate and in the moved fix alike. So it is taken out
        of the estimate for the comparison and put back afterwards: as if the fix had come in time.
        """
        motion = self._since(fix.at_s)
        if motion is None:
            return Taken(Verdict.TOO_OLD, fix.pose)
        seen, wrong = self._moved(fix, motion), self._noise.variances(motion)
        now = Pose(seen.x_m, seen.y_m, seen.heading_rad)
        if not self.anchored and not self._confirmed(seen, wrong, fix.at_s):
            return Taken(Verdict.PENDING, now)
        if not self.anchored:
            self.anchored, self._rival = True, None
            seen.widen(*wrong)
            return Taken(Verdict.ACCEPTED, now, self._anchor(seen, fix.at_s))
        estimate = self.estimate
        estimate.widen(-wrong[0], -wrong[1])
        shared = fix.at_s < self._stamp_s and estimate.sound
        if not shared:  # newer than the reading, or older than the last estimate: errors of its own
            estimate.widen(*wrong)
            seen.widen(*wrong)
        fits = self._fits(estimate, seen, self._slack.variances(fix.at_s))
        if fits:
            self._rival, self._slack = None, Slack(fix.at_s)
            self._correct(estimate, seen)
        if shared:
            estimate.widen(*wrong)
            seen.widen(*wrong)
        if fits:
            return Taken(Verdict.ACCEPTED, now)
        if not self._insists(seen, fix.at_s):
            return Taken(Verdict.OUTLIER, now)
        return Taken(Verdict.REANCHORED, now, self._anchor(seen, fix.at_s))

    def _confirmed(self, seen: PoseEstimate, wrong: tuple[float, float], at_s: float) -> bool:
        """Tell whether a first fix may be believed: it fits the stated start pose, or enough others."""
        if self._placed:
            seen.widen(*wrong)
            fits = distance(self.estimate, seen) <= self._config.fix_gate_sigma
            seen.widen(-wrong[0], -wrong[1])
            if fits:
                return True
        count = self._config.fix_first_count
        return count <= 1 or (self._agrees(seen, at_s) and self._rival is not None and self._rival.count >= count)

    def _fits(self, estimate: PoseEstimate, seen: PoseEstimate, slack: tuple[float, float]) -> bool:
        """Tell whether a fix may be true; widen the estimate where that takes slip or a push."""
        gate = self._config.fix_gate_sigma
        if distance(estimate, seen) <= gate:
            return True
        if distance(estimate, seen, slack) > gate:
            return False
        estimate.widen(*slack)
        return True

    def _moved(self, fix: Fix, motion: Displacement) -> PoseEstimate:
        """Return where a fix says that the robot is after `motion`, were that without error."""
        pose = [fix.pose.x_m, fix.pose.y_m, wrap(fix.pose.heading_rad)]
        if fix.heading_sigma_rad < UNSEEN_RAD:
            seen = PoseEstimate.around(pose, fix.position_sigma_m, fix.heading_sigma_rad)
            seen.move(motion)
            return seen
        # The own heading then, or the motion would be laid out in a direction that was never measured.
        pose[2] = wrap(self.estimate.heading_rad - motion.turn_rad)
        seen = PoseEstimate.around(pose, fix.position_sigma_m, min(math.sqrt(self.estimate.hh), UNKNOWN_RAD))
        seen.move(motion)
        seen.hh, seen.xh, seen.yh = fix.heading_sigma_rad**2, 0.0, 0.0
        return seen

    def _insists(self, seen: PoseEstimate, at_s: float) -> bool:
        """Note a fix that does not fit; tell whether enough of them in a row agree with each other."""
        if not self._agrees(seen, at_s) or self._rival is None:
            return False
        config, rival = self._config, self._rival
        return rival.count >= config.fix_reanchor_count and at_s - rival.since_s >= config.fix_reanchor_s

    def _agrees(self, seen: PoseEstimate, at_s: float) -> bool:
        """Note a fix; tell whether it agrees with the one before, else it is the first of others."""
        rival = self._rival
        if rival is None or not self._fits(rival.estimate, seen, rival.slack.variances(at_s)):
            self._rival = Rival(seen, at_s, Slack(at_s))
            return False
        rival.estimate, rival.slack = seen, Slack(at_s)
        rival.count += 1
        return True

    def _anchor(self, seen: PoseEstimate, at_s: float) -> float:
        """Believe a fix alone; return how far the pose has jumped, in metres."""
        old = self.estimate
        if seen.hh >= UNSEEN_RAD**2:
            seen.heading_rad = old.heading_rad
            seen.hh = max(old.hh, UNKNOWN_RAD**2) if self._rival is not None else old.hh
            seen.xh = seen.yh = 0.0
        self.estimate, self._rival, self._slack = seen, None, Slack(at_s)
        return math.hypot(seen.x_m - old.x_m, seen.y_m - old.y_m)
