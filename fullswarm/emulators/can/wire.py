"""An emulated base's end of the wire: a port that can be pulled and a link that can be bad.

:class:`BusWire` joins a bus that python-can knows, :class:`~fullswarm.emulators.can.adapter.PtyWire` is an adapter.
"""

from __future__ import annotations

import struct
from typing import Protocol

from fullswarm.drivers.can.port import CanPort
from fullswarm.drivers.can.protocol import MAX_DATA, Frame
from fullswarm.drivers.can.settings import Settings
from fullswarm.emulators.faults import BadLink, LinkFaults

_EXTENDED, _REMOTE = 1 << 31, 1 << 30  # as in linux/can.h
SLICE_S = 0.005


class Wire(Protocol):
    """What emulated controllers talk through; one thread at a time."""

    def send(self, frame: Frame, now_s: float) -> None:
        """Put `frame` on its way; lost while unplugged."""
        ...

    def exchange(self, timeout_s: float, now_s: float) -> list[Frame]:
        """Let out what is due by `now_s`, wait for `timeout_s` at most, return what has arrived by `now_s`."""
        ...

    def unplug(self) -> None:
        """Pull the cable; twice is fine."""
        ...

    def replug(self) -> None:
        """Put it back."""
        ...

    def close(self) -> None:
        """Let go of the port for good."""
        ...


def pack(frame: Frame) -> bytes:
    """Return `frame` as bytes of which each bit may flip."""
    return struct.pack(">I", frame.id | _EXTENDED * frame.extended | _REMOTE * frame.remote) + frame.data


def unpack(data: bytes) -> Frame | None:
    """Return the frame; None when the flipped bit leaves none."""
    (word,) = struct.unpack_from(">I", data)
    identifier, extended, remote = word & 0x1FFFFFFF, bool(word & _EXTENDED), bool(word & _REMOTE)
    if word >> 29 & 1 or (identifier > 0x7FF and not extended) or len(data) > 4 + MAX_DATA:
        return None
    return Frame(identifier, extended, b"" if remote else data[4:], remote)


class BusWire:
    """A node on a bus of python-can's; unplugged it is cut off from it."""

    def __init__(self, settings: Settings, faults: LinkFaults) -> None:
        self._port = CanPort(settings)
        self._out, self._in = BadLink(faults, 1), BadLink(faults, 2)
        self._plugged = True

    def send(self, frame: Frame, now_s: float) -> None:
        """Put `frame` on its way."""
        if self._plugged:
            self._out.put(pack(frame), now_s)

    def exchange(self, timeout_s: float, now_s: float) -> list[Frame]:
        """Let out and take in; ``LinkLost`` when the bus is gone."""
        for data in self._out.due(now_s):
            frame = unpack(data)
            if frame is not None:
                self._port.send(frame)
        heard = self._port.receive(min(timeout_s, SLICE_S))
        while heard is not None:
            if self._plugged:
                self._in.put(pack(heard), now_s)
            heard = self._port.receive(0.0)
        frames = [unpack(data) for data in self._in.due(now_s)]
        return [frame for frame in frames if frame is not None]

    def unplug(self) -> None:
        """Cut off from the bus, with what was on the way."""
        self._plugged = False
        self._out.clear()
        self._in.clear()

    def replug(self) -> None:
        """Join the bus again."""
        self._plugged = True

    def close(self) -> None:
        """Let go of the bus."""
        self._port.close()
