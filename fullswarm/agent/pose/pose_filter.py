"""One robot's pose between its odometry and what is measured from outside: dead reckoning, late fixes, outliers."""

from __future__ import annotations

import enum
import math
from collections import OrderedDict, deque
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
RIVALS = 8
"""Of so many sources at most, what does not fit is remembered."""
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
    """A pose that was measured from outside, and when, on this machine's clock.

    `covariance_m2`: (xx, xy, yy); None: `position_sigma_m` along both axes. `source`: fixes that do not fit are
    compared with others of the same source. `may_insist`: enough of those that agree may move the pose to them.
    """

    at_s: float
    pose: Pose
    position_sigma_m: float
    heading_sigma_rad: float
    covariance_m2: tuple[float, float, float] | None = None
    source: str = ""
    may_insist: bool = True


@dataclass(frozen=True, slots=True)
class Distance:
    """How far the robot was from a place of known position, `up_m` above it, and when, on this machine's clock."""

    at_s: float
    x_m: float
    y_m: float
    up_m: float
    distance_m: float
    sigma_m: float


@dataclass(frozen=True, slots=True)
class Taken:
    """The verdict, what the fix says of the robot's pose by now, and how far the estimate has jumped.

    `residual_m`, `residual_rad`: of the fix against the estimate before it; NaN where there was none.
    """

    verdict: Verdict
    pose: Pose
    jump_m: float = 0.0
    residual_m: float = math.nan
    residual_rad: float = math.nan


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


def _measured(fix: Fix, pose: Row, heading_sigma_rad: float) -> PoseEstimate:
    """Return what a fix says of a pose."""
    seen = PoseEstimate.around(pose, fix.position_sigma_m, heading_sigma_rad)
    if fix.covariance_m2 is not None:
        seen.xx, seen.xy, seen.yy = fix.covariance_m2
    return seen


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
        self._rivals: OrderedDict[str, Rival] = OrderedDict()  # by source

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
                for rival in self._rivals.values():
                    self._move(rival.estimate, rival.slack, motion)
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
        self._rivals.clear()
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
        self._odometry, self._slack = None, Slack(-math.inf)
        self._history.clear()
        self._rivals.clear()

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
        if not self.anchored and not self._confirmed(seen, wrong, fix):
            return Taken(Verdict.PENDING, now)
        if not self.anchored:
            agreed = self._rivals.pop(fix.source, None) is not None
            self.anchored = True
            seen.widen(*wrong)
            return Taken(Verdict.ACCEPTED, now, self._anchor(seen, fix, headless=agreed))
        estimate = self.estimate
        off_m = math.hypot(seen.x_m - estimate.x_m, seen.y_m - estimate.y_m)
        off_rad = math.nan if seen.hh >= UNSEEN_RAD**2 else wrap(seen.heading_rad - estimate.heading_rad)
        estimate.widen(-wrong[0], -wrong[1])
        shared = fix.at_s < self._stamp_s and estimate.sound
        if not shared:  # newer than the reading, or older than the last estimate: errors of its own
            estimate.widen(*wrong)
            seen.widen(*wrong)
        fits = self._fits(estimate, seen, self._slack.variances(fix.at_s))
        if fits:
            self._rivals.pop(fix.source, None)
            self._slack = Slack(fix.at_s)
            self._correct(estimate, seen)
        if shared:
            estimate.widen(*wrong)
            seen.widen(*wrong)
        if fits:
            return Taken(Verdict.ACCEPTED, now, 0.0, off_m, off_rad)
        if not self._insists(seen, fix):
            return Taken(Verdict.OUTLIER, now, 0.0, off_m, off_rad)
        return Taken(Verdict.REANCHORED, now, self._anchor(seen, fix, headless=True), off_m, off_rad)

    def take_distance(self, measured: Distance) -> Taken:
        """Judge a distance to a known place and, if it fits, correct the estimate by it (extended Kalman filter).

        The estimate has to be anchored. The distance is predicted from where the robot was when it was measured.
        """
        motion = self._since(measured.at_s)
        estimate = self.estimate
        if motion is None or not self.anchored:
            verdict = Verdict.TOO_OLD if motion is None else Verdict.PENDING
            return Taken(verdict, Pose(estimate.x_m, estimate.y_m, estimate.heading_rad))
        residual_m, row, spread_m2 = predicted(estimate, measured, motion)
        variance_m2 = spread_m2 + measured.sigma_m**2 + self._noise.variances(motion)[0]
        slack_m2 = self._slack.variances(measured.at_s)[0]
        gate2 = self._config.fix_gate_sigma**2
        verdict = Verdict.OUTLIER
        if residual_m**2 <= gate2 * (variance_m2 + slack_m2):
            if residual_m**2 > gate2 * variance_m2:
                estimate.widen(slack_m2, 0.0)
                residual_m, row, spread_m2 = predicted(estimate, measured, motion)
                variance_m2 += slack_m2
            correct_along(estimate, row, residual_m, variance_m2)
            # The slack stays: one distance says nothing of what lies across it.
            verdict = Verdict.ACCEPTED
        now = Pose(estimate.x_m, estimate.y_m, estimate.heading_rad)
        return Taken(verdict, now, 0.0, abs(residual_m))

    def _confirmed(self, seen: PoseEstimate, wrong: tuple[float, float], fix: Fix) -> bool:
        """Tell whether a first fix may be believed: it fits the stated start pose, or enough others of its source."""
        if self._placed:
            seen.widen(*wrong)
            fits = distance(self.estimate, seen) <= self._config.fix_gate_sigma
            seen.widen(-wrong[0], -wrong[1])
            if fits:
                self._rivals.pop(fix.source, None)
                return True
        count = self._config.fix_first_count
        return count <= 1 or (self._agrees(seen, fix) and self._rivals[fix.source].count >= count)

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
            seen = _measured(fix, pose, fix.heading_sigma_rad)
            seen.move(motion)
            return seen
        # The own heading then, or the motion would be laid out in a direction that was never measured.
        pose[2] = wrap(self.estimate.heading_rad - motion.turn_rad)
        seen = _measured(fix, pose, min(math.sqrt(self.estimate.hh), UNKNOWN_RAD))
        seen.move(motion)
        seen.hh, seen.xh, seen.yh = fix.heading_sigma_rad**2, 0.0, 0.0
        return seen

    def _insists(self, seen: PoseEstimate, fix: Fix) -> bool:
        """Note a fix that does not fit; tell whether enough of them in a row agree with each other."""
        if not self._agrees(seen, fix) or not fix.may_insist:
            return False
        config, rival = self._config, self._rivals[fix.source]
        return rival.count >= config.fix_reanchor_count and fix.at_s - rival.since_s >= config.fix_reanchor_s

    def _agrees(self, seen: PoseEstimate, fix: Fix) -> bool:
        """Note a fix; tell whether it agrees with the one of its source before, else it is the first of others."""
        rival = self._rivals.get(fix.source)
        if rival is None or not self._fits(rival.estimate, seen, rival.slack.variances(fix.at_s)):
            self._rivals[fix.source] = Rival(seen, fix.at_s, Slack(fix.at_s))
            self._rivals.move_to_end(fix.source)
            if len(self._rivals) > RIVALS:
                self._rivals.popitem(last=False)
            return False
        rival.estimate, rival.slack = seen, Slack(fix.at_s)
        rival.count += 1
        return True

    def insisted_s(self, source: str, at_s: float) -> float:
        """Return for how long fixes of a source have agreed with each other and not with the estimate; 0: they fit."""
        rival = self._rivals.get(source)
        return at_s - rival.since_s if rival is not None and rival.count >= self._config.fix_reanchor_count else 0.0

    def _anchor(self, seen: PoseEstimate, fix: Fix, headless: bool) -> float:
        """Believe a fix alone; return how far the pose has jumped, in metres.

        `headless`: the heading is unknown by now if the fix does not show it.
        """
        old = self.estimate
        if seen.hh >= UNSEEN_RAD**2:
            seen.heading_rad = old.heading_rad
            seen.hh = max(old.hh, UNKNOWN_RAD**2) if headless else old.hh
            seen.xh = seen.yh = 0.0
        self.estimate, self._slack = seen, Slack(fix.at_s)
        self._rivals.clear()
        return math.hypot(seen.x_m - old.x_m, seen.y_m - old.y_m)


