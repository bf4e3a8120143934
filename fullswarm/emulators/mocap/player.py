"""`fullswarm fixes play`: a recording on a real port, in the format of its vendor."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from fullswarm.clock import MonotonicClock
from fullswarm.emulators.mocap.natnet import NatNetServer
from fullswarm.emulators.mocap.qualisys import QualisysServer
from fullswarm.emulators.mocap.raw import JsonSender, RawServer
from fullswarm.emulators.mocap.server import Server, Shown
from fullswarm.emulators.mocap.vicon import ViconServer
from fullswarm.emulators.mocap.vrpn import VrpnServer
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.output import INTERRUPTED, progress
from fullswarm.runtime import Runtime

UNITS = {"natnet": 1.0, "vicon": 0.001, "qualisys": 0.001, "vrpn": 1.0, "json": 1.0}
"""Unit of length (m) of what each speaks."""
PORTS = {"natnet": 1510, "vicon": 801, "qualisys": 22_223, "vrpn": 3883, "json": 9870, "raw": 2947}
SERVERS: dict[str, Callable[[Sequence[str], str, int], Server]] = {
    "natnet": NatNetServer, "vicon": ViconServer, "qualisys": QualisysServer, "vrpn": VrpnServer,
    "json": JsonSender, "raw": RawServer,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Line:
    """One line of a recording: bodies, or bytes."""

    at_s: float
    bodies: tuple[Shown, ...] = ()
    data: bytes | None = None


@dataclass(frozen=True, slots=True)
class Recording:
    """A file of `fixes record`."""

    source: str
    unit_m: float
    lines: tuple[Line, ...]

    @property
    def names(self) -> list[str]:
        """All bodies, in the order of their first appearance."""
        return list(dict.fromkeys(body.name for line in self.lines for body in line.bodies))

    @property
    def raw(self) -> bool:
        """Whether it has bytes, not bodies."""
        return any(line.data is not None for line in self.lines)


def read_recording(path: Path) -> Recording:
    """Read a recording.

    Raises
    ------
    ConfigError
        It cannot be read, or is none; with the line.
    """
    try:
        texts = path.read_text("utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"cannot be read: {error}", where=str(path)) from error
    number = 1
    try:
        head = json.loads(texts[0])
        source, unit_m = str(head["source"]), float(head["unit_m"])
        if head["fullswarm_fixes"] != 1:
            raise ValueError("a recording of another version")
        lines = []
        for number, text in enumerate(texts[1:], 2):  # noqa: B007  (for the error)
            lines.append(_line(json.loads(text)))
    except (IndexError, KeyError, TypeError, ValueError, AttributeError) as error:
        where = f"{path}:{number}"
        raise ConfigError(f"not a recording of `fixes record`: {error!r}", where=where) from None
    if not lines:
        raise ConfigError("the recording is empty", where=str(path))
    return Recording(source, unit_m, tuple(lines))


def _line(found: Any) -> Line:
    at_s = float(found["t"])
    if "data" in found:
        return Line(at_s, data=base64.b64decode(found["data"]))
    return Line(at_s, tuple(_shown(each) for each in found["bodies"]))


def _shown(found: Any) -> Shown:
    name = str(found["name"])
    if not found.get("tracked", True):
        return Shown(name, (0.0, 0.0, 0.0), seen=False)
    x, y, z = (float(each) for each in found["position"])
    if found.get("quaternion") is None:
        return Shown(name, (x, y, z))
    qx, qy, qz, qw = (float(each) for each in found["quaternion"])
    return Shown(name, (x, y, z), (qx, qy, qz, qw))


def protocol_of(recording: Recording, wanted: str | None) -> str:
    """Return the protocol in which to play; raises `ConfigError`."""
    scheme = urlsplit(recording.source).scheme.partition("+")[0]
    usual = ("json" if scheme == "json" else "raw") if recording.raw else scheme
    protocol = wanted or (usual if usual in SERVERS else "json")
    if protocol not in SERVERS:
        raise ConfigError(f"'{protocol}' is no protocol", where="--as", hint=did_you_mean(protocol, SERVERS))
    if recording.raw != (protocol == "raw") and not (recording.raw and protocol == "json"):
        what = "bytes: it can be played as raw only" if recording.raw else "poses, not bytes"
        raise ConfigError(f"the recording has {what}", where="--as")
    return protocol


def run(path: Path, wanted: str | None, at: str | None, *, loop: bool, speed: float) -> int:
    """Play a recording until its end or Ctrl-C."""
    recording = read_recording(path)
    protocol = protocol_of(recording, wanted)
    host, _, port = (at or f"127.0.0.1:{PORTS[protocol]}").rpartition(":")
    if not host or not port.isdecimal() or int(port) > 65_535:
        raise ConfigError("expected HOST:PORT", where=f"--at {at}")
    try:
        server = SERVERS[protocol](recording.names, host, int(port))
    except OSError as error:
        hint = "ports below 1024 need root: give another one" if isinstance(error, PermissionError) else ""
        raise ConfigError(f"cannot listen there: {error.strerror}", where=f"{host}:{port}", hint=hint) from error
    server.start()
    progress(f"playing {path} as {protocol} at {host}:{server.port}; Ctrl-C ends")
    runtime = Runtime(MonotonicClock())
    runtime.stop_on_signals()
    play = Play(runtime, server, recording, 1.0 if recording.raw else recording.unit_m / UNITS[protocol], loop, speed)
    try:
        play.start()
        runtime.run()
    finally:
        server.close()
    return 0 if play.ended else INTERRUPTED


class Play:
    """Shows the lines of a recording at their times.

    Parameters
    ----------
    scale : unit of the recording in units of the protocol
    """

    def __init__(
        self, runtime: Runtime, server: Server, recording: Recording, scale: float, loop: bool, speed: float
    ) -> None:
        self._runtime, self._server, self._recording = runtime, server, recording
        self._scale, self._loop, self._speed = scale, loop, speed
        self._next = 0
        self.ended = False

    def start(self) -> None:
        """Begin with the first line."""
        self._began_s = self._runtime.now_s()
        self._show()

    def _show(self) -> None:
        lines = self._recording.lines
        while self._next < len(lines):
            line = lines[self._next]
            wait_s = self._began_s + line.at_s / self._speed - self._runtime.now_s()
            if wait_s > 0.0:
                self._runtime.after(wait_s, self._show)
                return
            self._next += 1
            if line.data is None:
                self._server.frame([_scaled(each, self._scale) for each in line.bodies])
            elif isinstance(self._server, RawServer | JsonSender):
                self._server.send_bytes(line.data)
        if self._loop:
            self._next = 0
            self._runtime.after(0.01, self.start)
            return
        self.ended = True
        self._runtime.pause()


def _scaled(shown: Shown, scale: float) -> Shown:
    x, y, z = shown.position
    return Shown(shown.name, (scale * x, scale * y, scale * z), shown.quaternion, shown.seen)
