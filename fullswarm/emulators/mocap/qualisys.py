"""Plays Qualisys Track Manager: its real-time protocol over TCP, little-endian.

Written from Qualisys' description "QTM Real-time Server Protocol", version 1.22 (docs.qualisys.com). Millimetres, z up.
"""

from __future__ import annotations

import math
import socket
from collections.abc import Sequence
from struct import pack, unpack_from
from xml.sax.saxutils import escape

from fullswarm.emulators.mocap.server import Shown, StreamServer

ERROR, COMMAND, XML, DATA = 0, 1, 2, 3
WITH_RESIDUAL = 11
NONE = math.nan


class QualisysServer(StreamServer):
    """QTM on a port; clients that are little-endian use the base port + 1."""

    def __init__(self, names: Sequence[str], host: str = "127.0.0.1", port: int = 22223) -> None:
        super().__init__(names, host, port)
        self._said: dict[socket.socket, bytes] = {}
        self._streaming: set[socket.socket] = set()
        self._number = 0

    def greet(self, client: socket.socket) -> None:
        """Say what QTM says first."""
        client.sendall(_packet(COMMAND, b"QTM RT Interface connected\0"))

    def hear(self, client: socket.socket, data: bytes) -> None:
        """Carry out commands."""
        data = self._said.pop(client, b"") + data
        while len(data) >= 8 and len(data) >= (size := unpack_from("<I", data)[0]) >= 8:
            self._command(client, data[8:size].rstrip(b"\0").decode())
            data = data[size:]
        self._said[client] = data

    def _command(self, client: socket.socket, command: str) -> None:
        word, _, rest = command.partition(" ")
        match word.lower():
            case "version":
                client.sendall(_packet(COMMAND, f"Version set to {rest}\0".encode()))
            case "getparameters":
                client.sendall(_packet(XML, self._parameters()))
            case "streamframes" if rest.lower() == "stop":
                self._streaming.discard(client)
            case "streamframes":
                self._streaming.add(client)
            case _:
                client.sendall(_packet(ERROR, b"Parse error\0"))

    def _parameters(self) -> bytes:
        bodies = "".join(
            f"<Body><Name>{escape(name)}</Name><Enabled>true</Enabled><Color R='255' G='0' B='0'/>"
            "<MaximumResidual>10</MaximumResidual><MinimumMarkersInBody>3</MinimumMarkersInBody>"
            "<Points><Point X='0' Y='0' Z='0' Virtual='0' PhysicalId='0' Name='front'/></Points></Body>"
            for name in self.names
        )
        six = f"<The_6D><Bodies>{len(self.names)}</Bodies>{bodies}<Euler><First>Roll</First></Euler></The_6D>"
        return f"<QTM_Parameters_Ver_1.22>{six}</QTM_Parameters_Ver_1.22>\0".encode()

    def drop(self, gone: socket.socket) -> None:
        """Forget a client."""
        self._said.pop(gone, None)
        self._streaming.discard(gone)
        super().drop(gone)

    def send(self, bodies: Sequence[Shown], time_s: float) -> None:
        """Send a frame: always all bodies, those that are not seen without numbers."""
        self._number += 1
        by_name = {each.name: each for each in bodies}
        content = pack("<IHH", len(self.names), 0, 0)
        content += b"".join(_body(by_name.get(name)) for name in self.names)
        component = pack("<II", 8 + len(content), WITH_RESIDUAL) + content
        data = _packet(DATA, pack("<qII", int(1e6 * time_s), self._number, 1) + component)
        self.send_all(lambda client: data if client in self._streaming else b"")


def _body(shown: Shown | None) -> bytes:
    if shown is None or not shown.seen:
        return pack("<13f", *13 * (NONE,))
    x, y, z, w = shown.quaternion
    columns = (
        1 - 2 * (y * y + z * z), 2 * (x * y + z * w), 2 * (x * z - y * w),
        2 * (x * y - z * w), 1 - 2 * (x * x + z * z), 2 * (y * z + x * w),
        2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y),
    )  # fmt: skip
    return pack("<3f9ff", *shown.position, *columns, 0.3)


def _packet(kind: int, content: bytes) -> bytes:
    return pack("<II", 8 + len(content), kind) + content
