"""A Create's URL, checked, and what is known of the robot before connecting.

``create:///dev/ttyUSB0?model=create2``; ``model`` is ``create1``, ``roomba500`` or ``create2`` (default), ``baud``
overrides the model's rate, ``mode_offset=1`` is for firmware that reports its mode one too high, ``speed_step=28.5``
for wheels that only know multiples of so many mm/s: `command()` then rounds to them and returns what is applied,
``guardian=1`` has the port held by a process that stops the robot when this one is paused or killed (agents and `robots
test` do so unless it is 0 in the URL).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from urllib.parse import parse_qsl, unquote, urlsplit

from fullswarm.drivers.base import Description, Limits
from fullswarm.drivers.create_oi.panel import actuators
from fullswarm.drivers.create_oi.protocol import BAUD_CODES, CREATE2, GENERATIONS, TOP_MM_S, Generation
from fullswarm.drivers.make import Claim, device_claim
from fullswarm.errors import ConfigError, did_you_mean

ACCEL_M_S2 = 1.0
"""What the wheels do without slipping on a lab floor; the robot itself takes any step."""

SLOWEST_BAUD = 19200
COARSEST_MM_S = 100.0
OPTIONS = ("model", "baud", "mode_offset", "speed_step", "guardian")


@dataclass(frozen=True, slots=True)
class Settings:
    """The options of a URL."""

    path: str
    generation: Generation = CREATE2
    baud: int = CREATE2.baud
    mode_offset: int = 0
    speed_step_mm_s: float = 0.0
    guardian: bool | None = None  # None: the opener of the driver decides


def parse_url(url: str) -> Settings:
    """Read a driver URL.

    Raises
    ------
    ConfigError
        Another scheme, no path, an unknown option or a value that does not fit.
    """
    parts = urlsplit(url)
    path = unquote(parts.path)
    if parts.scheme != "create" or parts.netloc or not path.startswith("/") or path == "/":
        raise ConfigError("this names no serial port", where=url, hint="write create:///dev/ttyUSB0?model=create2")
    options = dict(parse_qsl(parts.query, keep_blank_values=True))
    for name in options.keys() - set(OPTIONS):
        raise ConfigError(f"unknown option '{name}'", where=url, hint=did_you_mean(name, OPTIONS))
    model = options.get("model", CREATE2.name)
    if model not in GENERATIONS:
        raise ConfigError(f"unknown model '{model}'", where=url, hint=did_you_mean(model, GENERATIONS))
    generation = GENERATIONS[model]
    rates = tuple(rate for rate in BAUD_CODES.values() if rate >= SLOWEST_BAUD)
    return Settings(
        path,
        generation,
        _choice(url, "baud", options.get("baud", str(generation.baud)), rates),
        _choice(url, "mode_offset", options.get("mode_offset", "0"), (0, 1)),
        _step(url, options.get("speed_step", "0")),
        bool(_choice(url, "guardian", options["guardian"], (0, 1))) if "guardian" in options else None,
    )


def _choice(url: str, name: str, text: str, choices: tuple[int, ...]) -> int:
    for each in choices:
        if text == str(each):
            return each
    raise ConfigError(f"{name} '{text}' will not do", where=url, hint=f"one of {', '.join(map(str, choices))}")


def _step(url: str, text: str) -> float:
    try:
        step = float(text)
    except ValueError:
        step = math.nan
    if not 0.0 <= step <= COARSEST_MM_S:
        hint = f"a number of mm/s from 0 to {COARSEST_MM_S:g}; a Create 2 is reported to have 28.5"
        raise ConfigError(f"speed_step '{text}' will not do", where=url, hint=hint)
    return step


def describe(generation: Generation) -> Description:
    """Return what is known of a generation before connecting."""
    top_m_s, base_m = TOP_MM_S / 1000.0, generation.wheel_base_m
    return Description(
        make="iRobot",
        model=generation.label,
        radius_m=generation.radius_m,
        limits=Limits(top_m_s, 2.0 * top_m_s / base_m, ACCEL_M_S2, 2.0 * ACCEL_M_S2 / base_m),
        senses_bumps=True,
        watchdog_s=None,
        actuators=actuators(generation),
    )


def claims(url: str, elsewhere: bool) -> tuple[Claim, ...]:
    """Return what only one robot of a computer can have: its serial port."""
    return (device_claim(urlsplit(url).path, elsewhere=elsewhere),)
