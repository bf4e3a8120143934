"""Decides whether a robot is fit for a request: what the request needs beside what the robot states of itself.

The core asks for the robots of a request, and each robot again on board: what the core knows may be old.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import msgspec

from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.messages import Needs, RobotProfile
from fullswarm.reasons import NONE, Code, Reason, reason

ANYTHING = Needs()
ROUNDING = 1e-9
"""Limits go through arithmetic before they are compared."""


def needs_of(given: Mapping[str, Any], where: str = "needs") -> Needs:
    """Return what a table needs: ``{"capabilities": ["gripper"], "speed_m_s": 0.3}``; `where` names it in errors.

    Raises
    ------
    ConfigError
        A key is unknown, or has another value than it can.
    """
    for name in given:
        if name not in Needs.__struct_fields__:
            raise ConfigError(
                f"unknown key '{name:.64}'", where=where, hint=did_you_mean(name, Needs.__struct_fields__)
            )
    try:
        return msgspec.convert(dict(given), Needs)
    except msgspec.ValidationError as error:
        what, _, key = str(error).partition(" - at `$.")
        raise ConfigError(f"{key.rstrip('`')}: {what}" if key else what, where=where) from None


def both(one: Needs, other: Needs) -> Needs:
    """Return what is needed for both; of two lists of makes those in both; none: no robot is fit."""
    if ANYTHING in (one, other):
        return one if other == ANYTHING else other
    makes = one.makes or other.makes
    if one.makes and other.makes:
        common = tuple(each for each in one.makes if each in other.makes)
        makes = common or (f"{' or '.join(one.makes)} and also {' or '.join(other.makes)}",)  # no robot's
    sizes = [each.radius_m for each in (one, other) if each.radius_m > 0.0]
    return Needs(
        capabilities=tuple(dict.fromkeys((*one.capabilities, *other.capabilities))),
        makes=makes,
        speed_m_s=max(one.speed_m_s, other.speed_m_s),
        turn_rad_s=max(one.turn_rad_s, other.turn_rad_s),
        accel_m_s2=max(one.accel_m_s2, other.accel_m_s2),
        radius_m=min(sizes, default=0.0),
        battery=max(one.battery, other.battery),
    )


def unfit(needs: Needs, profile: RobotProfile) -> Reason:
    """Return why a robot cannot take part; false: it can."""
    lacking, slow = list(_lacking(needs, profile)), list(_slow(needs, profile))
    if lacking:
        return reason(Code.UNFIT, what="; ".join((*lacking, *slow)))
    return reason(Code.TOO_SLOW, what="; ".join(slow)) if slow else NONE


def _lacking(needs: Needs, profile: RobotProfile) -> Iterator[str]:
    absent = [each for each in needs.capabilities if each not in profile.capabilities]
    if absent:
        yield f"it has no {', no '.join(absent)}"
    if needs.makes and profile.make not in needs.makes:
        yield f"its make is '{profile.make}', not {' or '.join(needs.makes)}"
    if 0.0 < needs.radius_m < profile.radius_m - ROUNDING:
        yield f"its radius is {profile.radius_m:g} m, and {needs.radius_m:g} m is allowed"
    if needs.battery > 0.0 and profile.battery < 0.0:
        yield f"its charge is unknown, and {needs.battery:.0%} is needed"
    elif profile.battery < needs.battery - ROUNDING and needs.battery > 0.0:
        yield f"its charge is {profile.battery:.0%}, and {needs.battery:.0%} is needed"


def _slow(needs: Needs, profile: RobotProfile) -> Iterator[str]:
    for what, unit, has, needed in (
        ("speed", "m/s", profile.speed_limit_m_s, needs.speed_m_s),
        ("turn rate", "rad/s", profile.turn_limit_rad_s, needs.turn_rad_s),
        ("acceleration", "m/s²", profile.accel_m_s2, needs.accel_m_s2),
    ):
        if has < needed - ROUNDING:
            yield f"its {what} is {has:g} {unit}, and {needed:g} {unit} is needed"