def predicted(estimate: PoseEstimate, measured: Distance, motion: Displacement) -> tuple[float, Row, float]:
    """Return by how much a distance is longer than the estimate has it, m; its gradient by x, y and heading; m².

    The last is the variance of the distance by the covariance of the estimate.
    """
    heading_rad = estimate.heading_rad - motion.turn_rad
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    step_x = cos * motion.ahead_m - sin * motion.left_m
    step_y = sin * motion.ahead_m + cos * motion.left_m
    dx, dy = estimate.x_m - step_x - measured.x_m, estimate.y_m - step_y - measured.y_m
    length_m = max(math.sqrt(dx * dx + dy * dy + measured.up_m**2), 1e-9)
    gx, gy = dx / length_m, dy / length_m
    gh = gx * step_y - gy * step_x
    px = estimate.xx * gx + estimate.xy * gy + estimate.xh * gh
    py = estimate.xy * gx + estimate.yy * gy + estimate.yh * gh
    ph = estimate.xh * gx + estimate.yh * gy + estimate.hh * gh
    return measured.distance_m - length_m, [gx, gy, gh], gx * px + gy * py + gh * ph


def correct_along(estimate: PoseEstimate, row: Row, residual: float, variance: float) -> None:
    """Correct an estimate by one number with this gradient (3), residual and variance of the residual."""
    covariance = estimate.covariance()
    gain = covariance @ np.array(row) / variance
    mean = np.array(estimate.mean) + gain * residual
    corrected = covariance - variance * np.outer(gain, gain)
    estimate.set(mean, 0.5 * (corrected + corrected.T))
