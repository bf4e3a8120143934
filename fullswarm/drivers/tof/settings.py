"""What the URL of time-of-flight sensors says.

URLs::

    vl53l1x:///dev/i2c-1?sensor=0@0.1,0.05,0.785&sensor=1@0.12,0,0    channels 0 and 1 of a multiplexer
    vl53l1x:///dev/i2c-1?sensor=0x29@0.12,0,0                         one sensor, on the bus itself
    vl53l1x:///tmp/tof?sensor=...                                     a serial device that carries I2C transfers
    vl53l1x://127.0.0.1:7531?sensor=...                               the same over TCP: an emulator

Options:

``sensor=WHICH@x,y,heading``
    Once for each sensor. `WHICH` is its channel of the TCA9548A multiplexer, 0 to 7, or its address on the bus itself,
    0x08 to 0x77; then where on the robot it is, in m (x forward, y left), and where it points, in rad. An address
    other than 0x29 has to be set by something else each time the sensors get power.
``mux=0x70``
    Address of the multiplexer, 0x70 to 0x77.
``mode=short``
    ``short`` measures up to 1.3 m, almost whatever the light; ``long`` up to 4 m in the dark, much less in the sun.
``roi=16``
    Side of the square of the sensor's 16 by 16 receivers that is used: 16, 8 or 4. Its field of view is 27, 20 or 15
    degrees then; the fewer, the less far it measures.
``max=1.3``
    How far it is believed, in m.
``name=ranges``
    Tells them from other sensors of the robot.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TypeVar
from urllib.parse import parse_qsl, urlsplit

from fullswarm.drivers.base import Pose
from fullswarm.drivers.ports import parse_address, parse_mount
from fullswarm.drivers.tof.protocol import FIELD_OF_VIEW_RAD, LONG, SHORT, Mode
from fullswarm.errors import ConfigError, did_you_mean

T = TypeVar("T")
SCHEME, LABEL = "vl53l1x", "ST VL53L1X"
OPTIONS = ("max", "mode", "mux", "name", "roi", "sensor")
EXAMPLE = "vl53l1x:///dev/i2c-1?sensor=0@0.1,0,0"
OWN_ADDRESS = 0x29
"""Of every sensor when it gets power."""
CHANNELS, ADDRESSES, MUX_ADDRESSES = range(8), range(0x08, 0x78), range(0x70, 0x78)
MODES: Mapping[str, Mode] = MappingProxyType({"short": SHORT, "long": LONG})


@dataclass(frozen=True, slots=True)
class Placed:
    """One sensor: which it is on the bus (`channel` None: on the bus itself), and where on the robot."""

    channel: int | None
    address: int
    at: Pose

    @property
    def key(self) -> str:
        """How the URL names it."""
        return f"{self.address:#04x}" if self.channel is None else str(self.channel)


@dataclass(frozen=True, slots=True)
class Settings:
    """A URL, understood. `path`: an I2C bus or a serial device; else `host` and `port`."""

    path: str
    host: str
    port: int
    sensors: tuple[Placed, ...]
    mux: int
    mode: Mode
    roi: int
    max_m: float
    name: str

    @property
    def where(self) -> str:
        """Its bus, for people."""
        return self.path or f"tcp {self.host}:{self.port}"

    @property
    def cone_rad(self) -> float:
        """The field of view of each sensor."""
        return FIELD_OF_VIEW_RAD[self.roi]

    def name_of(self, sensor: Placed) -> str:
        """Return the name of a sensor's scans."""
        return f"{self.name}/{sensor.key}"


