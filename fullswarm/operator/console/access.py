"""Controls access: Host, Origin and token of each request, and the connections that have not sent the token.

A page of any other origin can make a browser send requests here, and open WebSockets. Three checks prevent it: such a
page does not know the token, its Origin is not this server's, and a host name that it points here is refused.

Anybody who reaches the port can open connections and send nothing, or half a request. Each connection is unverified
until its page has sent the right token. Unverified connections have a small pool of their own, in which the oldest of
the address with the most is closed for a new one: they cannot use up what operators need, and an operator who connects
is accepted.
"""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import re
import socket
from collections import deque
from collections.abc import Callable, Iterable, Iterator
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
from fullswarm.operator.console.api.problems import ProblemError
from fullswarm.operator.console.frames import MAX_BYTES

if TYPE_CHECKING:
    from starlette.applications import Starlette

POLICY = "Content-Security-Policy"
HEADERS = {
    POLICY: (
        "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
}
PROGRAMS = "/api/"
"""Programs send no Origin: below this path the token is what admits them."""
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


class Guard:
    """Refuses requests under other host names and from other origins; adds the security headers."""

    def __init__(self, app: ASGIApp, names: Names) -> None:
        self._app, self._names = app, names

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        program = scope["path"].startswith(PROGRAMS)
        reason = self._refuses(Headers(scope=scope), needs_origin=scope["type"] == "websocket" and not program)

        async def send_with_headers(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                headers = MutableHeaders(scope=message)
                for name, value in HEADERS.items():
                    # A document that is no page of the console brings a policy of its own: a report.
                    if name != POLICY or name not in headers:
                        headers[name] = value
                headers.setdefault("Cache-Control", "no-store")
            await send(message)

        strange = program and not scope["path"].isprintable()  # the table of routes would not recognise it
        if not reason and not strange:
            await self._app(scope, receive, send_with_headers)
            return
        if scope["type"] == "websocket":
            await receive()  # the opening, which must be received before it may be refused
        if strange and not reason:
            refused = ProblemError(400, "the address has characters that cannot be printed").response()
        else:
            refused = ProblemError(403, reason).response() if program else PlainTextResponse(reason, 403)
        await refused(scope, receive, send_with_headers)

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
ACCEPTS = 1024
"""Connections accepted per turn of the loop."""
MOST_NEW, MOST_NEW_EACH = 64, 32
"""Connections that are served of those accepted in a turn, of all addresses and of each: with the pool they stay far
below 1024 open files, a common limit."""
BACKLOG = 4096
"""Connections that the system keeps waiting; beyond it a browser tries again only after 1 s."""
END_S = 0.4
"""Time limit for pages to answer the closing; then their connections are aborted."""


class Admission:
    """One connection in the pool, from its opening until it sends the token or ends."""

    def __init__(
        self, pool: Unverified, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop, address: str
    ) -> None:
        self.address = address
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


class Share:
    """The connections of one address in the pool, the oldest first, as in all dictionaries."""

    def __init__(self) -> None:
        self.silent: dict[Admission, None] = {}
        self.requested: dict[Admission, None] = {}

    def __len__(self) -> int:
        """Count them."""
        return len(self.silent) + len(self.requested)


class Unverified:
    """The pool of connections that have not sent the token, at most `MOST_UNVERIFIED`.

    When it is full, the address with the most connections loses one: the oldest without a complete request, else the
    oldest. So an address can displace its own connections only, and those of addresses that have as many.
    """

    def __init__(self) -> None:
        self.header_s = HEADER_S
        self._shares: dict[str, Share] = {}
        self._count = 0

    def __len__(self) -> int:
        """Count them."""
        return self._count

    def enter(self, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> Admission:
        """Take a new connection, and make room for it."""
        while self._count >= MOST_UNVERIFIED:
            self.cut_one()
        admission = Admission(self, transport, loop, _network(transport.get_extra_info("peername")))
        self._shares.setdefault(admission.address, Share()).silent[admission] = None
        self._count += 1
        return admission

    def cut_one(self) -> None:
        """Close the connection that is to go first, if there is one."""
        if self._shares:
            largest = max(self._shares.values(), key=len)
            next(iter(largest.silent or largest.requested)).cut()

    def requested(self, admission: Admission) -> None:
        """Move a connection behind the others of its address that sent a complete request."""
        share = self._shares.get(admission.address)
        if share is not None and admission in share.silent:
            del share.silent[admission]
            share.requested[admission] = None

    def remove(self, admission: Admission) -> None:
        """Forget a connection; doing so twice is fine."""
        share = self._shares.get(admission.address)
        if share is None:
            return
        before = len(share)
        share.silent.pop(admission, None)
        share.requested.pop(admission, None)
        self._count -= before - len(share)
        if not len(share):
            del self._shares[admission.address]

    def cut(self) -> None:
        """End all of them."""
        for share in tuple(self._shares.values()):
            for admission in (*share.silent, *share.requested):
                admission.cut()


def _network(peer: object) -> str:
    """Return the address of a connection's other end; of IPv6 its network of 64 bits, of which a host has all."""
    address = str(peer[0]) if isinstance(peer, tuple) and peer else ""
    if ":" not in address or address.startswith("::ffff:"):
        return address
    return ":".join(ipaddress.IPv6Address(address.partition("%")[0]).exploded.split(":")[:4])


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


class Gate:
    """Accepts the connections of a listening socket, and serves only the newest ones of those that came at once.

    Closing a connection costs a hundredth of serving it, so a stream of connections from one address can neither fill
    the system's queue nor keep the loop busy.
    """

    def __init__(
        self,
        listener: socket.socket,
        loop: asyncio.AbstractEventLoop,
        protocol: Callable[[], asyncio.Protocol],
        pool: Unverified,
    ) -> None:
        self._listener, self._loop, self._protocol, self._pool = listener, loop, protocol, pool
        self._tasks: set[asyncio.Task[None]] = set()
        listener.setblocking(False)
        listener.listen(BACKLOG)
        loop.add_reader(listener, self._accept)

    def close(self) -> None:
        """Accept no more."""
        self._loop.remove_reader(self._listener)
        for task in self._tasks:
            task.cancel()

    def _accept(self) -> None:
        newest: dict[str, deque[socket.socket]] = {}
        count = 0
        for _ in range(ACCEPTS):
            try:
                connection, peer = self._listener.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                break
            except OSError:  # no file descriptor is left
                self._pool.cut_one()
                break
            own = newest.setdefault(_network(peer), deque())
            own.append(connection)
            count += 1
            if len(own) > MOST_NEW_EACH or count > MOST_NEW:
                fullest = own if len(own) > MOST_NEW_EACH else max(newest.values(), key=len)
                fullest.popleft().close()
                count -= 1
        for own in newest.values():
            for connection in own:
                task = self._loop.create_task(self._serve(connection))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)

    async def _serve(self, connection: socket.socket) -> None:
        try:
            connection.setblocking(False)
            # asyncio does so only for sockets that name their protocol; without it an answer waits 40 ms for its body.
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            await self._loop.connect_accepted_socket(self._protocol, connection)
        except OSError:  # closed by its other end meanwhile
            connection.close()
        except BaseException:
            connection.close()
            raise


class Server(uvicorn.Server):
    """Ends soon, and leaves the signals alone: a second Ctrl-C must end the process, SIGTERM end it in order."""

    server_state: State

    def __init__(self, config: uvicorn.Config) -> None:
        super().__init__(config)
        self.server_state = State()
        self._gates: list[Gate] = []

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Capture none."""
        yield

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen on bound sockets; uvicorn's own way of it would serve whatever connects, one after the other."""
        await self.lifespan.startup()
        self.servers: list[asyncio.Server] = []
        loop = asyncio.get_running_loop()
        self._gates = [Gate(each, loop, self._protocol, self.server_state.unverified) for each in sockets or ()]
        self.started = True

    def _protocol(self) -> asyncio.Protocol:
        return HttpProtocol(config=self.config, server_state=self.server_state, app_state=self.lifespan.state)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close what pages have open, and cut what does not close; connections without the token are cut at once."""
        for gate in self._gates:
            gate.close()
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
    )
    return Server(config)
