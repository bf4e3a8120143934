"""Checks the arguments of a script's calls, and says which one is wrong."""

from __future__ import annotations

import numpy as np

from fullswarm.errors import ConfigError
from fullswarm.kernels import Array

LEAST_SAFETY_RADIUS_M = 0.12
"""Between the centres of two robots, which are 0.11 m wide."""
TOP_SPEED_M_S = 0.2


def columns(value: object, rows: int, name: str, count: int | None = None) -> Array:
    """Return `value` as an array of `rows` rows and a column per robot, `count` of them if it is given; a copy.

    Raises
    ------
    ConfigError
        It has another shape, or is no array of numbers.
    """
    try:
        found = np.array(value, float)
    except (TypeError, ValueError):
        raise ConfigError("is not an array of numbers", where=name, hint=f"{rows} rows, a column per robot") from None
    if found.ndim != 2 or found.shape[0] != rows or count not in (None, found.shape[1]):
        expected = f"({rows}, {'N' if count is None else count})"
        raise ConfigError(f"has shape {found.shape}, expected {expected}", where=name, hint="a column per robot")
    return found


def require(holds: bool, name: str, value: object, expected: str) -> None:
    """Check an argument.

    Raises
    ------
    ConfigError
        It does not hold; says what was expected.
    """
    if not holds:
        raise ConfigError(f"is {value!r}, expected {expected}", where=name)


def positive(**values: float) -> None:
    """Check that arguments are greater than zero, by name."""
    for name, value in values.items():
        require(value > 0.0, name, value, "more than 0")


def not_negative(**values: float) -> None:
    """Check that arguments are not less than zero, by name."""
    for name, value in values.items():
        require(value >= 0.0, name, value, "0 or more")


def safe_distance(safety_radius: float) -> None:
    """Check a distance that robots shall keep between their centres, or between the points in front of them, m."""
    require(
        safety_radius >= LEAST_SAFETY_RADIUS_M, "safety_radius", safety_radius,
        f"at least {LEAST_SAFETY_RADIUS_M} m, plus the distance of a point in front of the robots if there is one",
    )  # fmt: skip


def speed_limit(magnitude_limit: float) -> None:
    """Check a limit of speeds, m/s."""
    expected = f"more than 0, at most {TOP_SPEED_M_S}"
    require(0.0 < magnitude_limit <= TOP_SPEED_M_S, "magnitude_limit", magnitude_limit, expected)
