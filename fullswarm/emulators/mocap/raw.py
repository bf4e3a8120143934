"""Plays bytes as they were recorded, over TCP, and sends JSON datagrams for poses."""

from __future__ import annotations

import json
import socket
from collections.abc import Sequence

from fullswarm.emulators.mocap.server import Server, Shown, StreamServer


class RawServer(StreamServer):
    """A receiver behind a TCP port: all clients get the same bytes."""

    def greet(self, client: socket.socket) -> None:
        """Say nothing."""

    def hear(self, client: socket.socket, data: bytes) -> None:
        """Take no notice."""

    def send(self, bodies: Sequence[Shown], time_s: float) -> None:
        """Show nothing: it has bytes only."""

    def send_bytes(self, data: bytes) -> None:
        """Send bytes to all clients."""
        self.send_all(lambda _: data)


class JsonSender(Server):
    """A program that sends a JSON datagram per frame to a UDP port."""

    def __init__(self, names: Sequence[str], host: str, port: int) -> None:
        super().__init__(names)
        self._to = (host, port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    @property
    def port(self) -> int:
        """The port it sends to."""
        return self._to[1]

    def sockets(self) -> Sequence[socket.socket]:
        """Return its socket."""
        return (self._socket,)

    def answer(self, ready: socket.socket) -> None:
        """Take what comes back, which is nothing of use."""
        ready.recv(1000)

    def send(self, bodies: Sequence[Shown], time_s: float) -> None:
        """Send a datagram with all bodies; the time of arrival counts."""
        del time_s
        found = []
        for each in bodies:
            x, y, z = each.position
            seen = {"x": x, "y": y, "z": z, "quaternion": list(each.quaternion)}
            found.append({"name": each.name, **(seen if each.seen else {"tracked": False})})
        self._socket.sendto(json.dumps(found).encode(), self._to)

    def send_bytes(self, data: bytes) -> None:
        """Send a datagram as it was recorded."""
        self._socket.sendto(data, self._to)
