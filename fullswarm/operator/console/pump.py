"""Serves a runtime from an asyncio loop: the nodes' handlers and timers run on the loop's thread, and on no other."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from fullswarm.runtime import Runtime


class Pump:
    """Calls :meth:`Runtime.serve_due` whenever a message has come or a timer is due.

    Parameters
    ----------
    on_error
        Told what a node raised; nothing is served after that.
    """

    def __init__(
        self, runtime: Runtime, loop: asyncio.AbstractEventLoop, on_error: Callable[[BaseException], None]
    ) -> None:
        self._runtime, self._loop, self._on_error = runtime, loop, on_error
        self._called = self._closed = False
        self._timer: asyncio.TimerHandle | None = None
        runtime.mailbox.on_put = self._wake

    def poke(self) -> None:
        """Serve soon: a timer was set on the loop."""
        if not self._called and not self._closed:
            self._called = True
            self._loop.call_soon(self._serve)

    def close(self) -> None:
        """Serve no more."""
        self._closed = True
        self._runtime.mailbox.on_put = None
        if self._timer is not None:
            self._timer.cancel()

    def _wake(self) -> None:
        """Have the loop serve what was put; called on any thread, and once for many messages."""
        if not self._called and not self._closed:
            self._called = True
            self._loop.call_soon_threadsafe(self._serve)

    def _serve(self) -> None:
        self._called = False  # first: what is put from here on must call again
        if self._timer is not None:
            self._timer.cancel()
        if self._closed:
            return
        try:
            wait_s = self._runtime.serve_due()
        except BaseException as error:  # any kind: it must end the process as it would on the runtime's own loop
            self.close()
            self._on_error(error)
            return
        self._timer = self._loop.call_later(wait_s, self._serve)
