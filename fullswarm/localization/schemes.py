"""Makes the source of a URL: which schemes there are, and what each assumes where nothing is said."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from urllib.parse import urlsplit

from fullswarm.clock import Clock
from fullswarm.errors import ConfigError, did_you_mean, without_login
from fullswarm.localization.sighting import Convention, unit_of
from fullswarm.localization.source import Settings, Source

Y_UP, Z_UP = "y-up", "z-up"
AXES = (Z_UP, Y_UP)


@dataclass(frozen=True, slots=True)
class Scheme:
    """One kind of source.

    Parameters
    ----------
    make : from settings and a clock; imports what it needs
    axes : of the system where it is not set otherwise; empty: systems differ, so they must be stated
    """

    make: Callable[[Settings, Clock], Source]
    example: str
    axes: str = Z_UP
    unit: str = "m"
    sigma_m: float = 0.005
    sigma_rad: float = 0.02


def _natnet(settings: Settings, clock: Clock) -> Source:
    from fullswarm.localization import natnet

    return natnet.open_source(settings.url, clock)


def _vrpn(settings: Settings, clock: Clock) -> Source:
    from fullswarm.localization import vrpn

    return vrpn.open_source(settings.url, clock)


def _qualisys(settings: Settings, clock: Clock) -> Source:
    from fullswarm.localization.qualisys import QualisysSource

    return QualisysSource(settings.url, clock)


def _libmotioncapture(settings: Settings, clock: Clock) -> Source:
    from fullswarm.localization import libmotioncapture

    return libmotioncapture.open_source(settings.url, clock)


def _json(settings: Settings, clock: Clock) -> Source:
    from fullswarm.localization.json_udp import Format, JsonSource

    return JsonSource(settings, Format(convention_of(settings)), clock)


def _gnss(settings: Settings, clock: Clock) -> Source:
    from fullswarm.localization.gnss import GnssSource

    return GnssSource(settings, clock)


def _uwb(settings: Settings, clock: Clock) -> Source:
    from fullswarm.localization.uwb import UwbSource

    return UwbSource(settings, clock)


SCHEMES = {
    "json": Scheme(_json, "json://127.0.0.1:9870"),
    "natnet": Scheme(_natnet, "natnet://192.168.1.5", axes=""),
    "vicon": Scheme(_libmotioncapture, "vicon://192.168.1.5"),
    "qualisys": Scheme(_qualisys, "qualisys://192.168.1.5", unit="mm"),
    "vrpn": Scheme(_vrpn, "vrpn://192.168.1.5", axes=""),
    "libmotioncapture": Scheme(_libmotioncapture, "libmotioncapture://192.168.1.5?type=vicon"),
    "gnss": Scheme(_gnss, "gnss:///dev/ttyACM0"),
    "uwb": Scheme(_uwb, "uwb:///dev/ttyACM0"),
}
"""Schemes by name; ``gnss+tcp`` and the like have the scheme of what stands before the plus."""
HOSTLESS = ("json", "gnss", "uwb")


def scheme_of(url: str) -> Scheme:
    """Return the scheme of a URL.

    Raises
    ------
    ConfigError
        It has none, or one that is not known, or no host.
    """
    try:
        parts = urlsplit(url)
        _ = parts.port
    except ValueError as error:
        raise ConfigError(f"not a URL: {error}", where=f"source {without_login(url)}") from None
    name = parts.scheme.partition("+")[0]
    if name not in SCHEMES:
        raise ConfigError(
            f"'{parts.scheme or without_login(url)}' is no source", where="source", hint=did_you_mean(name, SCHEMES)
        )
    scheme = SCHEMES[name]
    if name not in HOSTLESS and not parts.hostname:
        raise ConfigError("names no host", where=f"source {without_login(url)}", hint=f"like {scheme.example}")
    return scheme


def convention_of(settings: Settings) -> Convention:
    """Return the conventions of a source: what is set, else those of its scheme.

    Raises
    ------
    ConfigError
        Axes or unit are none; or systems of this kind differ in their axes and none are set.
    """
    scheme = scheme_of(settings.url)
    axes = settings.axes or scheme.axes
    if not axes:
        raise ConfigError(
            "state which axis of the capture system points up: a wrong one would put the robots elsewhere",
            where=f"source {without_login(settings.url)}",
            hint='axes = "y-up" or "z-up" in the fleet file, or --axes; Motive has y-up unless it was changed',
        )
    if axes not in AXES:
        raise ConfigError(f"'{axes}' are no axes", where="axes", hint=did_you_mean(axes, AXES))
    sigma_m = scheme.sigma_m if settings.sigma_m is None else settings.sigma_m
    sigma_rad = scheme.sigma_rad if settings.sigma_rad is None else settings.sigma_rad
    return Convention(unit_of(settings.unit or scheme.unit), axes == Y_UP, sigma_m, sigma_rad)


def open_source(settings: Settings, clock: Clock) -> Source:
    """Return the source of a URL, not started; raises `ConfigError` and `MissingExtra`."""
    return scheme_of(settings.url).make(settings, clock)
