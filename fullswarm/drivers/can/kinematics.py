"""Two wheels and one body: set-points that keep the curvature, odometry by midpoint integration."""

from __future__ import annotations

import math
from dataclasses import dataclass

from fullswarm.drivers.base import Pose, Twist
from fullswarm.drivers.can.protocol import Motion
from fullswarm.geometry import wrap

GAP_S = 0.5
"""After a longer silence of a wheel its count starts anew: what happened meanwhile is unknown."""
SLACK_M = 0.02
"""A count may run ahead by this much, because messages arrive in bursts."""
SKEW_S = 0.05
"""At most so much of a wheel's motion is foreseen."""
CREEP_M_S = 0.05
"""A wheel that reports a higher speed than this must count."""
HUGE = 1e6


def wheel_speeds(twist: Twist, base_m: float, limit_m_s: float) -> tuple[float, float]:
    """Return left and right speed in m/s; both are scaled by one factor so that the curvature stays."""
    linear_m_s, angular_rad_s = twist.linear_m_s, twist.angular_rad_s
    largest = max(abs(linear_m_s), abs(angular_rad_s))
    if largest > HUGE:  # finite, but the sums below would not be
        linear_m_s, angular_rad_s = linear_m_s / largest * HUGE, angular_rad_s / largest * HUGE
    turn_m_s = angular_rad_s * base_m / 2.0
    left, right = linear_m_s - turn_m_s, linear_m_s + turn_m_s
    fastest = max(abs(left), abs(right))
    scale = limit_m_s / fastest if fastest > limit_m_s else 1.0
    return left * scale, right * scale


def body_twist(left_m_s: float, right_m_s: float, base_m: float) -> Twist:
    """Return the body's velocity for two wheel speeds."""
    return Twist((left_m_s + right_m_s) / 2.0, (right_m_s - left_m_s) / base_m)


@dataclass(slots=True)
class WheelTrack:
    """How far one wheel has gone, from its controller's count, or from its speed between two counts."""

    limit_m_s: float  # a count that moves faster is a restart of the controller, not motion
    travelled_m: float = 0.0
    speed_m_s: float = 0.0
    seen_s: float = -math.inf
    _count_m: float = 0.0  # the controller's count when last reported …
    _count_s: float = -math.inf  # … when that was …
    _at_count_m: float = 0.0  # … and `travelled_m` there
    fresh: bool = False  # something has come since the pose was stepped
    lost: bool = False  # it may have moved further than `travelled_m` says since then
    _still_s: float = math.inf  # since when it has reported a speed without counting

    def update(self, motion: Motion, now_s: float) -> None:
        """Take in one message; a speed that no wheel has is noise on the line."""
        if motion.speed_m_s is not None and abs(motion.speed_m_s) > self.limit_m_s:
            return
        gap_s = now_s - self.seen_s
        self.lost = self.lost or GAP_S <= gap_s < math.inf
        if motion.distance_m is not None:
            if motion.distance_m != self._count_m or abs(self.speed_m_s) < CREEP_M_S:
                self._still_s = math.inf
            elif self._still_s == math.inf:
                self._still_s = now_s
            self._count(motion.distance_m, now_s)
        elif motion.speed_m_s is not None and gap_s < GAP_S:
            self.travelled_m += (self.speed_m_s + motion.speed_m_s) / 2.0 * gap_s
        if motion.speed_m_s is not None:
            self.speed_m_s = motion.speed_m_s
        self.seen_s = now_s
        self.fresh = True

    def interrupt(self) -> None:
        """Note that nothing is heard of it for a while; its count starts anew."""
        self.fresh, self.lost = False, self.lost or math.isfinite(self.seen_s)
        self.seen_s = self._count_s = -math.inf

    def travelled_at(self, now_s: float) -> float:
        """Return the distance at `now_s`, a moment after the last message.

        The two wheels never report at the same instant: 20 ms at 0.3 m/s would be a heading error of 1°.
        """
        return self.travelled_m + self.speed_m_s * min(now_s - self.seen_s, SKEW_S)

    def stuck_for(self, now_s: float) -> float:
        """Return for how long the wheel has reported a speed without counting, in s; negative: not at all."""
        return now_s - self._still_s

    def _count(self, count_m: float, now_s: float) -> None:
        elapsed_s, step_m = now_s - self._count_s, count_m - self._count_m
        if abs(step_m) > self.limit_m_s * elapsed_s + SLACK_M:
            self.lost = True
        elif elapsed_s < GAP_S:
            self.travelled_m = self._at_count_m + step_m
        self._count_m, self._count_s, self._at_count_m = count_m, now_s, self.travelled_m


class Odometry:
    """Pose since the start, stepped whenever both wheels have reported something new.

    When one wheel may have moved unseen, the pose stays for that step: of two wheels that fell silent one after the
    other, one could count its whole way and the other nothing, which would be a turn. `breaks` counts such steps.
    """

    def __init__(self, base_m: float, limit_m_s: float) -> None:
        self._base_m = base_m
        self.wheels = (WheelTrack(limit_m_s), WheelTrack(limit_m_s))
        self.pose = Pose(0.0, 0.0, 0.0)
        self.breaks = 0
        self._before = (0.0, 0.0)

    @property
    def twist(self) -> Twist:
        """Return the measured body velocity."""
        left, right = self.wheels
        return body_twist(left.speed_m_s, right.speed_m_s, self._base_m)

    def interrupt(self) -> None:
        """Note that neither wheel is heard for a while: how far they go meanwhile is unknown."""
        for wheel in self.wheels:
            wheel.interrupt()

    def update(self, side: int, motion: Motion, now_s: float) -> bool:
        """Take in a message of wheel `side` (0 left, 1 right); True when the pose is that of now."""
        self.wheels[side].update(motion, now_s)
        left, right = self.wheels
        if not (left.fresh and right.fresh):
            return False
        here = (left.travelled_at(now_s), right.travelled_at(now_s))
        step_left, step_right = here[0] - self._before[0], here[1] - self._before[1]
        self._before = here
        broken = left.lost or right.lost
        left.fresh = right.fresh = left.lost = right.lost = False
        if broken:
            self.breaks += 1
            return True
        forward_m, turn_rad = (step_left + step_right) / 2.0, (step_right - step_left) / self._base_m
        middle_rad = self.pose.heading_rad + turn_rad / 2.0
        self.pose = Pose(
            self.pose.x_m + forward_m * math.cos(middle_rad),
            self.pose.y_m + forward_m * math.sin(middle_rad),
            wrap(self.pose.heading_rad + turn_rad),
        )
        return True
