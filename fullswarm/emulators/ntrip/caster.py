"""An emulated NTRIP caster: versions 1 and 2, logins, a source table, and faults; written from RTCM 10410.1.

Used by tests, and to try a robot without a base: what `send` is given goes to all clients of the mountpoints.
"""

from __future__ import annotations

import base64
import contextlib
import enum
import socket
import ssl
from collections.abc import Sequence

from fullswarm.emulators.mocap.server import Shown, StreamServer

BLANK = b"\r\n\r\n"


class Kind(enum.Enum):
    """How a caster answers."""

    V2 = "version 2, in chunks"
    V2_PLAIN = "version 2, not in chunks"
    V2_TABLE = "version 2, with the source table for a mountpoint that it does not have"
    V1 = "version 1, to requests of both versions"
    V1_ONLY = "version 1, and hangs up on a request of version 2"
    DEAF = "accepts connections and says nothing"


class Caster(StreamServer):
    """A caster with mountpoints.

    Parameters
    ----------
    mounts : their names
    login : ``USER:PASSWORD`` that it wants; empty: none
    tls : for ``ntrips://``

    Attributes
    ----------
    requests : the heads of all requests
    positions : sentences that clients have sent after their request
    """

    def __init__(
        self,
        mounts: Sequence[str],
        kind: Kind = Kind.V2,
        *,
        login: str = "",
        host: str = "127.0.0.1",
        port: int = 0,
        tls: ssl.SSLContext | None = None,
    ) -> None:
        super().__init__((), host, port)
        self.mounts, self.kind, self.login, self._tls = list(mounts), kind, login, tls
        self.requests: list[str] = []
        self.positions: list[str] = []
        self._heads: dict[socket.socket, bytes] = {}
        self._chunked: dict[socket.socket, bool] = {}  # of clients that get corrections

    @property
    def listeners(self) -> int:
        """How many clients get corrections."""
        return len(self._chunked)

    def send_rtcm(self, data: bytes, piece: int = 0) -> None:
        """Send bytes to all that listen; in pieces of a size, as a network may deliver them."""
        size = piece or len(data)
        with self._lock:
            for at in range(0, len(data), size):
                part = data[at : at + size]
                for client, chunked in tuple(self._chunked.items()):
                    self._write(client, b"%x\r\n%s\r\n" % (len(part), part) if chunked else part)

    def hang_up(self) -> None:
        """Close all connections."""
        with self._lock:
            for client in self.clients:
                with contextlib.suppress(OSError):
                    client.shutdown(socket.SHUT_RDWR)  # its own thread closes it

    # ------------------------------------------------------------------ of a server
    def send(self, bodies: Sequence[Shown], time_s: float) -> None:
        """Show nothing: it has bytes only."""

    def greet(self, client: socket.socket) -> None:
        """Say nothing: clients ask."""
        self._heads[client] = b""

    def answer(self, ready: socket.socket) -> None:
        """Take a new client, or what a client says."""
        if self._tls is None or ready in self.clients:
            super().answer(ready)
            return
        plain, _ = ready.accept()
        plain.settimeout(1.0)
        try:
            client = self._tls.wrap_socket(plain, server_side=True)
        except OSError:
            plain.close()
            return
        self.clients.append(client)
        self.greet(client)

    def hear(self, client: socket.socket, data: bytes) -> None:
        """Answer a request; note the sentences after it."""
        if client not in self._heads:
            self.positions += [line for line in data.decode("latin-1").splitlines() if line]
            return
        self._heads[client] += data
        if BLANK not in self._heads[client]:
            return
        head, _, rest = self._heads.pop(client).partition(BLANK)
        text = head.decode("latin-1")
        self.requests.append(text)
        if rest:
            self.hear(client, rest)
        if self.kind is not Kind.DEAF:
            self._answer_request(client, text)

    def drop(self, gone: socket.socket) -> None:
        """Forget a client that is gone."""
        self._heads.pop(gone, None)
        self._chunked.pop(gone, None)
        super().drop(gone)

    # ------------------------------------------------------------------ answers
    def _answer_request(self, client: socket.socket, text: str) -> None:
        lines = text.split("\r\n")
        method, path, version = lines[0].split(" ")
        headers = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in lines[1:])}
        new = headers.get("ntrip-version", "") == "Ntrip/2.0" and version == "HTTP/1.1"
        if (self.kind is Kind.V1_ONLY and new) or method != "GET":
            self.drop(client)
            return
        v2 = new and self.kind in (Kind.V2, Kind.V2_PLAIN, Kind.V2_TABLE)
        if path.removeprefix("/") not in self.mounts:
            self._refuse_mount(client, v2=v2)
        elif self.login and headers.get("authorization") != f"Basic {base64.b64encode(self.login.encode()).decode()}":
            self._write(client, _head("401 Unauthorized") if v2 else b"ERROR - Bad Password\r\n")
            self.drop(client)
        elif v2:
            chunked = self.kind is not Kind.V2_PLAIN
            more = ("Transfer-Encoding: chunked",) if chunked else ()
            self._write(client, _head("200 OK", "Content-Type: gnss/data", *more))
            self._chunked[client] = chunked
        else:
            self._write(client, b"ICY 200 OK\r\n\r\n")
            self._chunked[client] = False

    def _refuse_mount(self, client: socket.socket, *, v2: bool) -> None:
        rows = [
            f"STR;{name};Somewhere;RTCM 3.2;1005(10),1077(1);2;GPS;NONE;DEU;48.00;11.00;1;0;none;none;B;N;0;"
            for name in self.mounts
        ]
        table = "\r\n".join(["CAS;127.0.0.1;2101;emulated;;0;DEU;48.00;11.00;0.0.0.0;0;", *rows, "ENDSOURCETABLE\r\n"])
        if v2 and self.kind is not Kind.V2_TABLE:
            self._write(client, _head("404 Not Found"))
        elif v2:
            self._write(client, _head("200 OK", "Content-Type: gnss/sourcetable") + table.encode())
        else:
            head = f"SOURCETABLE 200 OK\r\nContent-Type: text/plain\r\nContent-Length: {len(table)}"
            self._write(client, head.encode() + BLANK + table.encode())
        self.drop(client)

    def _write(self, client: socket.socket, data: bytes) -> None:
        try:
            client.sendall(data)
        except OSError:
            self._chunked.pop(client, None)  # its end is read as well


def _head(status: str, *lines: str) -> bytes:
    head = [f"HTTP/1.1 {status}", "Ntrip-Version: Ntrip/2.0", "Server: NTRIP emulated", *lines, "Connection: close"]
    return "\r\n".join(head).encode() + BLANK
