"""Distances to radio anchors as a source: Qorvo (Decawave) DWM1001 tags over their shell, and JSON lines or datagrams.

The DWM1001's shell prints with ``lec``: ``DIST,2,AN0,1151,3.40,2.40,1.65,2.31,AN1,...`` and with ``les``:
``1151[3.40,2.40,1.65]=2.31 ...`` (DWM1001 Firmware User Guide). Only the distances are used; the anchors' places come
from ``[anchors]`` in the fleet file. In JSON::

    {"robot": "r1", "anchor": "1151", "distance": 2.31, "sigma_m": 0.1, "time_s": 812.03}
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import msgspec

from fullswarm.clock import Clock
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.localization.links import SerialStream, byte_link
from fullswarm.localization.sighting import Ranging, Refused
from fullswarm.localization.source import Receiver, Seen, Settings

LONGEST = 8192
FARTHEST_M = 1000.0
FIELDS = ("robot", "anchor", "distance", "sigma_m", "time_s")
LES = re.compile(r"([0-9A-Fa-f]{2,16})\[[^\]]*\]=(\d+(?:\.\d+)?)")
QUIET_S = 3.0
SHELL_S = 1.5


class Lines:
    """Turns the bytes of tags into distances.

    Parameters
    ----------
    robot : whose tag it is, for lines without a robot
    """

    def __init__(self, robot: str) -> None:
        self._robot, self._buffer = robot, b""

    def read(self, data: bytes) -> list[Seen]:
        """Return what the lines that are complete now say; a datagram ends its last line."""
        self._buffer += data
        if self._buffer.startswith(b"{") and self._buffer.endswith(b"}"):
            self._buffer += b"\n"
        *lines, self._buffer = self._buffer.replace(b"\r", b"\n").split(b"\n")
        if len(self._buffer) > LONGEST:
            self._buffer = b""
            return [Refused("a line without an end")]
        found: list[Seen] = []
        for line in lines:
            try:
                found += self._line(line.strip())
            except Refused as refused:
                found.append(refused)
        return found

    def _line(self, line: bytes) -> list[Seen]:
        if not line or line.startswith((b"dwm>", b"DWM1001")):
            return []
        if line.startswith((b"{", b"[")):
            return self._json(line)
        text = line.decode("ascii", "replace")
        if text.startswith("DIST,"):
            return [self._range(anchor, distance) for anchor, distance in _lec(text)]
        return [self._range(anchor, distance) for anchor, distance in LES.findall(text)]

    def _range(self, anchor: str, distance: str) -> Seen:
        if not self._robot:
            raise Refused("a tag that is no robot's", "say whose it is: --robot r1")
        return Ranging(self._robot, anchor.upper(), _distance(float(distance)))

    def _json(self, line: bytes) -> list[Seen]:
        try:
            found = msgspec.json.decode(line)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            raise Refused("not JSON", str(error)) from None
        return [self._object(each) for each in (found if isinstance(found, list) else [found])]

    def _object(self, found: Any) -> Seen:
        try:
            return self._ranging(found)
        except Refused as refused:
            return refused

    def _ranging(self, found: Any) -> Ranging:
        if not isinstance(found, dict):
            raise Refused("not an object with fields", f"{found!r:.60}")
        for key in found:
            if key not in FIELDS:
                raise Refused(f"unknown field '{key:.30}'", did_you_mean(key, FIELDS))
        robot, anchor = found.get("robot", self._robot), found.get("anchor")
        if not (isinstance(robot, str) and robot and isinstance(anchor, str) and anchor):
            raise Refused("needs 'robot' and 'anchor'", f"it has {', '.join(found)}")
        time_s = found.get("time_s")
        sigma_m = 0.0 if found.get("sigma_m") is None else _number(found, "sigma_m")
        if not 0.0 <= sigma_m <= 100.0:
            raise Refused("'sigma_m' is no standard deviation", f"{sigma_m:g}")
        return Ranging(
            robot, anchor, _distance(_number(found, "distance")), sigma_m,
            None if time_s is None else _number(found, "time_s"),
        )  # fmt: skip


def _lec(text: str) -> Iterable[tuple[str, str]]:
    """Return (anchor, distance) of a line ``DIST,count,AN0,id,x,y,z,distance,...``."""
    parts = text.split(",")
    if len(parts) < 2 or not parts[1].isdecimal() or int(parts[1]) > 16:
        raise Refused("a line DIST without a count", text[:60])
    for number in range(int(parts[1])):
        at = 2 + 6 * number
        if len(parts) < at + 6 or not parts[at].startswith("AN") or not re.fullmatch(r"\d+(\.\d+)?", parts[at + 5]):
            raise Refused("a line DIST that ends too early", text[:60])
        yield parts[at + 1], parts[at + 5]


def _number(found: dict[str, Any], key: str) -> float:
    value = found.get(key)
    if not isinstance(value, int | float) or isinstance(value, bool) or not abs(value) < 1.0e300:
        raise Refused(f"'{key}' is not a finite number", f"{value!r:.40}")
    return float(value)


def _distance(distance_m: float) -> float:
    if not 0.0 < distance_m <= FARTHEST_M:
        raise Refused("a distance that is none", f"{distance_m:g} m")
    return distance_m


class TagShell(SerialStream):
    """The shell of a DWM1001; asks it to print distances when it is silent. ``lec`` again would switch them off."""

    def __init__(self, path: str, baud: int) -> None:
        super().__init__(path, baud)
        self._heard_s = self._asked_s = -1.0e9

    def read(self, ready: Any, now_s: float) -> Iterable[tuple[str, bytes]]:
        """Return what has arrived."""
        found = list(super().read(ready, now_s))
        if any(b"DIST" in data or b"]=" in data or b"{" in data for _, data in found):
            self._heard_s = now_s
        return found

    def turn(self, now_s: float) -> None:
        """Open the shell, which takes a second, and switch the distances on."""
        if self._heard_s < 0.0 and self._asked_s < 0.0:
            self._heard_s = now_s  # it may print already
        if now_s - self._heard_s < QUIET_S:
            return
        if self._asked_s < 0.0 or now_s - self._asked_s > 3.0 * QUIET_S:
            self.write(b"\r\r")
            self._asked_s = now_s
        elif now_s - self._asked_s > SHELL_S and self._heard_s < self._asked_s:
            self.write(b"lec\r")
            self._heard_s = self._asked_s = now_s


class UwbSource:
    """``uwb:///dev/ttyACM0[?baud=115200]``, ``uwb+tcp://HOST:PORT``, ``uwb+udp://HOST:PORT``.

    Raises
    ------
    ConfigError
        No anchors, or an address that is none.
    """

    sensor = "uwb"
    hint = "is the tag on, and does it see its anchors?"

    def __init__(self, settings: Settings, clock: Clock) -> None:
        where = f"source {settings.url}"
        if not settings.anchors.places_m:
            hint = "[anchors] with AN0 = [x, y, z] in the fleet file, and --fleet"
            raise ConfigError("no places of anchors are known", where=where, hint=hint)
        options = dict(parse_qsl(urlsplit(settings.url).query))
        baud = options.pop("baud", "115200")
        if options:
            raise ConfigError(f"unknown option '{next(iter(options))}'", where=where, hint="uwb knows baud")
        self._lines = Lines(settings.robot)
        self._link, self.address = byte_link(
            settings.url, baud, clock, insecure_network=settings.insecure_network, serial=TagShell
        )

    def start(self, receiver: Receiver) -> None:
        """Deliver to `receiver` from now on."""
        self._link.start(receiver)

    def read(self, content: bytes) -> Iterable[Seen]:
        """Read on."""
        return self._lines.read(content)

    def close(self) -> None:
        """Stop delivering."""
        self._link.close()
