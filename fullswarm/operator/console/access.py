"""Controls access: Host, Origin and token of each request, and the connections that have not sent the token.

A page of any other origin can make a browser send requests here, and open WebSockets. Three checks prevent it: such a
page does not know the token, its Origin is not this server's, and a host name that it points here is refused.

Anybody who reaches the port can open connections and send nothing, or half a request. Each connection is unverified
until its page has sent the right token. Unverified connections have a small pool of their own, in which the oldest
is closed for the newest: they cannot use up what operators need, and an operator who connects is always accepted.
"""

from __future__ import annotations

import asyncio
import contextlib
import hmac
import ipaddress
import re
import socket
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import uvicorn
from starlette.datastructures import Headers, MutableHeaders
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState

from fullswarm.bus.endpoint import is_loopback
from fullswarm.operator.console.frames import MAX_BYTES

if TYPE_CHECKING:
    from starlette.applications import Starlette

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
_HOST = re.compile(r"(?P<name>\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::(?P<port>[0-9]{1,5}))?\Z")


@dataclass(frozen=True, slots=True)
class Names:
    """The host names of this server.

    Parameters
    ----------
    bound
        Address that it listens on.
    port
        Its port.
    also
        Names that the user allows, with or without a port: a proxy in front may have its own.
    """

    bound: str
    port: int
    also: frozenset[str] = frozenset()

    def host(self, value: str) -> bool:
        """Return whether a Host header names this server."""
        match = _HOST.match(value)
        if match is None:
            return False
        name, port = match["name"].strip("[]").lower(), match["port"]
        if name in self.also or value.lower() in self.also:
            return True
        if int(port or 80) != self.port:
            return False
        if name == self.bound.lower():
            return True
        if is_loopback(self.bound) or not _is_any(self.bound):
            return is_loopback(self.bound) and is_loopback(name)
        # Bound to all addresses: accept any plain address, but no name: a foreign one could point here.
        return name == "localhost" or _is_address(name)

    def origin(self, value: str, host: str) -> bool:
        """Return whether an Origin header is this server under the name of the Host header."""
        scheme, _, origin_host = value.partition("://")
        if origin_host.lower() != host.lower():
            return False
        name = host.rpartition(":")[0] or host
        return scheme == "http" or (scheme == "https" and {host.lower(), name.lower()} & self.also != set())


def _is_any(address: str) -> bool:
    return address in ("0.0.0.0", "::")  # noqa: S104  (compared, not bound)


def _is_address(name: str) -> bool:
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


def same_token(given: str, wanted: str) -> bool:
    """Compare two tokens in constant time."""
    return hmac.compare_digest(given.encode(), wanted.encode())


