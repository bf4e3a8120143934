"""Where to go on a square, by nothing but odometry."""

from __future__ import annotations

import math

from fullswarm.drivers.base import Pose, Twist
from fullswarm.geometry import wrap

NEAR_M, NEAR_RAD = 0.02, 0.05
SLOWEST_M_S, SLOWEST_RAD_S = 0.1, 0.7  # above the dead band of a VESC


class Square:
    """Laps of a square, forwards with left turns or (`sign` -1) backwards with right ones."""

    def __init__(self, start: Pose, side_m: float, laps: int, sign: float, speed_m_s: float, turn_rad_s: float) -> None:
        self._corner, self._side_m, self._legs = start, side_m, 4 * laps
        self._sign, self._speed_m_s, self._turn_rad_s = sign, speed_m_s, turn_rad_s
        self._heading_rad = start.heading_rad
        self._turning = False
        self.path_m = 4 * laps * side_m

    def twist(self, here: Pose) -> Twist | None:
        """Return what to command at a pose; None at the end."""
        if self._legs == 0:
            return None
        off_rad = wrap(self._heading_rad - here.heading_rad)
        if self._turning:
            if abs(off_rad) > NEAR_RAD:
                turn = min(self._turn_rad_s, max(SLOWEST_RAD_S, 10.0 * abs(off_rad)))
                return Twist(0.0, math.copysign(turn, off_rad))
            self._turning, self._corner = False, here
            self._legs -= 1
        left_m = self._side_m - math.hypot(here.x_m - self._corner.x_m, here.y_m - self._corner.y_m)
        if left_m > NEAR_M:
            speed = min(self._speed_m_s, max(SLOWEST_M_S, 10.0 * left_m))
            return Twist(self._sign * speed, max(-1.0, min(1.0, 2.0 * off_rad)))
        self._turning = True
        self._heading_rad = wrap(self._heading_rad + self._sign * math.pi / 2.0)
        return Twist()


def error_m(told: Pose, true_x_m: float, true_y_m: float) -> float:
    """Return how far odometry is off."""
    return math.hypot(told.x_m - true_x_m, told.y_m - true_y_m)
