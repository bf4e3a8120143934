"""Plays OptiTrack Motive: answers and frames of NatNet 2.6 to 4.2, unicast or multicast.

Layouts written from the description of the protocol in NatNetTypes.h and PacketClient.cpp of OptiTrack's NatNet SDK.
Every frame has the sections that Motive sends: a set with markers, markers without a label, labelled markers, and for
recent versions a device, so that a parser must step over them.
"""

from __future__ import annotations

import socket
from collections.abc import Sequence
from struct import pack

from fullswarm.emulators.mocap.server import Server, Shown

CLOCK_HZ = 10_000_000
GROUP = "239.255.42.99"


class NatNetServer(Server):
    """Motive on a UDP port.

    Parameters
    ----------
    group : multicast group of the frames; empty: unicast, to those who asked
    interface : of this machine, for multicast
    """

    def __init__(
        self,
        names: Sequence[str],
        host: str = "127.0.0.1",
        port: int = 1510,
        *,
        version: tuple[int, int] = (4, 1),
        group: str = "",
        data_port: int = 1511,
    ) -> None:
        super().__init__(names)
        self._version, self._group, self._data_port = version, group, data_port
        self._number = 0
        self._clients: set[tuple[str, int]] = set()
        self._commands = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._commands.bind((host, port))
        if group:
            self._commands.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(host))

    @property
    def port(self) -> int:
        """The port for commands."""
        number: int = self._commands.getsockname()[1]
        return number

    def sockets(self) -> Sequence[socket.socket]:
        """Return the socket for commands."""
        return (self._commands,)

    def answer(self, ready: socket.socket) -> None:
        """Answer a command."""
        data, sender = ready.recvfrom(65_536)
        kind = int.from_bytes(data[:2], "little")
        if kind == 0:
            self._clients.add(sender)
            ready.sendto(_message(1, self._info()), sender)
        elif kind == 4:
            ready.sendto(_message(5, self._models()), sender)

    def _info(self) -> bytes:
        major, minor = self._version
        name = b"Motive".ljust(256, b"\0")
        group = socket.inet_aton(self._group or GROUP)
        versions = bytes((3, 1, 0, 0)) + bytes((major, minor, 0, 0))
        if major < 3:
            return name + versions
        return name + versions + pack("<QHB", CLOCK_HZ, self._data_port, bool(self._group)) + group

    def _models(self) -> bytes:
        sets = [(0, b"all\0" + pack("<i", 2) + b"first\0second\0")]
        bodies = [(1, self._model(name, number)) for number, name in enumerate(self.names, 1)]
        out = pack("<i", len(sets) + len(bodies))
        for kind, content in (*sets, *bodies):
            out += pack("<i", kind)
            if self._version >= (4, 1):
                out += pack("<i", len(content))
            out += content
        return out

    def _model(self, name: str, number: int) -> bytes:
        out = name.encode() + b"\0" + pack("<ii3f", number, -1, 0, 0, 0)
        if self._version >= (4, 2):
            out += pack("<4f", 0, 0, 0, 1)
        if self._version >= (3, 0):
            markers = 3
            out += pack("<i", markers) + pack("<9f", *range(9)) + pack("<3i", 0, 0, 0)
            if self._version >= (4, 0):
                out += b"front\0left\0right\0"
        return out

    def send(self, bodies: Sequence[Shown], time_s: float) -> None:
        """Send a frame."""
        data = _message(7, self._frame(bodies, time_s))
        for client in {(self._group, self._data_port)} if self._group else self._clients:
            self._commands.sendto(data, client)

    def _frame(self, bodies: Sequence[Shown], time_s: float) -> bytes:
        self._number += 1
        old = self._version < (3, 0)
        out = pack("<i", self._number)
        out += self._section(1, b"all\0" + pack("<i3f3f", 2, 0, 0, 0, 1, 1, 1))
        out += self._section(1, pack("<3f", 9, 9, 9))
        out += self._section(len(bodies), b"".join(self._body(each) for each in bodies))
        if self._version >= (2, 1):
            out += self._section(0, b"")  # skeletons
        if self._version >= (4, 1):
            out += self._section(0, b"")  # assets
        if self._version >= (2, 3):
            marker = pack("<i3ff", 65_537, 1, 2, 3, 0.01)
            marker += b"" if self._version < (2, 6) else pack("<h", 2)
            out += self._section(1, marker + (b"" if old else pack("<f", 0.0005)))
        if self._version >= (2, 9):
            out += self._section(1, pack("<iiiff", 1, 1, 2, 0.5, 0.6))  # a force plate with one channel
        if self._version >= (2, 11):
            out += self._section(0, b"")  # devices
        return out + self._suffix(time_s)

    def _section(self, count: int, content: bytes) -> bytes:
        size = pack("<i", len(content)) if self._version >= (4, 1) else b""
        return pack("<i", count) + size + content

    def _body(self, shown: Shown) -> bytes:
        x, y, z = shown.position if shown.seen else (0.0, 0.0, 0.0)
        out = pack("<i3f4f", self.names.index(shown.name) + 1, x, y, z, *shown.quaternion)
        if self._version < (3, 0):
            out += pack("<i", 1) + pack("<3f", x, y, z) + pack("<i", 1) + pack("<f", 0.01)
        out += pack("<f", 0.0002)
        return out + (pack("<h", int(shown.seen)) if self._version >= (2, 6) else b"")

    def _suffix(self, time_s: float) -> bytes:
        out = pack("<ii", 0, 0)
        out += pack("<d", time_s) if self._version >= (2, 7) else pack("<f", time_s)
        if self._version >= (3, 0):
            ticks = int(time_s * CLOCK_HZ) + 1
            out += pack("<QQQ", ticks, ticks + 1, ticks + 2)
        if self._version >= (4, 1):
            out += pack("<II", int(time_s), 0)
        return out + pack("<h", 0) + pack("<i", 0)


def _message(kind: int, content: bytes) -> bytes:
    return pack("<HH", kind, len(content)) + content
