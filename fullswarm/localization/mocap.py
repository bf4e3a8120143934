"""The datagrams of motion capture: JSON in, sightings in metres and ENU out. Pure; ``docs/how-to-motion-capture.md``.

A datagram is one object or a list of them::

    {"robot": "r1", "x": 1.25, "y": -0.4, "heading": 1.57}
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import msgspec

from fullswarm.errors import did_you_mean
from fullswarm.geometry import wrap

UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
FIELDS = (
    "robot", "name", "x", "y", "z", "heading", "heading_deg", "quaternion", "sigma_m", "sigma_rad", "time_s",
    "contacts", "tracked", "frame",
)  # fmt: skip
HEADINGS = ("heading", "heading_deg", "quaternion")
UNSEEN_RAD = math.pi
"""Standard deviation of a heading that was not given."""
FAR_M = 1.0e5


class Refused(Exception):
    """A datagram, or one object of it, is invalid. `kind` has no numbers in it: each kind is logged once."""

    def __init__(self, kind: str, what: str = "") -> None:
        super().__init__(f"{kind}: {what}" if what else kind)
        self.kind = kind


@dataclass(frozen=True, slots=True)
class Sighting:
    """The content of one object. World frame, ENU."""

    name: str
    x_m: float
    y_m: float
    heading_rad: float
    position_sigma_m: float
    heading_sigma_rad: float
    time_s: float | None  # the sender's clock
    contacts: int
    tracked: bool


@dataclass(frozen=True, slots=True)
class Format:
    """The conventions of a sender.

    Parameters
    ----------
    unit_m : length of the source's unit of x, y and z
    y_up : the source's floor is x and -z, as in Motive, and a heading turns about y; else x and y, about z
    sigma_m, sigma_rad : standard deviations where the source gives none
    """

    unit_m: float = 1.0
    y_up: bool = False
    sigma_m: float = 0.005
    sigma_rad: float = 0.02

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
            return Sighting(name, 0.0, 0.0, 0.0, 0.0, 0.0, None, 0, False)
        heading = self._heading(found)
        sigma_rad = UNSEEN_RAD if heading is None else _positive(found, "sigma_rad", self.sigma_rad)
        across = -_number(found, "z") if self.y_up else _number(found, "y")
        x_m, y_m = _number(found, "x") * self.unit_m, across * self.unit_m
        if max(abs(x_m), abs(y_m)) > FAR_M:
            raise Refused("no place on a floor", f"({x_m:g}, {y_m:g}) m; is --unit right?")
        return Sighting(
            name, x_m, y_m, wrap(heading or 0.0), _positive(found, "sigma_m", self.sigma_m), sigma_rad,
            _number(found, "time_s") if found.get("time_s") is not None else None, _contacts(found), True,
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
        x, y, z, w = (float(each) for each in parts)
        if abs(math.hypot(x, y, z, w) - 1.0) > 0.01:
            raise Refused("a quaternion has length 1", f"not {parts!r:.80}")
        ahead = 1.0 - 2.0 * (y * y + z * z)
        left = 2.0 * (w * y - x * z) if self.y_up else 2.0 * (w * z + x * y)
        if math.hypot(ahead, left) < 0.1:
            raise Refused("the body's x axis points up or down", "turn the rigid body so that x points ahead")
        return math.atan2(left, ahead)


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
