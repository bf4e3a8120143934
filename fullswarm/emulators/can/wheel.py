"""What emulated motor controllers have in common: a wheel that follows with a lag, and injected faults."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from fullswarm.drivers.can.protocol import Frame

STEP_S = 0.01
BOOT_S = 0.8
"""From a reboot to the first frame."""
DRIVEN_S, BRAKED_S = 0.03, 0.1
"""Time constants of a wheel that is regulated, braked."""
FRICTION_M_S2 = 1.5
"""What slows a wheel without motor torque: geared motors roll out soon."""
STANDSTILL_M_S = 1e-3
"""A wheel that is regulated to zero is at standstill below this."""
STOPS_M = 5e-4
"""A position regulator whose wheel is nearer to its target sets no speed."""


class Sender(Protocol):
    """Where an emulated controller's frames go."""

    def send(self, frame: Frame) -> None:
        """Put `frame` on the bus."""
        ...


class Spin:
    """A wheel that follows a set speed with a first-order lag, and how the body moves it."""

    def __init__(self) -> None:
        self.speed_m_s = 0.0  # of the motor
        self.measured_m_s = 0.0  # of the wheel, as the body moves it
        self.travelled_m = 0.0
        self._now_s: float | None = None

    def step(self, target_m_s: float, lag_s: float | None, now_s: float) -> None:
        """Move on to `now_s`; without a lag the motor has no torque and the wheel rolls out."""
        passed_s = 0.0 if self._now_s is None else max(0.0, now_s - self._now_s)
        self._now_s = now_s
        if lag_s is None:
            slowed_m_s = max(0.0, abs(self.speed_m_s) - FRICTION_M_S2 * passed_s)
            self.speed_m_s = math.copysign(slowed_m_s, self.speed_m_s)
        else:
            self.speed_m_s += (target_m_s - self.speed_m_s) * -math.expm1(-passed_s / lag_s)
            if target_m_s == 0.0 and abs(self.speed_m_s) < STANDSTILL_M_S:
                self.speed_m_s = 0.0

    def push(self, accel_m_s2: float, limit_m_s: float, now_s: float) -> None:
        """Move on to `now_s` under a motor torque that alone would give `accel_m_s2`; friction works against it.

        The motor drives no faster than `limit_m_s`, by its back EMF or by the controller's own limit.
        """
        passed_s = 0.0 if self._now_s is None else max(0.0, now_s - self._now_s)
        self._now_s = now_s
        if self.speed_m_s == 0.0 and abs(accel_m_s2) <= FRICTION_M_S2:
            return
        friction_m_s2 = math.copysign(FRICTION_M_S2, self.speed_m_s or accel_m_s2)
        speed_m_s = self.speed_m_s + (accel_m_s2 - friction_m_s2) * passed_s
        if speed_m_s * self.speed_m_s < 0.0 and abs(accel_m_s2) <= FRICTION_M_S2:
            speed_m_s = 0.0
        most_m_s = max(limit_m_s, abs(self.speed_m_s) - FRICTION_M_S2 * passed_s)
        self.speed_m_s = max(-most_m_s, min(most_m_s, speed_m_s))

    def measure(self, travelled_m: float, speed_m_s: float) -> None:
        """Take note of how far the body has carried the wheel, and how fast it turns."""
        self.travelled_m, self.measured_m_s = travelled_m, speed_m_s


@dataclass(slots=True)
class ControllerFaults:
    """The injected faults of one emulated controller now."""

    unplugged: bool = False  # receives nothing, sends nothing
    muted: bool = False  # receives, sends nothing
    silent_motion: bool = False  # does not report how the wheel moves
    stuck_sensor: bool = False  # reports the same motion again and again
    estop: bool = False  # the button is pressed
    booting_until_s: float = -math.inf

    def receives(self, now_s: float) -> bool:
        """Return whether it receives frames."""
        return not self.unplugged and now_s >= self.booting_until_s

    def sends(self, now_s: float) -> bool:
        """Return whether it sends frames."""
        return not self.muted and self.receives(now_s)
