"""Serves the application with uvicorn and bounds the connections that have not sent the token.

Anybody who reaches the port can open connections and send nothing, or half a request. Each connection is unverified
until its page has sent the right hello. Unverified connections have a small pool of their own, in which the oldest
makes room for the newest: they cannot use up what operators need, and an operator who connects is always let in.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterator
from typing import TYPE_CHECKING

import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState

from fullswarm.operator.console.frames import MAX_BYTES

if TYPE_CHECKING:
    from starlette.applications import Starlette

MOST_UNVERIFIED = 128
"""A browser that loads the page has about six."""
HEADER_S = 3.0
"""So long for the first complete request of a connection."""
ACCEPTS = 64
"""Connections taken per turn of the loop: with the pool they stay far below 1024 open files, a common limit."""
BACKLOG = 4096
"""Connections that the system keeps waiting; beyond it a browser tries again only after 1 s."""
END_S = 0.4
"""So long may pages take to answer the closing; then their connections are cut."""


class Admission:
    """One connection in the pool, from its opening until it sends the token or ends."""

    def __init__(self, pool: Unverified, transport: asyncio.Transport, loop: asyncio.AbstractEventLoop) -> None:
        self._pool, self._transport = pool, transport
        self._timer = loop.call_later(pool.header_s, self.cut)

    def requested(self) -> None:
        """Note that a complete request came: those that sent none make room first."""
        self._timer.cancel()
        self._pool.requested(self)

    def leave(self) -> None:
        """Leave the pool: the page sent the token, or the connection ended."""
        self._timer.cancel()
        self._pool.remove(self)

    def cut(self) -> None:
        """End the connection at once, whatever still waits to be sent."""
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
        """Take a new connection; the oldest without a complete request, else the oldest, makes room for it."""
        while len(self) >= MOST_UNVERIFIED:
            next(iter(self._silent or self._requested)).cut()
        admission = Admission(self, transport, loop)
        self._silent[admission] = None
        return admission

    def requested(self, admission: Admission) -> None:
        """Put a connection behind the others that sent a complete request."""
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
