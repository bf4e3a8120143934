"""A pilot's sticks over MAVLink: only the controlling station's count, and they are let go after RC_OVERRIDE_TIME."""

from __future__ import annotations

import math
from typing import Any

from fullswarm.geometry import clamp

CENTRE_US, SPAN_US = 1500.0, 500.0
FULL_M_S = 3.66  # at full throttle in MANUAL: 1750 µs gave 1.83 m/s
NOT_GIVEN, RELEASED = 65535, 0
ABSENT = 32767  # MANUAL_CONTROL: this axis is not given


class Sticks:
    """Steering and throttle as pulse widths (µs, 1500 is the centre)."""

    def __init__(self) -> None:
        self.steering_us = self.throttle_us = CENTRE_US
        self._heard_s = -math.inf

    def manual_control(self, message: Any, now_s: float) -> None:
        """Take MANUAL_CONTROL: y steers, z is the throttle, each -1000 to 1000."""
        if message.y != ABSENT:
            self.steering_us = CENTRE_US + clamp(message.y, -1000, 1000) / 2.0
        if message.z != ABSENT:
            self.throttle_us = CENTRE_US + clamp(message.z, -1000, 1000) / 2.0
        self._heard_s = now_s

    def override(self, message: Any, now_s: float) -> None:
        """Take RC_CHANNELS_OVERRIDE: channels 1 and 3."""
        if message.chan1_raw != NOT_GIVEN:
            self.steering_us = message.chan1_raw or CENTRE_US
        if message.chan3_raw != NOT_GIVEN:
            self.throttle_us = message.chan3_raw or CENTRE_US
        self._heard_s = now_s

    def step(self, now_s: float, timeout_s: float) -> None:
        """Let go of the sticks when nobody has moved them for `timeout_s`."""
        if now_s - self._heard_s > timeout_s:
            self.steering_us = self.throttle_us = CENTRE_US

    @property
    def throttle(self) -> float:
        """Throttle, -1 to 1."""
        return clamp((self.throttle_us - CENTRE_US) / SPAN_US, -1.0, 1.0)

    @property
    def steering(self) -> float:
        """Steering, -1 to 1, to the right positive."""
        return clamp((self.steering_us - CENTRE_US) / SPAN_US, -1.0, 1.0)

    def nudge(self, speed_m_s: float, cruise_m_s: float, cruise_throttle: float) -> float:
        """Return what becomes of GUIDED's speed: a throttle that asks for more in the same direction wins."""
        wish = self.throttle * cruise_m_s / max(cruise_throttle, 0.05)
        if wish > 0.0 and speed_m_s >= 0.0:
            return max(wish, speed_m_s)
        return min(wish, speed_m_s) if wish < 0.0 and speed_m_s < 0.0 else speed_m_s
