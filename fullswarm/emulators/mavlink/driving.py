"""How ArduRover drives: what it makes of set-points and sticks, and how its motors follow. NED on the wire, ENU here.

Only the pairs x/y, vx/vy and ax/ay of a set-point's mask count; a combination that the firmware has no use for is
silently ignored, and so is any frame but 1, 7, 8 and 9. Of the pilots only the controlling station counts, and its
sticks are centred after RC_OVERRIDE_TIME. Stops are as measured on the real firmware's simulator.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import Any

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.emulators.mavlink.position import Chart
from fullswarm.geometry import clamp, wrap
from fullswarm.simulation.bodies import BodyState

LOCAL_FRAMES = frozenset({1, 7, 8, 9})
GLOBAL_FRAMES = frozenset({0, 3, 5, 6, 10, 11})
BODY_FRAMES = frozenset({8, 9})
THRUST_IGNORED, BODY_YAW_RATE_IGNORED = 64, 4
OVERFLOW = 1.8e19  # what a 32-bit float cannot square
NAN_TURN_M_S = 0.31  # measured: with a turn rate that is NaN it drives straight on, at most this fast
HEADING_GAIN = 2.0
PIVOT_RAD = math.radians(60.0)
APPROACH_M_S2, APPROACH_HZ, APPROACH_M_S = 0.35, 0.3, 0.1  # 6 m take 8.3 s
ARRIVED_M = 0.22
CENTRE_US, SPAN_US = 1500.0, 500.0
FULL_M_S = 3.66  # at full throttle in MANUAL: 1750 µs gave 1.83 m/s
NOT_GIVEN, RELEASED = 65535, 0
ABSENT = 32767  # MANUAL_CONTROL: this axis is not given
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


@dataclass(frozen=True, slots=True)
class Limits:
    """The parameters that bound a set-point."""

    speed_m_s: float
    turn_rad_s: float


@dataclass(frozen=True, slots=True)
class Target:
    """What the rover is to do, world frame: speed with a turn rate or a heading, or a place (at most so fast)."""

    speed_m_s: float = 0.0
    turn_rad_s: float = 0.0
    heading_rad: float | None = None
    place_m: tuple[float, float] | None = None
    odd: bool = False  # a number was none: the firmware reports an internal error


def from_local(message: Any, state: BodyState, limits: Limits, chart: Chart) -> Target | None:
    """Return what SET_POSITION_TARGET_LOCAL_NED requests; None: silently ignored."""
    if message.coordinate_frame not in LOCAL_FRAMES:
        return None
    place = None
    if not message.type_mask & 0b11:
        place = _local_place(message, state, chart)
    return _target(message, place, state, limits)


def from_global(message: Any, state: BodyState, limits: Limits, chart: Chart) -> Target | None:
    """Return what SET_POSITION_TARGET_GLOBAL_INT requests; None: silently ignored."""
    if message.coordinate_frame not in GLOBAL_FRAMES:
        return None
    place = None if message.type_mask & 0b11 else chart.place(message.lat_int / 1e7, message.lon_int / 1e7)
    return _target(message, place, state, limits)


def from_attitude(message: Any, limits: Limits) -> Target | None:
    """Return what SET_ATTITUDE_TARGET requests: thrust is a share of WP_SPEED."""
    if message.type_mask & THRUST_IGNORED or not math.isfinite(message.thrust):
        return None
    speed = clamp(message.thrust, -1.0, 1.0) * limits.speed_m_s
    if not message.type_mask & BODY_YAW_RATE_IGNORED:
        rate = 0.0 if math.isnan(message.body_yaw_rate) else -message.body_yaw_rate
        return Target(speed, clamp(rate, -limits.turn_rad_s, limits.turn_rad_s))
    w, x, y, z = message.q
    yaw = math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    return Target(speed, heading_rad=p.heading_from_yaw(yaw)) if math.isfinite(yaw) else None


def traps(message: Any) -> bool:
    """Whether the firmware's simulator ends by a floating-point exception; real boards go on."""
    used = [message.yaw_rate] if not message.type_mask & 2048 else []
    if not message.type_mask & 0b11000:
        used += [message.vx, message.vy]
    return any(math.isnan(value) or OVERFLOW < abs(value) < math.inf for value in used)


def _local_place(message: Any, state: BodyState, chart: Chart) -> tuple[float, float] | None:
    x, y, _ = p.enu_from_ned(message.x, message.y, 0.0)
    if not (math.isfinite(x) and math.isfinite(y)):
        return None
    if message.coordinate_frame == 1:
        return chart.world_place(y, x)
    if message.coordinate_frame in BODY_FRAMES:
        cos, sin = math.cos(state.heading_rad), math.sin(state.heading_rad)
        forward, left = message.x, -message.y
        x, y = cos * forward - sin * left, sin * forward + cos * left
    return state.x_m + x, state.y_m + y


