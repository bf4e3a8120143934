"""Lines from a terminal or a pipe: polled by a timer, never waited for."""

from __future__ import annotations

import os
import select


class Typed:
    """Reads a descriptor line by line without blocking.

    Parameters
    ----------
    descriptor
        By default standard input. One that is not open counts as ended.
    """

    def __init__(self, descriptor: int = 0) -> None:
        self._descriptor = descriptor
        self._begun = b""
        self._waiting: list[str] = []
        self.ended = False

    def line(self) -> str | None:
        """Return the next whole line without its end; None when there is none now."""
        if not self._waiting and not self.ended:
            self._read()
        return self._waiting.pop(0) if self._waiting else None

    def _read(self) -> None:
        try:
            if self._in_background() or not select.select([self._descriptor], [], [], 0.0)[0]:
                return
            data = os.read(self._descriptor, 4096)
        except (OSError, ValueError):
            data = b""
        self.ended = not data
        *lines, self._begun = (self._begun + (data or b"\n" * bool(self._begun))).split(b"\n")
        self._waiting += [each.decode(errors="replace").strip() for each in lines]

    def _in_background(self) -> bool:
        """Tell whether reading would stop the process: the terminal belongs to another one."""
        return os.isatty(self._descriptor) and os.tcgetpgrp(self._descriptor) != os.getpgrp()
