"""What waits for one page: bounded, so that a slow one costs the others nothing."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable

NEWEST_WINS = frozenset({"state", "fleet", "filter", "goals", "coverage", "obstacles", "leases", "world", "stop"})
"""Frames that say all there is to say: a page that was busy needs only the last one."""
LONGEST = 1024
"""Other frames that may wait; a page that is further behind cannot follow any more."""


class Outbox:
    """Frames for one page, from the nodes' callbacks to the task that sends.

    Attributes
    ----------
    overrun : the page cannot follow, nothing more is kept for it
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
        if kind in NEWEST_WINS:
            self._newest[kind] = text
        elif len(self._queue) < LONGEST:
            self._queue.append(text)
        else:
            self.overrun = True
            self._queue.clear()
            self._newest.clear()
        self._wake.set()

    async def run(self, send: Callable[[str], Awaitable[None]]) -> None:
        """Send until the page cannot follow."""
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
