"""JSON datagrams over UDP as a source: the format for systems without one of their own, and its port.

A datagram is one object or a list of them::

    {"robot": "r1", "x": 1.25, "y": -0.4, "heading": 1.57}
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

import msgspec

from fullswarm.clock import Clock
from fullswarm.errors import did_you_mean
from fullswarm.geometry import wrap
from fullswarm.localization.links import DatagramPort, PortLink
from fullswarm.localization.sighting import UNSEEN_RAD, Convention, Refused, Sighting
from fullswarm.localization.source import Receiver, Seen, Settings

FIELDS = (
    "robot", "name", "x", "y", "z", "heading", "heading_deg", "quaternion", "sigma_m", "sigma_rad", "time_s",
    "contacts", "tracked", "frame",
)  # fmt: skip
HEADINGS = ("heading", "heading_deg", "quaternion")


@dataclass(frozen=True, slots=True)
class Format:
    """Reads the datagrams of a sender with these conventions."""

    convention: Convention = field(default_factory=Convention)

    def read(self, data: bytes) -> list[Sighting | Refused]:
        """Return a sighting, or why it is none, for each object of a datagram."""
        try:
            found = msgspec.json.decode(data)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            return [Refused("not JSON", f"{error}; it begins {data[:40]!r}")]
        return [self._one(each) for each in (found if isinstance(found, list) else [found])]

    def _one(self, found: Any) -> Sighting | Refused:
        try:
            return self._sighting(found)
        except Refused as refused:
            return refused

    def _sighting(self, found: Any) -> Sighting:
        if not isinstance(found, dict):
            raise Refused("not an object with fields", f"{found!r:.60}")
        for key in found:
            if key not in FIELDS:
                raise Refused(f"unknown field '{key:.30}'", did_you_mean(key, FIELDS))
        tracked = found.get("tracked", True)
        if not isinstance(tracked, bool):
            raise Refused("'tracked' is not true or false", repr(tracked))
        name = _name(found)
        if not tracked:
            return Sighting(name, 0.0, 0.0, 0.0, 0.0, 0.0, tracked=False)
        usual = self.convention
        heading = self._heading(found)
        sigma_rad = UNSEEN_RAD if heading is None else _positive(found, "sigma_rad", usual.sigma_rad)
        across = -_number(found, "z") if usual.y_up else _number(found, "y")
        x_m, y_m = usual.floor(_number(found, "x"), across)
        return Sighting(
            name, x_m, y_m, wrap(heading or 0.0), _positive(found, "sigma_m", usual.sigma_m), sigma_rad,
            _number(found, "time_s") if found.get("time_s") is not None else None, _contacts(found),
        )  # fmt: skip

    def _heading(self, found: dict[str, Any]) -> float | None:
        given = [key for key in HEADINGS if found.get(key) is not None]
        if len(given) > 1:
            raise Refused("more than one heading", ", ".join(given))
        if not given:
            return None
        if given[0] == "quaternion":
            return self._yaw(found["quaternion"])
        value = _number(found, given[0])
        return math.radians(value) if given[0] == "heading_deg" else value

    def _yaw(self, parts: Any) -> float:
        """Return where the body's x axis points on the floor, from x, y, z, w."""
        if not (isinstance(parts, list) and len(parts) == 4 and all(_finite(each) for each in parts)):
            raise Refused("a quaternion is [x, y, z, w]", f"not {parts!r:.60}")
        return self.convention.yaw(*(float(each) for each in parts))


def _name(found: dict[str, Any]) -> str:
    given = [found[key] for key in ("robot", "name") if key in found]
    if len(given) != 1:
        raise Refused("needs either 'robot' or 'name'", f"it has {', '.join(found) or 'nothing'}")
    if not isinstance(given[0], str) or not given[0]:
        raise Refused("the robot's name is not a text", repr(given[0]))
    return given[0]


def _finite(value: Any) -> bool:
    # Whole numbers beyond a float's range are JSON too.
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1.0e300


def _number(found: dict[str, Any], key: str) -> float:
    if key not in found:
        raise Refused(f"'{key}' is missing", f"it has {', '.join(found)}")
    if not _finite(found[key]):
        raise Refused(f"'{key}' is not a finite number", f"{found[key]!r:.40}")
    return float(found[key])


def _positive(found: dict[str, Any], key: str, otherwise: float) -> float:
    value = otherwise if found.get(key) is None else _number(found, key)
    if value <= 0.0:
        raise Refused(f"'{key}' is not above zero", f"{value:g}")
    return value


def _contacts(found: dict[str, Any]) -> int:
    value = found.get("contacts", 0)
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= 1000:
        raise Refused("'contacts' is not a small whole number", f"{value!r:.40}")
    return value


class JsonSource:
    """``json://HOST:PORT``: listens there.

    Raises
    ------
    ConfigError
        The address is no address, taken, not ours, or not loopback.
    """

    sensor = "mocap"
    hint = "is your program sending to this port?"

    def __init__(self, settings: Settings, format_: Format, clock: Clock) -> None:
        self._format = format_
        listen = urlsplit(settings.url).netloc
        port = DatagramPort(listen, settings.insecure_network, f"source {settings.url}")
        self.address = f"udp {port.address}"
        self._link = PortLink(port, clock)

    def start(self, receiver: Receiver) -> None:
        """Deliver to `receiver` from now on."""
        self._link.start(receiver)

    def read(self, content: bytes) -> Iterable[Seen]:
        """Read one datagram."""
        return self._format.read(content)

    def close(self) -> None:
        """Stop delivering."""
        self._link.close()
