"""Dead reckoning of a Create: from encoder counts, or from distance and angle where there are no encoders."""

from __future__ import annotations

import math
from collections import deque

from fullswarm.drivers.base import STAND, Pose, Twist
from fullswarm.drivers.create_oi.protocol import TOP_MM_S, Generation, Sensors, encoder_delta
from fullswarm.geometry import wrap

WINDOW_S = 0.1
"""Over which the speed is taken: one count per frame would be a step of 30 mm/s."""

TOP_M_S = 1.25 * TOP_MM_S / 1000.0
"""Faster than this no wheel turns, not even downhill."""

RESTART_COUNTS = 4
"""So few counts on both wheels are those of a robot that has just been switched on."""

WRAP = 1 << 16
"""Counts until an encoder begins anew."""

FIRST_M, SAVED_M = 0.03, 0.1
"""Travel granted beyond `TOP_M_S` times the time between two frames: frames may arrive in bursts."""


class Odometry:
    """Sums up the wheels' travel since open(); starts at (0, 0, 0).

    A robot goes on counting while nothing is received from it: after a gap in the line its counters still
    hold the motion, which is then taken for one even arc. `breaks` counts the gaps that lost it.
    """

    def __init__(self, generation: Generation) -> None:
        self._base_m = generation.wheel_base_m
        self._m_per_count = generation.m_per_count
        self._x_m = self._y_m = 0.0
        self._way_m = self._turned_rad = 0.0
        self._track: deque[tuple[float, float, float]] = deque()  # stamp, way, turned
        self._counts: tuple[int, int] | None = None
        self._stamp_s: float | None = None
        self._granted_m = FIRST_M
        self._gap = False
        self.jumps = 0  # impossible ones, left out
        self.breaks = 0  # how often motion may be missing from the pose

    @property
    def pose(self) -> Pose:
        """Where the robot is in the odometry frame."""
        return Pose(self._x_m, self._y_m, wrap(self._turned_rad))

    @property
    def twist(self) -> Twist:
        """How fast it went over the last `WINDOW_S`."""
        if len(self._track) < 2:
            return STAND
        (old_s, old_way, old_turned), (new_s, way, turned) = self._track[0], self._track[-1]
        if new_s - old_s < 0.5 * WINDOW_S:
            return STAND
        return Twist((way - old_way) / (new_s - old_s), (turned - old_turned) / (new_s - old_s))

    def rebase(self) -> None:
        """Go on from here: what the robot counted meanwhile does not move the pose."""
        self._counts = self._stamp_s = None
        self._granted_m = FIRST_M
        self._track.clear()

    def gap(self) -> None:
        """Note that nothing is received for a while."""
        self._gap = True
        self._track.clear()

    def restarted(self) -> None:
        """Note that the robot has been switched off and on: its counts began anew."""
        if self._stamp_s is not None:
            self.breaks += 1
        self.rebase()

    def update(self, sensors: Sensors, now_s: float) -> bool:
        """Take one frame; return whether a wheel moved. An impossible jump re-bases instead of moving the pose."""
        gap, self._gap, before = self._gap, False, self._counts
        first = self._stamp_s is None
        elapsed_s = 0.0 if self._stamp_s is None else now_s - self._stamp_s
        self._stamp_s = now_s
        wheels = self._wheels(sensors)
        if wheels is None or first:
            return False
        self._granted_m = min(self._granted_m, SAVED_M) + TOP_M_S * elapsed_s
        farthest = max(abs(wheels[0]), abs(wheels[1]))
        if farthest > self._granted_m or (gap and self._lost(before, sensors, farthest)):
            self.jumps += 1
            self.breaks += 1
            self.rebase()
            self._stamp_s = now_s
            self._counts = _counts(sensors)
            return False
        self._granted_m -= farthest
        self._move(*wheels, now_s)
        return farthest > 0.0

    def _lost(self, before: tuple[int, int] | None, sensors: Sensors, farthest_m: float) -> bool:
        """Return whether the counts after a gap do not show it: begun anew, cleared by each frame, or wrapped."""
        after = _counts(sensors)
        if self._m_per_count is None or before is None or after is None:
            return True
        moved = farthest_m > FIRST_M
        anew = moved and max(abs(encoder_delta(each, 0)) for each in after) <= RESTART_COUNTS
        return anew or (moved and self._granted_m >= self._m_per_count * WRAP / 2.0)

    def _wheels(self, sensors: Sensors) -> tuple[float, float] | None:
        """Return the travel of both wheels since the last frame in metres; None when unknown."""
        if self._m_per_count is None:
            if sensors.distance_mm is None or sensors.angle_deg is None:
                return None
            half = math.radians(sensors.angle_deg) * self._base_m / 2.0
            return sensors.distance_mm / 1000.0 - half, sensors.distance_mm / 1000.0 + half
        old, new = self._counts, _counts(sensors)
        self._counts = new
        if old is None or new is None:
            return None
        scale = self._m_per_count
        return encoder_delta(new[0], old[0]) * scale, encoder_delta(new[1], old[1]) * scale

    def _move(self, left_m: float, right_m: float, now_s: float) -> None:
        forward = (left_m + right_m) / 2.0
        turn = (right_m - left_m) / self._base_m
        half = turn / 2.0
        chord = forward * (math.sin(half) / half if half else 1.0)  # after a gap it may be a long arc
        middle = self._turned_rad + half
        self._x_m += chord * math.cos(middle)
        self._y_m += chord * math.sin(middle)
        self._way_m += forward
        self._turned_rad += turn
        self._track.append((now_s, self._way_m, self._turned_rad))
        while len(self._track) > 2 and now_s - self._track[1][0] >= WINDOW_S:
            self._track.popleft()


def _counts(sensors: Sensors) -> tuple[int, int] | None:
    if sensors.encoder_left is None or sensors.encoder_right is None:
        return None
    return sensors.encoder_left, sensors.encoder_right
