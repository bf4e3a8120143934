"""The console's web application: the page's files, one WebSocket per page, and the frames that wait for it."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.requests import Request
from starlette.responses import FileResponse, PlainTextResponse, Response
from starlette.routing import BaseRoute, Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from fullswarm.operator.console import frames
from fullswarm.operator.console.access import Bucket, Guard, Names
from fullswarm.operator.console.clips import Download
from fullswarm.operator.console.frames import MAX_BYTES
from fullswarm.operator.console.sessions import Listener
from fullswarm.operator.console.tokens import RENEW_S, Admitted, Doorkeeper, Role
from fullswarm.operator.console.underlay import Underlay

MOST_CLIENTS = 16
HELLO_S = 3.0
RATE_HZ, BURST = 60.0, 120.0
CHECK_S = 0.5
"""How often it is checked that the token of an open page still counts."""
STALLED_S = 5.0
"""A page that takes nothing for this long is closed, or too slow."""

BAD_TOKEN, NO_HELLO, TOO_BIG, TOO_MANY, TOO_SLOW = 4401, 4408, 4413, 4429, 1013


class PageSession(Protocol):
    """Carries out the frames of a page."""

    def handle(self, command: frames.Command, listener: Listener) -> frames.Answer:
        """Carry out a frame that came by `listener`."""
        ...


S = TypeVar("S", bound=PageSession)


class PageSource(Protocol[S]):
    """What pages are connected to: the gateway of a live swarm, or a recording."""

    def join(self, key: str, name: str, listener: Listener, *, named: bool = False, role: Role = "operator") -> S:
        """Add a page; see :meth:`fullswarm.operator.console.gateway.Gateway.join`."""
        ...

    def leave(self, session: S, listener: Listener) -> None:
        """Remove a page."""
        ...

    def download(self, key: str) -> Download | None:
        """Return a file by the key that a page got; None: there is none."""
        ...

    def close(self) -> None:
        """End all that it does for pages."""
        ...


@dataclass(slots=True)
class Web:
    """Serves the pages: their files and their WebSockets.

    Parameters
    ----------
    wake
        Called after each command, because the nodes may have set timers.
    underlay
        What pages draw under the map; None: nothing.
    """

    gateway: PageSource[Any]
    doorkeeper: Doorkeeper
    now_s: Callable[[], float]
    wake: Callable[[], None]
    underlay: Underlay | None = None
    hello_s: float = HELLO_S
    stalled_s: float = STALLED_S
    clients: int = field(default=0, init=False)

    def app(self, names: Names, pages: Pages, *more: BaseRoute) -> Starlette:
        """Return the ASGI application, with `more` of what others serve."""
        routes = [
            Route("/", pages.serve),
            Route("/page/{name:path}", pages.serve),
            Route("/clip/{key}", self.clip),
            WebSocketRoute("/ws", self.socket),
            *(() if self.underlay is None else (self.underlay.route(),)),
            *more,
        ]
        return Starlette(routes=routes, middleware=[Middleware(Guard, names=names)])

    async def clip(self, request: Request) -> Response:
        """Answer a request for a clip; its key is a secret that only the page has that asked for it."""
        found = self.gateway.download(request.path_params["key"])
        if found is None:
            return PlainTextResponse("this clip is gone: make it again", 404)
        return FileResponse(found.file, filename=found.name, headers={"Cache-Control": "no-store"})

    async def socket(self, websocket: WebSocket) -> None:
        """Serve one page until it is closed."""
        await websocket.accept()
        with contextlib.suppress(WebSocketDisconnect):
            greeting = await self._greeting(websocket)
            if greeting is None:
                return
            # Counted only now: a client without the token must not use up the connections.
            if self.clients >= MOST_CLIENTS:
                await _close(websocket, TOO_MANY, "too many pages are open")
                return
            websocket.state.admission.leave()
            self.clients += 1
            try:
                await self._serve(websocket, *greeting)
            finally:
                self.clients -= 1

    async def _greeting(self, websocket: WebSocket) -> tuple[frames.Hello, Admitted] | None:
        try:
            text = await asyncio.wait_for(_receive(websocket), self.hello_s)
        except TimeoutError:
            await _close(websocket, NO_HELLO, "no hello")
            return None
        hello = frames.read_hello(text) if len(text) <= MAX_BYTES else None
        admitted = self.doorkeeper.admit(hello.token) if hello is not None else None
        if hello is None or admitted is None:
            await _close(websocket, BAD_TOKEN, "token" if hello else "hello")
            return None
        return hello, admitted

    async def _serve(self, websocket: WebSocket, hello: frames.Hello, admitted: Admitted) -> None:
        outbox = Outbox(self.now_s)
        name = admitted.name or hello.name
        session = self.gateway.join(hello.session, name, outbox, named=bool(admitted.name), role=admitted.role)
        if self.underlay is not None:
            outbox.put("underlay", frames.encode(self.underlay.frame()))
        self.wake()
        tasks = {
            asyncio.create_task(outbox.run(websocket.send_text)),
            asyncio.create_task(self._listen(websocket, session, outbox)),
            asyncio.create_task(self._stalls(outbox)),
            asyncio.create_task(self._stays(websocket, admitted, outbox)),
        }
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            # Before anything is awaited: a page that is closed must not drive on.
            self.gateway.leave(session, outbox)
            self.wake()
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
        if outbox.overrun:
            await _close(websocket, TOO_SLOW, "this page is too slow")
        ended = websocket.application_state is not WebSocketState.CONNECTED
        for result in results:
            # Sending what still waited after the closing is no error.
            if isinstance(result, Exception) and not isinstance(result, WebSocketDisconnect) and not ended:
                raise result

    async def _listen(self, websocket: WebSocket, session: PageSession, outbox: Outbox) -> None:
        """Answer a page's frames until it is closed or exceeds a limit."""
        bucket = Bucket(RATE_HZ, BURST)
        while True:
            text = await _receive(websocket)
            if len(text) > MAX_BYTES:
                await _close(websocket, TOO_BIG, "a frame too big")
                return
            if not bucket.take(self.now_s()):
                await _close(websocket, TOO_MANY, "too many frames")
                return
            command = frames.read_command(text)
            answer = command if isinstance(command, frames.Answer) else session.handle(command, outbox)
            outbox.put("answer", answer.encoded())
            self.wake()

    async def _stays(self, websocket: WebSocket, admitted: Admitted, outbox: Outbox) -> None:
        """Give the page a pass, and a new one in time; close it when its token has ended."""
        while True:
            outbox.put("pass", frames.encode({"t": "pass", "token": self.doorkeeper.issue(admitted)}))
            until_s = self.now_s() + RENEW_S
            while self.now_s() < until_s:
                if not self.doorkeeper.holds(admitted):
                    await _close(websocket, BAD_TOKEN, "token")
                    return
                await asyncio.sleep(CHECK_S)

    async def _stalls(self, outbox: Outbox) -> None:
        """Return when the page has taken nothing for too long."""
        while outbox.sending_s is None or self.now_s() - outbox.sending_s < self.stalled_s:
            await asyncio.sleep(self.stalled_s / 5.0)


