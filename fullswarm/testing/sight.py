"""A look at one reading or one answer of a driver: returns what is wrong with it, empty when nothing is."""

from __future__ import annotations

import math
from collections.abc import Iterator

from fullswarm.drivers.base import Description, Hazard, Limits, Reading, Twist
from fullswarm.geometry import wrap

AGE_S, EARLY_S = 2.0, 0.02
QUANTUM = 1e-3
"""Share of a limit by which the rounding to what the device can express may go beyond it."""
REST = 0.04
"""Share of a limit that the rounding of a zero may come to."""
LEAP, LEAP_M, LEAP_RAD = 2.0, 0.1, 0.3
"""Odometry goes from one reading to the next at most this many times the limit's way, and this much more."""


def check_reading(
    reading: Reading, before: Reading | None, description: Description, now_s: float, opened_s: float
) -> str:
    """Look at a reading that follows `before`."""
    return next(_wrong_reading(reading, before, description, now_s, opened_s), "")


def check_applied(wished: Twist, applied: object, limits: Limits) -> str:
    """Look at what command() says that it applied."""
    return next(_wrong_answer(wished, applied, limits), "")


def _wrong_reading(
    reading: Reading, before: Reading | None, description: Description, now_s: float, opened_s: float
) -> Iterator[str]:
    age_s = now_s - reading.stamp_s
    if not (-EARLY_S <= age_s <= AGE_S and reading.stamp_s >= opened_s):
        yield (
            f"a reading is stamped {age_s:.3f} s before it was read and {reading.stamp_s - opened_s:.3f} s after "
            "open(); stamp it with the monotonic clock's time of arrival, and forget the readings of an earlier life"
        )
    if before is not None and reading.stamp_s <= before.stamp_s:
        yield "stamps of readings go back; drop what arrives out of order"
    poses = [reading.odometry] + ([reading.pose] if reading.pose is not None else [])
    numbers = [reading.twist.linear_m_s, reading.twist.angular_rad_s]
    for pose in poses:
        numbers += [pose.x_m, pose.y_m, pose.heading_rad]
        if abs(pose.heading_rad) > math.pi:
            yield f"heading {pose.heading_rad} is not in [-pi, pi]; wrap it"
    if not all(map(math.isfinite, numbers)):
        yield f"a reading is not finite: {reading}; unknown values are None"
    yield from _wrong_senses(reading, description)
    if before is not None:
        yield from _leap(before, reading, description.limits)


def _wrong_senses(reading: Reading, description: Description) -> Iterator[str]:
    battery, obstacles = reading.battery, reading.obstacles
    if battery is not None and not 0.0 <= battery <= 1.0:
        yield f"battery {battery} is not None or 0 to 1"
    if obstacles.ndim != 2 or obstacles.shape[1] != 6:
        yield f"obstacles have shape {obstacles.shape}, not (k, 6)"
    if reading.contacts < 0:
        yield f"contacts are {reading.contacts}"
    told = (reading.pose is not None, len(obstacles) > 0, Hazard.BUMP in reading.hazards)
    senses = (description.senses_pose, description.senses_obstacles, description.senses_bumps)
    for what, tells, claims in zip(("pose", "obstacles", "bumps"), told, senses, strict=True):
        if tells and not claims:
            yield f"it tells {what}, but its description denies it; set senses_{what}"


def _leap(before: Reading, after: Reading, limits: Limits) -> Iterator[str]:
    """Compare the way between two readings with what the wheels can do in that time."""
    passed_s, old, new = after.stamp_s - before.stamp_s, before.odometry, after.odometry
    gone_m, turned = math.hypot(new.x_m - old.x_m, new.y_m - old.y_m), wrap(new.heading_rad - old.heading_rad)
    if gone_m > LEAP * limits.speed_m_s * passed_s + LEAP_M or abs(turned) > (
        LEAP * limits.turn_rad_s * passed_s + LEAP_RAD
    ):
        yield (
            f"odometry leaps by {gone_m:.2f} m, {turned:.2f} rad in {passed_s:.3f} s; check its scale (m, rad) and "
            "each frame's checksum and length; begin anew at the next one instead of believing an impossible step"
        )


def _wrong_answer(wished: Twist, applied: object, limits: Limits) -> Iterator[str]:
    said = f"command({wished}) returns {applied}"
    if not isinstance(applied, Twist):
        yield f"{said}, not a Twist: return what was really applied"
        return
    for name, wish, value, limit in (
        ("linear", wished.linear_m_s, applied.linear_m_s, limits.speed_m_s),
        ("angular", wished.angular_rad_s, applied.angular_rad_s, limits.turn_rad_s),
    ):
        if not math.isfinite(value):
            yield f"{said}, which is not finite; clip before you calculate"
        if abs(value) > limit * (1.0 + QUANTUM):
            yield f"{said}, {name} beyond {limit}; clip to description.limits"
        if value * wish < 0.0:
            yield f"{said}, {name} the other way round"
        if wish == 0.0 and abs(value) > REST * limit:
            yield f"{said}, {name} although zero was wished"
    if not limits.can_reverse and applied.linear_m_s < 0.0:
        yield f"{said}, but its description says: no reversing"