def parse_url(url: str) -> Settings:
    """Read the URL of a robot's time-of-flight sensors.

    Raises
    ------
    ConfigError
        It has another form, an unknown option, or a value that does not fit.
    """
    parts = urlsplit(url)
    if parts.scheme != SCHEME:
        raise ConfigError(f"no time-of-flight sensor '{parts.scheme or url}'", where=url, hint=f"write {EXAMPLE}")
    if not parts.netloc and len(parts.path) < 2:
        raise ConfigError("this names no bus", where=url, hint=f"write {EXAMPLE}")
    if parts.netloc and parts.path not in ("", "/"):
        raise ConfigError("this names an address and a device", where=url, hint=f"write {EXAMPLE}, with three slashes")
    host, port = parse_address(parts.netloc, where=url) if parts.netloc else ("", 0)
    options, texts = _options(url, parts.query)
    mode = _one_of(url, "mode", options.get("mode", "short"), MODES)
    roi = _one_of(url, "roi", options.get("roi", "16"), {str(each): each for each in FIELD_OF_VIEW_RAD})
    mux = _integer(options.get("mux", "0x70"))
    if mux not in MUX_ADDRESSES:
        hint = "its three address pins give 0x70 to 0x77"
        raise ConfigError(f"mux '{options['mux']}' is not the address of a TCA9548A", where=url, hint=hint)
    return Settings(
        "" if parts.netloc else parts.path, host, port,
        sensors=_distinct(url, tuple(_placed(url, text) for text in texts), mux),
        mux=mux, mode=mode, roi=roi, max_m=_max(url, options, mode), name=options.get("name", "ranges"),
    )  # fmt: skip


def _options(url: str, query: str) -> tuple[dict[str, str], list[str]]:
    """Return the options that a URL has once, and those of its sensors."""
    options: dict[str, str] = {}
    sensors = []
    for name, text in parse_qsl(query, keep_blank_values=True):
        if name not in OPTIONS:
            raise ConfigError(f"unknown option '{name}'", where=url, hint=did_you_mean(name, OPTIONS))
        if name == "sensor":
            sensors.append(text)
        elif name in options:
            raise ConfigError(f"the option '{name}' is there twice", where=url, hint="it holds for all sensors")
        else:
            options[name] = text
    if not sensors:
        raise ConfigError("this names no sensor", where=url, hint=f"write {EXAMPLE}")
    return options, sensors


def _placed(url: str, text: str) -> Placed:
    which, _, place = text.partition("@")
    number = _integer(which)
    if number not in CHANNELS and number not in ADDRESSES:
        hint = "write sensor=0@0.1,0,0 with a channel of the multiplexer from 0 to 7, or an address from 0x08 to 0x77"
        raise ConfigError(f"sensor '{text}' names neither a channel nor an address", where=url, hint=hint)
    at = parse_mount(place, f"sensor={which}@", url)
    return Placed(number, OWN_ADDRESS, at) if number in CHANNELS else Placed(None, number, at)


def _distinct(url: str, sensors: tuple[Placed, ...], mux: int) -> tuple[Placed, ...]:
    """Return the sensors; raise where two of them, or one and the multiplexer, would answer at the same time."""
    keys = [each.key for each in sensors]
    for key in keys:
        if keys.count(key) > 1:
            hint = "each needs a channel or an address of its own"
            raise ConfigError(f"sensor {key} is there twice", where=url, hint=hint)
    addresses = {each.address for each in sensors if each.channel is None}
    if len(addresses) < len(sensors):
        if OWN_ADDRESS in addresses:
            hint = "put the one at 0x29 on a channel too"
            raise ConfigError("a sensor at 0x29 on the bus itself answers for each channel", where=url, hint=hint)
        if mux in addresses:
            raise ConfigError(f"the multiplexer and a sensor are at {mux:#x}", where=url, hint="change one of them")
    return sensors


def _integer(text: str) -> int:
    try:
        return int(text, 0)
    except ValueError:
        return -1


def _one_of(url: str, name: str, text: str, known: Mapping[str, T]) -> T:
    if text not in known:
        raise ConfigError(f"{name} '{text}' is none of {', '.join(known)}", where=url)
    return known[text]


def _max(url: str, options: dict[str, str], mode: Mode) -> float:
    if "max" not in options:
        return mode.max_m
    try:
        value = float(options["max"])
    except ValueError:
        value = math.nan
    if not 0.1 <= value <= mode.max_m:
        what = f"max '{options['max']}' is not a number from 0.1 to {mode.max_m:g}"
        raise ConfigError(what, where=url, hint="mode=long measures farther" if mode is SHORT else "")
    return value
