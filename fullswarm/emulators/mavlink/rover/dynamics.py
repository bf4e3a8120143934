"""How a skid-steer rover's motors speed up, brake and coast: stops as measured on the real firmware's simulator."""

from __future__ import annotations

import math
from collections import deque

from fullswarm.geometry import clamp

LAG_STEPS = 3  # a set-point reaches the servo outputs 43 to 94 ms after it arrives
OVERDRIVE = 1.08  # the controller exceeds ATC_ACCEL_MAX by as much when it brakes, ATC_STR_ACC_MAX by a tenth
TURN_OVERDRIVE = 1.1
WINDUP, UNWIND_S = 0.12, 0.8
"""Speeding up winds up the controller's integral by this share of the acceleration: 4 to 8 % too fast for a second."""
BRAKE_UNWIND_S = 0.1
SPEEDING = OVERDRIVE / (1.0 + WINDUP)
CREEP_M_S, CREEP_S = 0.15, 0.38  # the last of an error goes slowly: the controller's integral unwinds
NEAR_M_S, NEAR_RAD_S = 0.004, 0.004
WOUND_M_S = 0.0005
TURN_COAST_S = 0.2
Speeds = tuple[float, float]
STAND: Speeds = (0.0, 0.0)


class Motors:
    """Speed and turn rate (counter-clockwise) that the motors give now; each call moves on by `dt_s`."""

    def __init__(self) -> None:
        self.speed_m_s = self.turn_rad_s = 0.0
        self._wound_m_s = 0.0  # the part of the speed that is overshoot
        self._on_the_way: deque[Speeds] = deque([STAND] * LAG_STEPS)

    def follow(self, target: Speeds, accel_m_s2: float, turn_accel_rad_s2: float, dt_s: float) -> None:
        """Approach a target within the accelerations, as the speed controllers do."""
        self._on_the_way.append(target)
        speed, turn = self._on_the_way.popleft()
        steady = self.speed_m_s - self._wound_m_s
        error, speeding = speed - steady, abs(speed) > abs(steady) and speed * steady >= 0.0
        step = (SPEEDING if speeding else OVERDRIVE) * accel_m_s2 * dt_s
        gained = 0.0
        if abs(error) <= NEAR_M_S:
            steady = speed
        elif speeding:
            gained = clamp(error, -step, step)
            steady += gained
        elif abs(error) <= CREEP_M_S:
            steady += clamp(error * (1.0 - math.exp(-dt_s / CREEP_S)), -step, step)
        else:
            steady += clamp(error, -step, step)
        unwind_s = UNWIND_S if abs(speed) >= abs(steady) else BRAKE_UNWIND_S
        self._wound_m_s = _towards(self._wound_m_s, 0.0, unwind_s, dt_s, WOUND_M_S) + WINDUP * gained
        self.speed_m_s = steady + self._wound_m_s
        step = TURN_OVERDRIVE * turn_accel_rad_s2 * dt_s
        self.turn_rad_s += clamp(turn - self.turn_rad_s, -step, step)

    def push(self, speed_m_s: float, turn_rad_s: float, dt_s: float) -> None:
        """Give way to a throttle without a speed controller; zero: the motors drag (HOLD, sticks centred)."""
        self._forget()
        self._decay(speed_m_s, turn_rad_s, 0.28 + 0.14 * abs(self.speed_m_s), dt_s)

    def cut(self, dt_s: float) -> None:
        """Roll on without power (disarmed): faster to stop, slow at the very end."""
        self._forget()
        speed = abs(self.speed_m_s)
        self._decay(0.0, 0.0, 0.205 + 0.03 * speed if speed > CREEP_M_S else 0.37, dt_s)

    def _forget(self) -> None:
        self._wound_m_s = 0.0
        self._on_the_way = deque([STAND] * LAG_STEPS)

    def _decay(self, speed_m_s: float, turn_rad_s: float, time_s: float, dt_s: float) -> None:
        self.speed_m_s = _towards(self.speed_m_s, speed_m_s, time_s, dt_s, NEAR_M_S)
        self.turn_rad_s = _towards(self.turn_rad_s, turn_rad_s, TURN_COAST_S, dt_s, NEAR_RAD_S)


def _towards(value: float, target: float, time_s: float, dt_s: float, near: float) -> float:
    left = (value - target) * math.exp(-dt_s / time_s)
    return target if abs(left) < near else target + left
