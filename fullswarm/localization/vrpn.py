"""VRPN's tracker messages over TCP as a source: one sender per rigid body.

Layout after the VRPN library (vrpn_Connection.C, vrpn_Tracker.C; github.com/vrpn/vrpn), protocol 7. Big-endian, each
message padded to 8 bytes. A server sends everything over TCP to a client that names no UDP port, as this one does not.
Reports have the server's time of day, which may jump: the time of arrival counts.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterable, Sequence
from urllib.parse import urlsplit

from fullswarm.clock import Clock
from fullswarm.localization.links import CONNECT_S, PIECE, Connection, FrameSource, HasFileno
from fullswarm.localization.sighting import Body, Frame, Refused

HINT = "does the server stream over VRPN, and does it see a body?"
PORT = 3883
MAGIC = b"vrpn: ver. 07."
COOKIE = b"vrpn: ver. 07.35  0".ljust(24, b"\0")
HEADER = struct.Struct(">5i4x")  # length without padding, seconds, microseconds, sender, type
SENDER_NAME, TYPE_NAME = -1, -2
POSE = "vrpn_Tracker Pos_Quat"
POSE_LAYOUT = struct.Struct(">i4x7d")  # sensor, x, y, z, and x, y, z, w of the quaternion
LONGEST = 65_536
FROZEN = 20
"""A pose that has come so often without any change in any digit is no measurement: servers repeat the last one of a
body that the cameras have lost."""
MOST_NAMES = 2000


class Broken(OSError):
    """The stream cannot be read on."""


class Session:
    """One connection's stream, without I/O."""

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._greeted = False
        self._senders: dict[int, str] = {}
        self._poses: int | None = None
        self._last: dict[int, tuple[bytes, int]] = {}  # by sender: its last pose, how often it has come

    def receive(self, data: bytes) -> list[Frame | Refused]:
        """Read on; return a frame of one body for each report.

        Raises
        ------
        Broken
            The other side is no VRPN server of protocol 7, or a message has an impossible length.
        """
        self._buffer += data
        found: list[Frame | Refused] = []
        if not self._greeted:
            if len(self._buffer) < len(COOKIE):
                return found
            if not self._buffer.startswith(MAGIC):
                raise Broken(f"no VRPN server of protocol 7: it begins {bytes(self._buffer[:24])!r}")
            del self._buffer[: len(COOKIE)]
            self._greeted = True
        while (message := self._next()) is not None:
            sender, kind, payload = message
            try:
                found += self._message(sender, kind, payload)
            except Refused as refused:
                found.append(refused)
        return found

    def _next(self) -> tuple[int, int, bytes] | None:
        if len(self._buffer) < HEADER.size:
            return None
        length, _, _, sender, kind = HEADER.unpack_from(self._buffer)
        if not HEADER.size <= length <= LONGEST:
            raise Broken(f"a message of {length} bytes")
        padded = -(-length // 8) * 8
        if len(self._buffer) < padded:
            return None
        payload = bytes(self._buffer[HEADER.size : length])
        del self._buffer[:padded]
        return sender, kind, payload

    def _message(self, sender: int, kind: int, payload: bytes) -> list[Frame | Refused]:
        if kind in (SENDER_NAME, TYPE_NAME):
            self._name(sender, kind, payload)
        elif kind >= 0 and kind == self._poses:
            if len(payload) < POSE_LAYOUT.size:
                raise Refused("a report that ends too early")
            if sender not in self._senders:
                raise Refused("a report of a sender without a name")
            sensor, x, y, z, *quaternion = POSE_LAYOUT.unpack_from(payload)
            if sensor == 0:  # others are parts of the body: markers, joints
                qx, qy, qz, qw = quaternion
                tracked = self._repeats(sender, payload) < FROZEN
                return [Frame((Body(self._senders[sender], x, y, z, (qx, qy, qz, qw), tracked),))]
        return []

    def _repeats(self, sender: int, payload: bytes) -> int:
        """Return how often this pose has come before, one after the other."""
        last, count = self._last.get(sender, (b"", 0))
        count = count + 1 if payload == last else 0
        self._last[sender] = payload, count
        return count

    def _name(self, number: int, kind: int, payload: bytes) -> None:
        if len(payload) < 4:
            raise Refused("a name that ends too early")
        length = struct.unpack_from(">i", payload)[0]
        if not 0 <= length <= len(payload) - 4:
            raise Refused("a name that ends too early")
        name = payload[4 : 4 + length].split(b"\0")[0].decode(errors="replace")
        if kind == TYPE_NAME:
            if name == POSE:
                self._poses = number
        elif len(self._senders) < MOST_NAMES:
            self._senders[number] = name


class VrpnConnection(Connection):
    """A TCP connection to a server."""

    def __init__(self, host: str, port: int) -> None:
        self._sender, self._session = host, Session()
        self._socket = socket.create_connection((host, port), CONNECT_S)
        self._socket.sendall(COOKIE)
        self._socket.setblocking(False)

    def waits_on(self) -> Sequence[HasFileno]:
        """Return the socket."""
        return (self._socket,)

    def read(self, ready: HasFileno, now_s: float) -> Iterable[tuple[str, Frame | Refused]]:
        """Read on."""
        del ready, now_s
        data = self._socket.recv(PIECE)
        if not data:
            raise ConnectionResetError("the server has closed the connection")
        return [(self._sender, each) for each in self._session.receive(data)]

    def close(self) -> None:
        """Release it."""
        self._socket.close()


def open_source(url: str, clock: Clock) -> FrameSource:
    """Return ``vrpn://HOST[:3883]``."""
    parts = urlsplit(url)
    host, port = parts.hostname or "", parts.port or PORT
    return FrameSource("mocap vrpn", HINT, url, lambda: VrpnConnection(host, port), clock)
