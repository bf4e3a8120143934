"""Vicon, and what else the package `motioncapture` (libmotioncapture) speaks, as a source.

Its `connect` never returns without a server and keeps Python's lock meanwhile, so it runs in a process of its own,
``libmotioncapture_worker.py``, which writes a JSON line per frame. libmotioncapture gives metres, z up as the system is
set, and no time of exposure.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from urllib.parse import parse_qsl, urlsplit

import msgspec

from fullswarm.clock import Clock
from fullswarm.errors import ConfigError, MissingExtra
from fullswarm.localization.links import PIECE, Connection, FrameSource, HasFileno
from fullswarm.localization.sighting import Body, Frame, Refused

HINT = "is the system live, does it stream, and does it see a body?"
TYPES = ("vicon", "optitrack", "qualisys", "vrpn")
WORKER = Path(__file__).with_name("libmotioncapture_worker.py")
LONGEST = 1 << 20
END_S = 2.0


class Worker(Connection):
    """The process that talks to the system."""

    def __init__(self, kind: str, host: str, options: Iterable[tuple[str, str]]) -> None:
        # As a file: it starts faster without this package.
        command = [sys.executable, "-P", str(WORKER), kind, host, *(f"{key}={value}" for key, value in options)]
        self._process = subprocess.Popen(  # noqa: S603  (our own interpreter and our own module)
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        self._sender, self._buffer = host, b""

    def waits_on(self) -> Sequence[HasFileno]:
        """Return the pipe."""
        return () if self._process.stdout is None else (self._process.stdout,)

    def read(self, ready: HasFileno, now_s: float) -> Iterable[tuple[str, Frame | Refused]]:
        """Read the lines that have arrived."""
        del now_s
        data = os.read(ready.fileno(), PIECE)
        if not data:
            raise ConnectionResetError("libmotioncapture has ended")
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        if len(self._buffer) > LONGEST:
            raise ConnectionResetError("libmotioncapture writes no lines")
        return [(self._sender, parse_line(line)) for line in lines]

    def close(self) -> None:
        """End the process."""
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
        self._process.kill()
        self._process.wait(END_S)


_LINE = msgspec.json.Decoder(list[tuple[str, float, float, float, float, float, float, float]])


def parse_line(line: bytes) -> Frame | Refused:
    """Read one line of the process."""
    try:
        found = _LINE.decode(line)
    except msgspec.MsgspecError as error:
        return Refused("a line of libmotioncapture that is none", str(error))
    return Frame(tuple(Body(name, x, y, z, (qx, qy, qz, qw)) for name, x, y, z, qx, qy, qz, qw in found))


def open_source(url: str, clock: Clock) -> FrameSource:
    """Return ``vicon://HOST[:801]``, or ``libmotioncapture://HOST?type=TYPE``; further options go to libmotioncapture.

    Raises
    ------
    ConfigError
        The type is none.
    MissingExtra
        `motioncapture` is not installed.
    """
    parts = urlsplit(url)
    options = dict(parse_qsl(parts.query))
    kind = options.pop("type", "vicon" if parts.scheme == "vicon" else "")
    if kind not in TYPES:
        hint = f"write {parts.scheme}://{parts.netloc}?type=TYPE with one of {', '.join(TYPES)}"
        raise ConfigError(f"'{kind}' is no type of libmotioncapture", where=url, hint=hint)
    if importlib.util.find_spec("motioncapture") is None:
        raise MissingExtra("`motioncapture` is not installed", hint="pip install 'fullswarm[mocap]'")
    return FrameSource(f"mocap {kind}", HINT, url, lambda: Worker(kind, parts.netloc, options.items()), clock)