async def _receive(websocket: WebSocket) -> str | bytes:
    """Return the next frame as it came.

    Raises
    ------
    WebSocketDisconnect
        There is none: the page is closed.
    """
    message = await websocket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1005))
    text = message.get("text")
    data: str | bytes = message["bytes"] if text is None else text
    return data


async def _close(websocket: WebSocket, code: int, reason: str) -> None:
    if websocket.application_state is WebSocketState.CONNECTED:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # closed by the page meanwhile
            await websocket.close(code, reason)


# ---------------------------------------------------------------- files
FOLDER = Path(__file__).with_name("page")
INDEX = "index.html"
TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".mjs": "text/javascript; charset=utf-8",
    ".json": "application/json",
    ".svg": "image/svg+xml",
    ".png": "image/png",
    ".ico": "image/x-icon",
    ".txt": "text/plain; charset=utf-8",
    ".webmanifest": "application/manifest+json",
}


@dataclass(frozen=True, slots=True)
class Pages:
    """Serves the files of a folder: only those in it, only of the types of a page."""

    folder: Path = FOLDER

    def find(self, name: str) -> Path | None:
        """Return the file of that name; None when there is none to be served."""
        if "\0" in name:
            return None
        try:
            folder = self.folder.resolve()
            path = (folder / name).resolve()
            return path if path.is_relative_to(folder) and path.suffix in TYPES and path.is_file() else None
        except (OSError, ValueError):  # a name that no file can have
            return None

    async def serve(self, request: Request) -> Response:
        """Answer a request for a file, or with "not modified"."""
        path = self.find(request.path_params.get("name", INDEX))
        if path is None:
            return PlainTextResponse("no such page", 404)
        data = path.read_bytes()
        tag = f'"{hashlib.sha256(data).hexdigest()[:32]}"'
        # Cached by the browser, but revalidated each time: an update of the package must not mix with the old page.
        headers = {"ETag": tag, "Cache-Control": "no-cache"}
        known = {each.strip().removeprefix("W/") for each in request.headers.get("if-none-match", "").split(",")}
        if tag in known:
            return Response(status_code=304, headers=headers)
        return Response(data, media_type=TYPES[path.suffix], headers=headers)


# ---------------------------------------------------------------- frames that wait
NEWEST_WINS = frozenset(
    {"state", "fleet", "filter", "goals", "coverage", "obstacles", "leases", "missions", "world", "stop", "study"}
    | {"history", "timeline", "events", "bookmarks", "undo", "detail", "presence", "offers", "series", "catalogue"}
    | {"experiments", "experiment_list"}
)
"""Frames that are complete: a page that was busy needs only the last one."""
PICTURES, SCANS = "picture ", "scans "
"""How the kinds of pictures and scans begin: of each camera and each robot the newest wins."""
LONGEST = 1024
"""Number of other frames that may wait; a page that is further behind is too slow."""


class Outbox:
    """Frames for one page, from the nodes' callbacks to the task that sends.

    Attributes
    ----------
    overrun : the page is too slow, nothing more is kept for it
    sending_s : since when the present frame waits for the page to take it; None: it is all sent
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self.overrun = False
        self.sending_s: float | None = None
        self._now_s = now_s
        self._queue: deque[str] = deque()
        self._newest: dict[str, str] = {}
        self._wake = asyncio.Event()

    def put(self, kind: str, text: str) -> None:
        """Keep a frame until it can be sent."""
        if self.overrun:
            return
        if kind in NEWEST_WINS or kind.startswith((PICTURES, SCANS)):
            self._newest[kind] = text
        elif len(self._queue) < LONGEST:
            self._queue.append(text)
        else:
            self.overrun = True
            self._queue.clear()
            self._newest.clear()
        self._wake.set()

    async def run(self, send: Callable[[str], Awaitable[None]]) -> None:
        """Send until the page is too slow."""
        while not self.overrun:
            while self._queue and not self.overrun:
                await self._send(send, self._queue.popleft())
            newest, self._newest = self._newest, {}
            for text in newest.values():
                await self._send(send, text)
            if not self._queue and not self._newest and not self.overrun:
                self._wake.clear()
                await self._wake.wait()

    async def _send(self, send: Callable[[str], Awaitable[None]], text: str) -> None:
        self.sending_s = self._now_s()
        await send(text)
        self.sending_s = None
