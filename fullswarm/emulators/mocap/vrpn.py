"""Plays a VRPN server with one tracker per body, over TCP.

Written from vrpn_Connection.h, vrpn_Connection.C and vrpn_Tracker.C of the VRPN library. A client of that library asks
over UDP to be called back over TCP; this server does that too.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Sequence

from fullswarm.emulators.mocap.server import Shown, StreamServer

HELLO = b"vrpn: ver. 07.38  0\0\0\0\0\0"
TYPES = ("vrpn_Base ping_message", "vrpn_Base pong_message", "vrpn_Tracker Pos_Quat", "vrpn_Tracker Velocity")


class VrpnServer(StreamServer):
    """A server with trackers."""

    def __init__(self, names: Sequence[str], host: str = "127.0.0.1", port: int = 3883) -> None:
        super().__init__(names, host, port)
        self._requests = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._requests.bind((host, self.port))
        self._ready: set[int] = set()
        self.frozen = False
        """Repeat poses digit for digit, as servers do for a body that is lost; else the last digits vary."""
        self._noise_m = 1e-7

    def sockets(self) -> Sequence[socket.socket]:
        """Return listener, clients, and the port for requests to be called back."""
        return (*super().sockets(), self._requests)

    def answer(self, ready: socket.socket) -> None:
        """Call back a client that asks so; else as every server."""
        if ready is not self._requests:
            super().answer(ready)
            return
        request, _ = ready.recvfrom(1000)
        host, port = request.split(b"\0")[0].decode().split()[:2]
        client = socket.create_connection((host, int(port)), 1.0)
        self.clients.append(client)
        self.greet(client)

    def greet(self, client: socket.socket) -> None:
        """Send the cookie."""
        client.sendall(HELLO)

    def hear(self, client: socket.socket, data: bytes) -> None:
        """After the client's cookie, describe senders and types; ignore the rest."""
        del data
        if client.fileno() in self._ready:
            return
        self._ready.add(client.fileno())
        out = b"".join(_described(-1, number, name) for number, name in enumerate(self.names, 10))
        client.sendall(out + b"".join(_described(-2, number, name) for number, name in enumerate(TYPES)))

    def drop(self, gone: socket.socket) -> None:
        """Forget a client."""
        self._ready.discard(gone.fileno())
        super().drop(gone)

    def send(self, bodies: Sequence[Shown], time_s: float) -> None:
        """Send a report for each body that is seen: a tracker is silent about others."""
        out = b""
        self._noise_m = self._noise_m if self.frozen else -self._noise_m
        for shown in bodies:
            if shown.seen:
                x, y, z = shown.position
                content = struct.pack(">ii", 0, 0) + struct.pack(">3d4d", x + self._noise_m, y, z, *shown.quaternion)
                out += _message(self.names.index(shown.name) + 10, 2, content, time_s)
                out += _message(self.names.index(shown.name) + 10, 3, bytes(72), time_s)  # a velocity
        self.send_all(lambda client: out if client.fileno() in self._ready else b"")


def _described(kind: int, number: int, name: str) -> bytes:
    text = name.encode() + b"\0"
    return _message(number, kind, struct.pack(">i", len(text)) + text, 0.0)


def _message(sender: int, kind: int, content: bytes, time_s: float) -> bytes:
    seconds = int(time_s)
    head = struct.pack(">iiiiii", 24 + len(content), seconds, int(1e6 * (time_s - seconds)), sender, kind, 0)
    return head + content + bytes(-len(content) % 8)