def _target(message: Any, place: tuple[float, float] | None, state: BodyState, limits: Limits) -> Target | None:
    mask = message.type_mask
    velocity, acceleration = not mask & 0b11000, not mask & 0b11000000
    heading, turn = not mask & 1024, not mask & 2048
    if not mask & 0b11:
        return Target(place_m=place) if place is not None and all(map(math.isfinite, place)) else None
    if acceleration or (heading and turn) or not (velocity or heading or turn):
        return None
    speed = math.hypot(message.vx, message.vy) if velocity else 0.0
    speed = 0.0 if math.isnan(message.vx + message.vy) and velocity else min(speed, limits.speed_m_s)
    if message.vx < 0.0 and (heading or turn):
        speed = -speed
    if turn:
        rate = -message.yaw_rate
        if math.isnan(rate):
            return Target(clamp(speed, -NAN_TURN_M_S, NAN_TURN_M_S), odd=True)
        return Target(speed, clamp(rate, -limits.turn_rad_s, limits.turn_rad_s))
    yaw = message.yaw if heading else math.atan2(message.vy, message.vx)
    if not math.isfinite(yaw):
        return Target()
    # Anchored to the heading at this moment: sent again and again, a vector that points behind never stops turning.
    aim = state.heading_rad - yaw if message.coordinate_frame in BODY_FRAMES else p.heading_from_yaw(yaw)
    return Target(speed, heading_rad=wrap(aim))


def steer(target: Target, state: BodyState, limits: Limits) -> tuple[float, float] | None:
    """Return speed and turn rate that lead to a target; None once a place is reached."""
    if target.place_m is None:
        if target.heading_rad is None:
            return target.speed_m_s, target.turn_rad_s
        return target.speed_m_s, _turn_to(target.heading_rad, state, limits)
    east, north = target.place_m[0] - state.x_m, target.place_m[1] - state.y_m
    distance = math.hypot(east, north)
    if distance < ARRIVED_M:
        return None
    bearing = math.atan2(north, east)
    if abs(wrap(bearing - state.heading_rad)) > PIVOT_RAD:
        return 0.0, _turn_to(bearing, state, limits)
    top = target.speed_m_s or limits.speed_m_s
    speed = min(top, limits.speed_m_s, math.sqrt(2.0 * APPROACH_M_S2 * distance), APPROACH_HZ * distance + APPROACH_M_S)
    return speed, _turn_to(bearing, state, limits)


def _turn_to(heading_rad: float, state: BodyState, limits: Limits) -> float:
    return clamp(HEADING_GAIN * wrap(heading_rad - state.heading_rad), -limits.turn_rad_s, limits.turn_rad_s)


# ---------------------------------------------------------------- sticks
class Sticks:
    """Steering and throttle as pulse widths (µs, 1500 is the centre)."""

    def __init__(self) -> None:
        self.steering_us = self.throttle_us = CENTRE_US
        self._received_s = -math.inf

    def manual_control(self, message: Any, now_s: float) -> None:
        """Take MANUAL_CONTROL: y steers, z is the throttle, each -1000 to 1000."""
        if message.y != ABSENT:
            self.steering_us = CENTRE_US + clamp(message.y, -1000, 1000) / 2.0
        if message.z != ABSENT:
            self.throttle_us = CENTRE_US + clamp(message.z, -1000, 1000) / 2.0
        self._received_s = now_s

    def override(self, message: Any, now_s: float) -> None:
        """Take RC_CHANNELS_OVERRIDE: channels 1 and 3."""
        if message.chan1_raw != NOT_GIVEN:
            self.steering_us = message.chan1_raw or CENTRE_US
        if message.chan3_raw != NOT_GIVEN:
            self.throttle_us = message.chan3_raw or CENTRE_US
        self._received_s = now_s

    def step(self, now_s: float, timeout_s: float) -> None:
        """Centre the sticks when no message has moved them for `timeout_s`."""
        if now_s - self._received_s > timeout_s:
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
        """Return the speed in GUIDED: a throttle that commands more in the same direction overrides it."""
        throttle_m_s = self.throttle * cruise_m_s / max(cruise_throttle, 0.05)
        if throttle_m_s > 0.0 and speed_m_s >= 0.0:
            return max(throttle_m_s, speed_m_s)
        return min(throttle_m_s, speed_m_s) if throttle_m_s < 0.0 and speed_m_s < 0.0 else speed_m_s


# ---------------------------------------------------------------- motors
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
        """Follow a throttle without a speed controller; zero: the motors drag (HOLD, sticks centred)."""
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
