"""A lidar's URL, checked, and what is known of the lidar before connecting.

``ld19:///dev/ttyUSB0``, ``ld06://``, ``rplidar://`` or, behind a serial server, ``ld19+tcp://HOST:PORT``. Options:
``x_m``, ``y_m``, ``heading_rad`` (where it is on the robot, and the direction of its zero, counter-clockwise from
forward), ``upside_down=1``, ``max_m`` (what is farther away does not count), ``baud``, ``valid`` (the least share of
rays that must measure something: a covered lidar sees nothing; 0 for open fields).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from urllib.parse import parse_qsl, unquote, urlsplit

from fullswarm.drivers.base import Description, Limits, Pose
from fullswarm.drivers.make import Claim, device_claim
from fullswarm.drivers.ports import parse_address
from fullswarm.errors import ConfigError, did_you_mean

NO_MOTION = Limits(0.0, 0.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Model:
    """What a manufacturer states."""

    make: str
    label: str
    baud: int
    near_m: float
    max_m: float = 12.0
    sigma_m: float = 0.02


MODELS = {
    "ld06": Model("LDROBOT", "LD06", 230400, 0.02),
    "ld19": Model("LDROBOT", "LD19", 230400, 0.02),
    "rplidar": Model("Slamtec", "RPLIDAR", 115200, 0.1),
}
OPTIONS = {
    "x_m": (-10.0, 10.0), "y_m": (-10.0, 10.0), "heading_rad": (-6.3, 6.3), "upside_down": (0.0, 1.0),
    "max_m": (0.1, 100.0), "baud": (9600.0, 4e6), "valid": (0.0, 1.0),
}  # fmt: skip
"""Each with its least and greatest value."""
VALID = 0.02


@dataclass(frozen=True, slots=True)
class Settings:
    """The options of a URL; `path` is empty with an address."""

    scheme: str
    path: str
    address: tuple[str, int]
    baud: int
    mount: Pose
    max_m: float
    upside_down: bool
    least_valid: float

    @property
    def model(self) -> Model:
        """What its manufacturer states."""
        return MODELS[self.scheme]

    @property
    def description(self) -> Description:
        """What is known before connecting."""
        return Description(self.model.make, self.model.label, 0.0, NO_MOTION, ranges_max_m=self.max_m)


def parse_url(url: str) -> Settings:
    """Read a lidar's URL.

    Raises
    ------
    ConfigError
        Another scheme, no port, an unknown option or a value that does not fit.
    """
    parts = urlsplit(url)
    scheme, _, transport = parts.scheme.partition("+")
    if scheme not in MODELS or transport not in ("", "tcp"):
        raise ConfigError(f"no lidar '{parts.scheme}'", where=url, hint=did_you_mean(scheme, MODELS))
    path, address = unquote(parts.path), ("", 0)
    if transport:
        address, path = parse_address(parts.netloc, where=url), ""
    elif parts.netloc or len(path) < 2:
        raise ConfigError("this names no serial port", where=url, hint=f"write {scheme}:///dev/ttyUSB0")
    values: dict[str, float] = {}
    for name, text in parse_qsl(parts.query, keep_blank_values=True):
        values[name] = _number(url, name, text)
    return Settings(
        scheme, path, address, int(values.get("baud", MODELS[scheme].baud)),
        Pose(values.get("x_m", 0.0), values.get("y_m", 0.0), values.get("heading_rad", 0.0)),
        values.get("max_m", MODELS[scheme].max_m), values.get("upside_down", 0.0) > 0.0, values.get("valid", VALID),
    )  # fmt: skip


def _number(url: str, name: str, text: str) -> float:
    if name not in OPTIONS:
        raise ConfigError(f"unknown option '{name}'", where=url, hint=did_you_mean(name, OPTIONS))
    least, most = OPTIONS[name]
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not least <= value <= most:
        raise ConfigError(f"{name} '{text}' will not do", where=url, hint=f"a number from {least:g} to {most:g}")
    return value


def claims(url: str, elsewhere: bool) -> tuple[Claim, ...]:
    """Return what only one lidar of a computer can have: its serial port, or its address."""
    parts = urlsplit(url)
    return (device_claim(parts.path, elsewhere=elsewhere),) if not parts.netloc else (Claim(("the URL", url)),)
