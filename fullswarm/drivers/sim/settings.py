"""``sim://[host:port/]robot[?option=value&...]``: where a simulated robot lives and what it can do."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from urllib.parse import parse_qsl, urlencode, urlsplit

from fullswarm.config import DEFAULT_WORLD, RangesConfig, SightConfig, WorldConfig
from fullswarm.drivers.actuators import word
from fullswarm.drivers.base import RANGES_TIMEOUT_S, Description, Limits
from fullswarm.drivers.ports import parse_address
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.keys import ROBOT_ID

SENSING_M = 3.0

OPTIONS = (
    "speed_limit_m_s",
    "turn_limit_rad_s",
    "accel_limit_m_s2",
    "turn_accel_limit_rad_s2",
    "radius_m",
    "watchdog_s",
)
"""Options of the URL that are fields of `WorldConfig`; besides, `DELAYS`, ``sensing_m``, and ``ranges_m``: the world
gives this robot a range sensor that reaches so far, with ``ranges_hz`` scans a second; ``pose=no``: it senses odometry
alone; ``engine``: what computes its motion, for its description."""
BODIES = {
    "kinematic": "kinematic disc", "pybullet": "disc", "pybullet-wheels": "disc on wheels",
    "drivetrain": "disc with motors",
}  # fmt: skip
"""Engine of the world → the model of its robots. A URL that does not name the engine says no more than "disc"."""
DELAYS = ("overrun_s", "overrun_m", "dead_time_s")
"""Options of the URL that are fields of `Limits`."""

ACTUATORS = (
    word("lamp", ("off", "white", "red", "yellow", "green", "blue"), "on top of the robot"),
    word("gripper", ("open", "closed"), "at its front; nothing can be carried yet"),
)
"""What every simulated robot has; the first word is the state in which the world begins."""

SCANS_MISSED = 3.0
"""A simulated range sensor is silent when so many scans have not come."""
WHEEL_BASE_RADII = 0.235 / 0.17
"""Distance between the wheels over the radius of the body, of a Create 2 (its Open Interface specification)."""


@dataclass(frozen=True, slots=True)
class SimUrl:
    """A parsed URL."""

    robot: str
    host: str
    port: int
    description: Description
    sensing_m: float


def parse_url(url: str) -> SimUrl:
    """Parse a simulated robot's URL.

    Raises
    ------
    ConfigError
        No such form, robot id, option or value.
    """
    parts = urlsplit(url)
    address, robot = (parts.netloc, parts.path.strip("/")) if parts.path.strip("/") else (DEFAULT_WORLD, parts.netloc)
    if parts.scheme != "sim" or not ROBOT_ID.match(robot):
        raise ConfigError("not a simulated robot", where=url, hint="write sim://r1 or sim://127.0.0.1:7450/r1")
    host, port = parse_address(address, where=url)
    numbers = dict.fromkeys((*OPTIONS, *DELAYS, "sensing_m", "ranges_m", "ranges_hz"), math.nan)
    senses_pose, model = True, BODIES[WorldConfig().engine]
    for key, text in parse_qsl(parts.query, keep_blank_values=True):
        if key == "pose" and text in ("yes", "no"):
            senses_pose = text == "yes"
            continue
        if key == "engine" and text in BODIES:
            model = BODIES[text]
            continue
        if key not in numbers:
            raise ConfigError(f"unknown option '{key}'", where=url, hint=did_you_mean(key, numbers))
        numbers[key] = _positive(text, key, url)
    sensing_m, ranges_m, ranges_hz = (numbers.pop(key) for key in ("sensing_m", "ranges_m", "ranges_hz"))
    overrun_s, overrun_m, dead_time_s = (max(0.0, numbers.pop(key)) for key in DELAYS)  # NaN: 0
    config = WorldConfig().model_copy(update={key: value for key, value in numbers.items() if value > 0})
    config = config.model_copy(update={"sight": SightConfig(pose=senses_pose)})
    if ranges_m > 0.0:
        ranges = RangesConfig(max_m=ranges_m)
        if ranges_hz > 0.0:
            ranges = ranges.model_copy(update={"rate_hz": ranges_hz})
        config = config.model_copy(update={"ranges": ranges})
    sensing_m = sensing_m if sensing_m > 0 else SENSING_M
    description = describe(config, sensing_m)
    limits = replace(description.limits, overrun_s=overrun_s, overrun_m=overrun_m, dead_time_s=dead_time_s)
    return SimUrl(robot, host, port, replace(description, limits=limits, model=model), sensing_m)


def _positive(text: str, key: str, url: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (value > 0 and math.isfinite(value)):
        raise ConfigError(f"{key} = '{text}' is not a positive number", where=url)
    return value


def describe(config: WorldConfig, sensing_m: float = SENSING_M) -> Description:
    """Return what the driver of a robot in this world states of it that senses so far."""
    limits = Limits(
        speed_m_s=config.speed_limit_m_s,
        turn_rad_s=config.turn_limit_rad_s,
        accel_m_s2=config.accel_limit_m_s2,
        turn_accel_rad_s2=config.turn_accel_limit_rad_s2,
    )
    declared = config.engine == "drivetrain" and config.drivetrain.declared
    return Description(
        make="sim",
        model=BODIES[config.engine],
        radius_m=config.declared_radius_m or config.radius_m,
        limits=_with_drivetrain(limits, config) if declared else limits,
        senses_pose=config.sight.pose,
        senses_obstacles=config.ranges is None,
        senses_bumps=True,
        bodies_range_m=sensing_m if config.sight.bodies and config.ranges is None else 0.0,
        ranges_max_m=0.0 if config.ranges is None else config.ranges.max_m,
        ranges_timeout_s=max(RANGES_TIMEOUT_S, 0.0 if config.ranges is None else SCANS_MISSED / config.ranges.rate_hz),
        watchdog_s=config.watchdog_s,
        actuators=ACTUATORS,
    )


def _with_drivetrain(limits: Limits, config: WorldConfig) -> Limits:
    """Return the limits of a robot that states its drivetrain as it is.

    From a command to standstill it goes L = v τ + v² / 2a with the dead time τ, and beyond that, at most: the motors'
    time constant times v; the share by which a wheel is larger than the mean; and sideways what the heading is off
    by, because the wheels differ (the share e of the way over the wheel base) and because turning stops late. All this
    grows faster than the speed, so the share at full speed is enough below it.
    """
    wheels, speed = config.drivetrain, limits.speed_m_s
    accel = wheels.brakes * limits.accel_m_s2
    way_m = speed * wheels.dead_time_s + speed * speed / (2.0 * accel)
    share = wheels.slip + wheels.unequal_wheels
    off_rad = 0.5 * share * way_m / (WHEEL_BASE_RADII * config.radius_m) + wheels.lag_s * limits.turn_rad_s
    overrun_m = wheels.lag_s * speed + way_m * (0.5 * wheels.unequal_wheels + off_rad)
    return replace(
        limits, accel_m_s2=accel, overrun_s=overrun_m / speed, overrun_m=overrun_m, dead_time_s=wheels.dead_time_s
    )


def _options(description: Description) -> dict[str, float]:
    limits = description.limits
    values = (
        limits.speed_m_s, limits.turn_rad_s, limits.accel_m_s2, limits.turn_accel_rad_s2, description.radius_m,
        description.watchdog_s,
    )  # fmt: skip
    return {**dict(zip(OPTIONS, values, strict=True)), **{key: getattr(limits, key) for key in DELAYS}}


def url_for(config: WorldConfig, robot: str, sensing_m: float = SENSING_M) -> str:
    """Return the URL of a robot of this world; it names only what differs from the defaults."""
    usual, own = _options(describe(WorldConfig())), _options(describe(config.of_body(robot)))
    options: dict[str, float | str] = {key: value for key, value in own.items() if value != usual[key]}
    if sensing_m != SENSING_M:
        options["sensing_m"] = sensing_m
    ranges = config.of_body(robot).ranges
    if ranges is not None:
        options["ranges_m"] = ranges.max_m
        if ranges.rate_hz != RangesConfig().rate_hz:
            options["ranges_hz"] = ranges.rate_hz
    if not config.sight.pose:
        options["pose"] = "no"
    if config.engine != WorldConfig().engine:
        options["engine"] = config.engine
    place = "" if config.address == DEFAULT_WORLD else f"{config.address}/"
    return f"sim://{place}{robot}" + (f"?{urlencode(options)}" if options else "")
