"""What ArduRover makes of a set-point in GUIDED, and how it drives to what it was told. ENU inside, NED on the wire.

Only the pairs x/y, vx/vy and ax/ay of the mask count; a combination that the firmware has no use for is ignored
without a word, and so is any frame but 1, 7, 8 and 9.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.emulators.mavlink.rover.chart import Chart
from fullswarm.geometry import clamp, wrap
from fullswarm.simulation.bodies import BodyState

LOCAL_FRAMES = frozenset({1, 7, 8, 9})
GLOBAL_FRAMES = frozenset({0, 3, 5, 6, 10, 11})
BODY_FRAMES = frozenset({8, 9})
THRUST_IGNORED, BODY_YAW_RATE_IGNORED = 64, 4
OVERFLOW = 1.8e19  # what a 32-bit float cannot square
NAN_TURN_M_S = 0.31  # measured: with a turn rate that is no number it drives straight on, at most so fast
HEADING_GAIN = 2.0
PIVOT_RAD = math.radians(60.0)
APPROACH_M_S2, APPROACH_HZ, APPROACH_M_S = 0.35, 0.3, 0.1  # 6 m take 8.3 s
ARRIVED_M = 0.22


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
    """Return what SET_POSITION_TARGET_LOCAL_NED asks for; None: silently ignored."""
    if message.coordinate_frame not in LOCAL_FRAMES:
        return None
    place = None
    if not message.type_mask & 0b11:
        place = _local_place(message, state, chart)
    return _target(message, place, state, limits)


def from_global(message: Any, state: BodyState, limits: Limits, chart: Chart) -> Target | None:
    """Return what SET_POSITION_TARGET_GLOBAL_INT asks for; None: silently ignored."""
    if message.coordinate_frame not in GLOBAL_FRAMES:
        return None
    place = None if message.type_mask & 0b11 else chart.place(message.lat_int / 1e7, message.lon_int / 1e7)
    return _target(message, place, state, limits)


def from_attitude(message: Any, limits: Limits) -> Target | None:
    """Return what SET_ATTITUDE_TARGET asks for: thrust is a share of WP_SPEED."""
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
    """Whether the firmware's simulator dies of a floating-point exception; real boards live on."""
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
    # Anchored to the heading at this moment: sent again and again, a vector that points behind turns for ever.
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
