"""The smallest driver without a link: integrates its commands on a clock."""

from __future__ import annotations

import math
from urllib.parse import urlsplit

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import STAND, Description, Lifecycle, Limits, Pose, Reading, Twist
from fullswarm.errors import ConfigError
from fullswarm.keys import ROBOT_ID

LIMITS = Limits(speed_m_s=0.5, turn_rad_s=4.25, accel_m_s2=2.0, turn_accel_rad_s2=20.0)
WATCHDOG_S = 0.3


class NullDriver:
    """A :class:`~fullswarm.drivers.base.Driver` without a robot; it is READY as soon as it is open."""

    def __init__(self, url: str, clock: Clock | None = None) -> None:
        parts = urlsplit(url)
        if parts.scheme != "null" or not ROBOT_ID.match(parts.netloc) or parts.path or parts.query:
            raise ConfigError("not a null robot", where=url, hint="write null://r1")
        self.url = url
        self.description = Description("null", "null", 0.17, LIMITS, watchdog_s=WATCHDOG_S)
        self.state, self.fault, self.firmware = Lifecycle.CLOSED, "", ""
        self._clock = clock or MonotonicClock()
        self._twist, self._odometry = STAND, Pose(0.0, 0.0, 0.0)
        self._at_s = self._commanded_s = 0.0

    def open(self) -> None:
        """Start at the origin, standing."""
        if self.state is not Lifecycle.CLOSED:
            return
        self._twist, self._odometry = STAND, Pose(0.0, 0.0, 0.0)
        self._at_s = self._commanded_s = self._clock.now_s()
        self.state, self.firmware = Lifecycle.READY, "null 1"

    def activate(self) -> None:
        """READY → ACTIVE."""
        if self.state is Lifecycle.READY:
            self.state = Lifecycle.ACTIVE

    def deactivate(self) -> None:
        """ACTIVE → READY, standing."""
        self._set(STAND)
        if self.state is Lifecycle.ACTIVE:
            self.state = Lifecycle.READY

    def read(self) -> Reading | None:
        """Return where the commands so far have led; None unless open."""
        if self.state is Lifecycle.CLOSED:
            return None
        self._integrate()
        return Reading(stamp_s=self._at_s, odometry=self._odometry, twist=self._twist)

    def command(self, twist: Twist) -> Twist:
        """Take a set-point; return it clipped, or zero unless ACTIVE."""
        if not (math.isfinite(twist.linear_m_s) and math.isfinite(twist.angular_rad_s)):
            self._set(STAND)
            raise ValueError(f"a twist must be finite, not {twist}")
        self._set(LIMITS.clip(twist) if self.state is Lifecycle.ACTIVE else STAND)
        return self._twist

    def close(self) -> None:
        """Stand still and forget."""
        self._twist, self.state = STAND, Lifecycle.CLOSED

    def _set(self, twist: Twist) -> None:
        self._integrate()
        self._twist, self._commanded_s = twist, self._at_s

    def _integrate(self) -> None:
        """Follow the arc of the twist until now, or until the watchdog stopped it."""
        now_s = self._clock.now_s()
        dt = max(0.0, min(now_s, self._commanded_s + WATCHDOG_S) - self._at_s)
        v, w, pose = self._twist.linear_m_s, self._twist.angular_rad_s, self._odometry
        half = 0.5 * w * dt
        chord = v * dt * (math.sin(half) / half if half else 1.0)
        middle = pose.heading_rad + half
        x, y = pose.x_m + chord * math.cos(middle), pose.y_m + chord * math.sin(middle)
        self._odometry, self._at_s = Pose(x, y, math.remainder(middle + half, 2 * math.pi)), now_s
        if now_s - self._commanded_s >= WATCHDOG_S:
            self._twist = STAND
