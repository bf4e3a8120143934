"""One robot's pose between its odometry and what is measured from outside: dead reckoning, late fixes, outliers."""

from __future__ import annotations

import enum
import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from fullswarm.agent.belief import UNSEEN_RAD, Belief, Motion, OdometryNoise, Row, between, distance
from fullswarm.config import AgentConfig
from fullswarm.drivers.base import FleetReading, Pose
from fullswarm.geometry import wrap

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

    def add(self, motion: Motion) -> None:
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

    belief: Belief
    since_s: float
    slack: Slack
    count: int = 1


def breaks_of(reading: FleetReading) -> list[int]:
    """Return how often the odometry of each robot has lost motion."""
    breaks = reading.odometry_breaks
    return [0] * len(reading.stamp_s) if breaks is None else breaks.tolist()


class Track:
    """Follows one robot.

    Parameters
    ----------
    start : pose at ``open()``; the pose is odometry laid on it until something better is known
    placed : the robot was put there; else nothing is known
    top_speed_m_s : what it can do; odometry that jumps further has been reset
    correct : pulls the first belief towards the second, an independent measurement of the same pose
    """

    def __init__(
        self,
        start: Row,
        placed: bool,
        top_speed_m_s: float,
        config: AgentConfig,
        correct: Callable[[Belief, Belief], None],
    ) -> None:
        sigma = (config.start_sigma_m, config.start_sigma_rad) if placed else (UNKNOWN_M, UNKNOWN_RAD)
        self.belief = Belief.around(start, *sigma)
        self.anchored = False
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
        spread_m = self.belief.position_sigma_m
        return (spread_m, math.sqrt(self.belief.hh)) if spread_m < UNKNOWN_M else (-1.0, -1.0)

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
                self._move(self.belief, self._slack, motion)
                if self._rival is not None:
                    self._move(self._rival.belief, self._rival.slack, motion)
            if broken and known:
                self._doubt(elapsed_s)
        history = self._history
        history.append((stamp_s, odometry))
        while history[0][0] < stamp_s - self._horizon_s:
            history.popleft()
        return True

    def _doubt(self, lost_s: float) -> None:
        """Widen the belief by wherever the robot can have driven to in a time that the odometry has lost."""
        self._history.clear()
        self._rival = None
        way_m = min(self._top_speed_m_s * lost_s, UNKNOWN_M)
        turn_rad = min(BREAK_RAD_S * lost_s, UNKNOWN_RAD)
        # Evenly spread to either side: the variance is a third of the square.
        self.belief.widen(way_m**2 / 3.0, turn_rad**2 / 3.0)

    def _move(self, belief: Belief, slack: Slack, motion: Motion) -> None:
        belief.move(motion)
        belief.widen(*self._noise.variances(motion))
        slack.add(motion)

    def begin_at(self, belief: Belief) -> None:
        """Start anew from a pose that the driver has sensed; the odometry counts from its next reading."""
        self.belief, self.anchored = belief, True
        self._odometry, self._rival, self._slack = None, None, Slack(-math.inf)
        self._history.clear()

    def _since(self, at_s: float) -> Motion | None:
        """Return how the robot has moved from then until the last reading; None when that is forgotten."""
        history = self._history
        if not history:
            return Motion()
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

    def _back(self, ahead_s: float) -> Motion:
        """Return the motion from `ahead_s` after the last reading back to it, at the speed measured then."""
        way_m, turn_rad = -self._twist[0] * ahead_s, -self._twist[1] * ahead_s
        half = 0.5 * turn_rad
        return Motion(way_m * math.cos(half), way_m * math.sin(half), turn_rad, ahead_s)

    # ------------------------------------------------------------------ fixes
    def take(self, fix: Fix) -> Taken:
        """Judge a fix and, if it fits, correct the belief by it: both moved to the time of the last reading.

        What the odometry did wrong since a late fix is in the belief and in the moved fix alike. So it is taken out
        of the belief for the comparison and put back afterwards: as if the fix had come in time.
        """
        motion = self._since(fix.at_s)
        if motion is None:
            return Taken(Verdict.TOO_OLD, fix.pose)
        seen, wrong = self._moved(fix, motion), self._noise.variances(motion)
        now = Pose(seen.x_m, seen.y_m, seen.heading_rad)
        if not self.anchored:
            self.anchored = True  # the start pose was stated; this is the first measurement
            seen.widen(*wrong)
            return Taken(Verdict.ACCEPTED, now, self._anchor(seen, fix.at_s))
        belief = self.belief
        belief.widen(-wrong[0], -wrong[1])
        shared = fix.at_s < self._stamp_s and belief.sound
        if not shared:  # newer than the reading, or older than what was last believed: errors of its own
            belief.widen(*wrong)
            seen.widen(*wrong)
        fits = self._fits(belief, seen, self._slack.variances(fix.at_s))
        if fits:
            self._rival, self._slack = None, Slack(fix.at_s)
            self._correct(belief, seen)
        if shared:
            belief.widen(*wrong)
            seen.widen(*wrong)
        if fits:
            return Taken(Verdict.ACCEPTED, now)
        if not self._insists(seen, fix.at_s):
            return Taken(Verdict.OUTLIER, now)
        return Taken(Verdict.REANCHORED, now, self._anchor(seen, fix.at_s))

    def _fits(self, belief: Belief, seen: Belief, slack: tuple[float, float]) -> bool:
        """Tell whether a fix may be true; widen the belief where that takes slip or a push."""
        gate = self._config.fix_gate_sigma
        if distance(belief, seen) <= gate:
            return True
        if distance(belief, seen, slack) > gate:
            return False
        belief.widen(*slack)
        return True

    def _moved(self, fix: Fix, motion: Motion) -> Belief:
        """Return where a fix says that the robot is after `motion`, were that without error."""
        pose = [fix.pose.x_m, fix.pose.y_m, wrap(fix.pose.heading_rad)]
        if fix.heading_sigma_rad < UNSEEN_RAD:
            seen = Belief.around(pose, fix.position_sigma_m, fix.heading_sigma_rad)
            seen.move(motion)
            return seen
        # The own heading then, or the motion would be laid out in a direction that was never measured.
        pose[2] = wrap(self.belief.heading_rad - motion.turn_rad)
        seen = Belief.around(pose, fix.position_sigma_m, min(math.sqrt(self.belief.hh), UNKNOWN_RAD))
        seen.move(motion)
        seen.hh, seen.xh, seen.yh = fix.heading_sigma_rad**2, 0.0, 0.0
        return seen

    def _insists(self, seen: Belief, at_s: float) -> bool:
        """Note a fix that does not fit; tell whether enough of them in a row agree with each other."""
        config, rival = self._config, self._rival
        if rival is None or not self._fits(rival.belief, seen, rival.slack.variances(at_s)):
            self._rival = Rival(seen, at_s, Slack(at_s))
            return False
        rival.belief, rival.slack = seen, Slack(at_s)
        rival.count += 1
        return rival.count >= config.fix_reanchor_count and at_s - rival.since_s >= config.fix_reanchor_s

    def _anchor(self, seen: Belief, at_s: float) -> float:
        """Believe a fix alone; return how far the pose has jumped, in metres."""
        old = self.belief
        if seen.hh >= UNSEEN_RAD**2:
            seen.heading_rad = old.heading_rad
            seen.hh = max(old.hh, UNKNOWN_RAD**2) if self._rival is not None else old.hh
            seen.xh = seen.yh = 0.0
        self.belief, self._rival, self._slack = seen, None, Slack(at_s)
        return math.hypot(seen.x_m - old.x_m, seen.y_m - old.y_m)
