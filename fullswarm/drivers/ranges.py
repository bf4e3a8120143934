"""Range sensors on board, beside the driver of a robot of any make: which kinds there are, and the sensor of a URL."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Protocol
from urllib.parse import urlsplit

from fullswarm.drivers.base import RangeScan
from fullswarm.drivers.lidar import settings as lidar
from fullswarm.drivers.tof import settings as tof
from fullswarm.errors import ConfigError, did_you_mean

KINDS: Mapping[str, str] = MappingProxyType(
    {**{scheme: kind.label for scheme, kind in lidar.KINDS.items()}, tof.SCHEME: tof.LABEL}
)
"""What people call them, by scheme."""


class RangeSensor(Protocol):
    """A range sensor with a port and a thread of its own; it has no lifecycle and obeys nothing."""

    @property
    def scans(self) -> tuple[RangeScan, ...]:
        """The newest scans; the same tuple until one is newer."""
        ...

    @property
    def max_m(self) -> float:
        """How far it measures."""
        ...

    @property
    def trouble(self) -> str:
        """Why it measures nothing now, and what to do; empty: all is well."""
        ...

    def start(self) -> None:
        """Read from now on. Starting twice is fine."""
        ...

    def close(self) -> None:
        """Release its port. Closing twice is fine."""
        ...


def parse_url(url: str) -> lidar.Settings | tof.Settings:
    """Read the URL of a range sensor.

    Raises
    ------
    ConfigError
        There is no such sensor, or the URL has another form, an unknown option, or a value that does not fit.
    """
    scheme = urlsplit(url).scheme
    if scheme not in KINDS:
        raise ConfigError(f"no range sensor '{scheme or url}'", where=url, hint=did_you_mean(scheme, KINDS))
    return tof.parse_url(url) if scheme == tof.SCHEME else lidar.parse_url(url)


def extra_of(url: str) -> str:
    """Return the extra whose packages the sensor of a URL needs on board; empty: none."""
    return "tof" if urlsplit(url).scheme == tof.SCHEME else ""


def sensor_of(url: str) -> RangeSensor:
    """Return the sensor of a URL, not yet started. Raises as :func:`parse_url`."""
    settings = parse_url(url)
    if isinstance(settings, tof.Settings):
        from fullswarm.drivers.tof.sensor import TofSensors

        return TofSensors(settings)
    from fullswarm.drivers.lidar.sensor import LidarSensor

    return LidarSensor(settings)
