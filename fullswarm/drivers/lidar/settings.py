"""What the URL of a lidar says.

URLs::

    ld19:///dev/ttyUSB0                          LDROBOT LD19, also ld06
    rplidar:///dev/ttyUSB0?baud=256000           RPLIDAR A3 and S1; A1 and A2 have 115200
    ld19://192.168.1.9:4001                      behind a serial server (ser2net)

Options:

``at=x,y,heading``
    Where on the robot it is, in m (x forward, y left), and where its own x axis points, in rad.
``flipped=1``
    It hangs upside down: it turns the other way round.
``max=12``
    How far it is believed, in m.
``least=0.05``
    Share of the rays that must measure something. Below it the lidar counts as covered, and the robot stands.
``name=ranges``
    Tells it from other sensors of the robot.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from types import MappingProxyType
from urllib.parse import parse_qsl, urlsplit

from fullswarm.drivers.base import Pose
from fullswarm.drivers.lidar.protocol import Codec, LdCodec, RplidarCodec
from fullswarm.drivers.ports import parse_address, parse_mount
from fullswarm.errors import ConfigError, did_you_mean

OPTIONS = ("at", "baud", "flipped", "least", "max", "name")
EXAMPLE = "ld19:///dev/ttyUSB0?at=0.1,0,0"
MIDDLE = Pose(0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of lidar: its codec, how far it sees, and the standard deviation of a distance, by its data sheet."""

    label: str
    codec: Callable[[int], Codec]
    max_m: float
    sigma_m: float


KINDS = MappingProxyType(
    {
        "ld06": Kind("LDROBOT LD06", lambda _: LdCodec(), 12.0, 0.01),
        "ld19": Kind("LDROBOT LD19", lambda _: LdCodec(), 12.0, 0.01),
        "rplidar": Kind("Slamtec RPLIDAR", lambda baud: RplidarCodec(baud or 115_200), 12.0, 0.02),
    }
)
"""By scheme."""


@dataclass(frozen=True, slots=True)
class Settings:
    """A URL, understood. `path`: a serial device; else `host` and `port`."""

    kind: Kind
    path: str
    host: str
    port: int
    baud: int
    at: Pose
    flipped: bool
    max_m: float
    least: float
    name: str

    @property
    def where(self) -> str:
        """Its port, for people."""
        return self.path or f"tcp {self.host}:{self.port}"


def parse_url(url: str) -> Settings:
    """Read a lidar's URL.

    Raises
    ------
    ConfigError
        It has another form, an unknown option, or a value that does not fit.
    """
    parts = urlsplit(url)
    if parts.scheme not in KINDS:
        raise ConfigError(f"no lidar '{parts.scheme or url}'", where=url, hint=did_you_mean(parts.scheme, KINDS))
    kind = KINDS[parts.scheme]
    options = dict(parse_qsl(parts.query, keep_blank_values=True))
    for name in options:
        if name not in OPTIONS:
            raise ConfigError(f"unknown option '{name}'", where=url, hint=did_you_mean(name, OPTIONS))
    if not parts.netloc and len(parts.path) < 2:
        raise ConfigError("this names no port", where=url, hint=f"write {EXAMPLE}")
    if parts.netloc and parts.path not in ("", "/"):
        raise ConfigError("this names an address and a device", where=url, hint=f"write {EXAMPLE}, with three slashes")
    host, port = parse_address(parts.netloc, where=url) if parts.netloc else ("", 0)
    return Settings(
        kind, "" if parts.netloc else parts.path, host, port,
        baud=int(_number(url, options, "baud", 0.0, 0.0, 4e6)),
        at=parse_mount(options["at"], "at", url) if "at" in options else MIDDLE,
        flipped=_number(url, options, "flipped", 0.0, 0.0, 1.0) == 1.0,
        max_m=_number(url, options, "max", kind.max_m, 0.1, 100.0),
        least=_number(url, options, "least", 0.05, 0.0, 1.0), name=options.get("name", "ranges"),
    )  # fmt: skip


def _number(url: str, options: dict[str, str], name: str, usual: float, low: float, high: float) -> float:
    if name not in options:
        return usual
    try:
        value = float(options[name])
    except ValueError:
        value = math.nan
    if not low <= value <= high:
        raise ConfigError(f"{name} '{options[name]}' is not a number from {low:g} to {high:g}", where=url)
    return value