class Guard:
    """Refuses requests under other host names and from other origins; adds the security headers."""

    def __init__(self, app: ASGIApp, names: Names) -> None:
        self._app, self._names = app, names

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        reason = self._refuses(Headers(scope=scope), needs_origin=scope["type"] == "websocket")

        async def send_with_headers(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    headers[name] = value
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        if not reason:
            await self._app(scope, receive, send_with_headers)
            return
        if scope["type"] == "websocket":
            await receive()  # the opening, which must be received before it may be refused
        await PlainTextResponse(reason, 403)(scope, receive, send_with_headers)

    def _refuses(self, headers: Headers, *, needs_origin: bool) -> str:
        hosts, origins = headers.getlist("host"), headers.getlist("origin")
        if len(hosts) != 1 or not self._names.host(hosts[0]):
            return "Forbidden: unknown host name; allow it with --allow-host"
        if len(origins) > 1 or (needs_origin and not origins):
            return "Forbidden: a WebSocket needs one Origin header"
        if origins and not self._names.origin(origins[0], hosts[0]):
            return "Forbidden: cross-origin request"
        return ""


@dataclass(slots=True)
class Bucket:
    """Limits the frames of a page: `rate_hz` on average, `burst` at once (token bucket)."""

    rate_hz: float
    burst: float
    _left: float = field(init=False)
    _at_s: float | None = None

    def __post_init__(self) -> None:
        self._left = self.burst

    def take(self, now_s: float) -> bool:
        """Count one frame; return False when it is too many."""
        if self._at_s is not None:
            self._left = min(self.burst, self._left + (now_s - self._at_s) * self.rate_hz)
        self._at_s = now_s
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True


def lower(names: Iterable[str]) -> frozenset[str]:
    """Return names in lower case, without empty ones."""
    return frozenset(name.strip().lower() for name in names if name.strip())


# ---------------------------------------------------------------- connections that have not sent the token
MOST_UNVERIFIED = 128
"""A browser that loads the page has about six."""
HEADER_S = 3.0
"""Time limit for the first complete request of a connection."""
ACCEPTS = 64
"""Connections accepted per turn of the loop: with the pool they stay far below 1024 open files, a common limit."""
BACKLOG = 4096
"""Connections that the system keeps waiting; beyond it a browser tries again only after 1 s."""
END_S = 0.4
"""Time limit for pages to answer the closing; then their connections are aborted."""


class Admission:
    """One connection in the pool, from its opening until it sends the token or ends."""

    def __init__(self, pool: Unverified, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._pool, self._transport = pool, transport
        self._timer = loop.call_later(pool.header_s, self.cut)

    def requested(self) -> None:
        """Note that a complete request came: those that sent none are closed first."""
        self._timer.cancel()
        self._pool.requested(self)

    def leave(self) -> None:
        """Leave the pool: the page sent the token, or the connection ended."""
        self._timer.cancel()
        self._pool.remove(self)

    def cut(self) -> None:
        """Abort the connection at once."""
        self.leave()
        self._transport.abort()


class Unverified:
    """The pool of connections that have not sent the token, at most `MOST_UNVERIFIED`."""

    def __init__(self) -> None:
        self.header_s = HEADER_S
        self._silent: dict[Admission, None] = {}  # the oldest first, as all dictionaries
        self._requested: dict[Admission, None] = {}

    def __len__(self) -> int:
        """Count them."""
        return len(self._silent) + len(self._requested)

    def enter(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> Admission:
        """Take a new connection; the oldest without a complete request, else the oldest, is closed for it."""
        while len(self) >= MOST_UNVERIFIED:
            next(iter(self._silent or self._requested)).cut()
        admission = Admission(self, transport, loop)
        self._silent[admission] = None
        return admission

    def requested(self, admission: Admission) -> None:
        """Move a connection behind the others that sent a complete request."""
        if admission in self._silent:
            del self._silent[admission]
            self._requested[admission] = None

    def remove(self, admission: Admission) -> None:
        """Forget a connection; doing so twice is fine."""
        self._silent.pop(admission, None)
        self._requested.pop(admission, None)

    def cut(self) -> None:
        """End all of them."""
        for admission in (*self._silent, *self._requested):
            admission.cut()


class State(ServerState):
    """What the connections of one server share."""

    def __init__(self) -> None:
        super().__init__()
        self.unverified = Unverified()


class HttpProtocol(H11Protocol):
    """One connection that speaks HTTP. The application finds its :class:`Admission` as ``state.admission``."""

    server_state: State

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as in uvicorn's own
        """Enter the pool."""
        super().connection_made(transport)
        self.admission = self.server_state.unverified.enter(transport, self.loop)
        self.app_state = {**self.app_state, "admission": self.admission}

    def data_received(self, data: bytes) -> None:
        """Take what came; the first complete request ends the wait for one."""
        super().data_received(data)
        if self.scope is not None:
            self.admission.requested()

    def connection_lost(self, exc: Exception | None) -> None:
        """Leave the pool."""
        super().connection_lost(exc)
        self.admission.leave()


class WebSocketProtocol(WebSocketsSansIOProtocol):
    """The same connection after it became a WebSocket."""

    def connection_lost(self, exc: Exception | None) -> None:
        """Leave the pool."""
        super().connection_lost(exc)
        self.app_state["admission"].leave()


class Server(uvicorn.Server):
    """Ends soon, and leaves the signals alone: a second Ctrl-C must end the process, SIGTERM end it in order."""

    server_state: State

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.server_state = State()

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen; asyncio has one number for the queue of the system and for how many it takes out of it at once."""
        await super().startup(sockets)
        for each in sockets or ():
            each.listen(BACKLOG)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close what pages have open, and cut what does not close; connections without the token are cut at once."""
        self.server_state.unverified.cut()
        late = asyncio.get_running_loop().call_later(END_S, self._cut)
        try:
            await super().shutdown(sockets)
        finally:
            late.cancel()

    def _cut(self) -> None:
        self.force_exit = True
        for connection in tuple(self.server_state.connections):
            connection.transport.abort()


def uvicorn_server(app: Starlette) -> Server:
    """Return the server of an application, not started: on bound sockets, silent, and deaf to signals."""
    config = uvicorn.Config(
        app,
        http=HttpProtocol,
        ws=WebSocketProtocol,
        ws_max_size=4 * MAX_BYTES,  # what is over MAX_BYTES but not absurd gets its own closing code
        ws_per_message_deflate=False,  # costs more than a loopback or a lab's network
        lifespan="off",
        log_config=None,
        log_level="error",
        access_log=False,
        proxy_headers=False,
        server_header=False,
        backlog=ACCEPTS,
    )
    return Server(config)
