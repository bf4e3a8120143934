"""The console's web application: the page's files, and one WebSocket per page."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Callable
from dataclasses import dataclass, field

from starlette.applications import Starlette
from starlette.middleware import Middleware
from starlette.routing import Route, WebSocketRoute
from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from fullswarm.operator.console import frames
from fullswarm.operator.console.desk import Desk
from fullswarm.operator.console.frames import MAX_BYTES
from fullswarm.operator.console.gateway import Gateway
from fullswarm.operator.console.guard import Bucket, Guard, Names, same_token
from fullswarm.operator.console.outbox import Outbox
from fullswarm.operator.console.pages import Pages

MOST_CLIENTS = 16
HELLO_S = 3.0
RATE_HZ, BURST = 60.0, 120.0
STALLED_S = 5.0
"""A page that takes nothing for so long is gone, or cannot follow."""

BAD_TOKEN, NO_HELLO, TOO_BIG, TOO_MANY, TOO_SLOW = 4401, 4408, 4413, 4429, 1013


@dataclass(slots=True)
class Web:
    """Everything that the pages talk to.

    Parameters
    ----------
    poke
        Told after each command, because the nodes may have set timers.
    """

    gateway: Gateway
    token: str
    now_s: Callable[[], float]
    poke: Callable[[], None]
    hello_s: float = HELLO_S
    stalled_s: float = STALLED_S
    clients: int = field(default=0, init=False)

    def app(self, names: Names, pages: Pages) -> Starlette:
        """Return the ASGI application."""
        routes = [
            Route("/", pages.serve),
            Route("/page/{name:path}", pages.serve),
            WebSocketRoute("/ws", self.socket),
        ]
        return Starlette(routes=routes, middleware=[Middleware(Guard, names=names)])

    async def socket(self, websocket: WebSocket) -> None:
        """Serve one page from its first frame to its last."""
        await websocket.accept()
        with contextlib.suppress(WebSocketDisconnect):
            hello = await self._greeting(websocket)
            if hello is None:
                return
            # Counted only now: a client without the token must not be able to use up the connections.
            if self.clients >= MOST_CLIENTS:
                await _close(websocket, TOO_MANY, "too many pages are open")
                return
            websocket.state.admission.leave()
            self.clients += 1
            try:
                await self._serve(websocket, hello)
            finally:
                self.clients -= 1

    async def _greeting(self, websocket: WebSocket) -> frames.Hello | None:
        try:
            text = await asyncio.wait_for(_receive(websocket), self.hello_s)
        except TimeoutError:
            await _close(websocket, NO_HELLO, "no hello")
            return None
        hello = frames.read_hello(text) if len(text) <= MAX_BYTES else None
        if hello is None or not same_token(hello.token, self.token):
            await _close(websocket, BAD_TOKEN, "token" if hello else "hello")
            return None
        return hello

    async def _serve(self, websocket: WebSocket, hello: frames.Hello) -> None:
        outbox = Outbox(self.now_s)
        desk = self.gateway.join(hello.session, hello.name, outbox)
        self.poke()
        tasks = {
            asyncio.create_task(outbox.run(websocket.send_text)),
            asyncio.create_task(self._listen(websocket, desk, outbox)),
            asyncio.create_task(self._stalls(outbox)),
        }
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            # Before anything is awaited: a page that is gone must not drive on.
            self.gateway.leave(desk, outbox)
            self.poke()
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
        if outbox.overrun:
            await _close(websocket, TOO_SLOW, "this page cannot follow")
        ended = websocket.application_state is not WebSocketState.CONNECTED
        for result in results:
            # Sending what was still in the box after the closing is no fault of anybody's.
            if isinstance(result, Exception) and not isinstance(result, WebSocketDisconnect) and not ended:
                raise result

    async def _listen(self, websocket: WebSocket, desk: Desk, outbox: Outbox) -> None:
        """Answer a page's frames until it goes, or has to."""
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
            answer = command if isinstance(command, frames.Answer) else desk.handle(command, outbox)
            outbox.put("answer", answer.encoded())
            self.poke()

    async def _stalls(self, outbox: Outbox) -> None:
        """Return when the page has taken nothing for too long."""
        while outbox.sending_s is None or self.now_s() - outbox.sending_s < self.stalled_s:
            await asyncio.sleep(self.stalled_s / 5.0)


async def _receive(websocket: WebSocket) -> str | bytes:
    """Return the next frame as it came.

    Raises
    ------
    WebSocketDisconnect
        There is none: the page has gone.
    """
    message = await websocket.receive()
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1005))
    text = message.get("text")
    data: str | bytes = message["bytes"] if text is None else text
    return data


async def _close(websocket: WebSocket, code: int, reason: str) -> None:
    if websocket.application_state is WebSocketState.CONNECTED:
        with contextlib.suppress(WebSocketDisconnect, RuntimeError):  # it was quicker
            await websocket.close(code, reason)
