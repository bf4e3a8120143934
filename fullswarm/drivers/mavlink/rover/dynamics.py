"""How a skid-steer rover's motors speed up, brake and coast: stops as measured on the real firmware's simulator."""

from __future__ import annotations

import math
from collections import deque

from fullswarm.geometry import clamp

LAG_STEPS = 3  # a set-point reaches the servo outputs 43 to 94 ms after it arrives
OVERDRIVE = 1.08  # the controller exceeds ATC_ACCEL_MAX by as much, ATC_STR_ACC_MAX by a tenth
TURN_OVERDRIVE = 1.1
CREEP_M_S, CREEP_S = 0.15, 0.38  # the last of an error goes slowly: the controller's integral unwinds
NEAR_M_S, NEAR_RAD_S = 0.004, 0.004
TURN_COAST_S = 0.2
Speeds = tuple[float, float]
STAND: Speeds = (0.0, 0.0)


class Motors:
    """Speed and turn rate (counter-clockwise) that the motors give now; each call moves on by `dt_s`."""

    def __init__(self) -> None:
        self.speed_m_s = self.turn_rad_s = 0.0
        self._on_the_way: deque[Speeds] = deque([STAND] * LAG_STEPS)

    def follow(self, target: Speeds, accel_m_s2: float, turn_accel_rad_s2: float, dt_s: float) -> None:
        """Approach a target within the accelerations, as the speed controllers do."""
        self._on_the_way.append(target)
        speed, turn = self._on_the_way.popleft()
        error, step = speed - self.speed_m_s, OVERDRIVE * accel_m_s2 * dt_s
        if abs(error) <= NEAR_M_S:
            self.speed_m_s = speed
        elif abs(error) <= CREEP_M_S:
            self.speed_m_s += clamp(error * (1.0 - math.exp(-dt_s / CREEP_S)), -step, step)
        else:
            self.speed_m_s += clamp(error, -step, step)
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
        self._on_the_way = deque([STAND] * LAG_STEPS)

    def _decay(self, speed_m_s: float, turn_rad_s: float, time_s: float, dt_s: float) -> None:
        self.speed_m_s = _towards(self.speed_m_s, speed_m_s, time_s, dt_s, NEAR_M_S)
        self.turn_rad_s = _towards(self.turn_rad_s, turn_rad_s, TURN_COAST_S, dt_s, NEAR_RAD_S)


def _towards(value: float, target: float, time_s: float, dt_s: float, near: float) -> float:
    left = (value - target) * math.exp(-dt_s / time_s)
    return target if abs(left) < near else target + left
