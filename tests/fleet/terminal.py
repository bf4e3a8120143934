"""A program in a terminal of its own, as an operator has it before him."""

from __future__ import annotations

import os
import pty
import select
import signal
import time
from collections.abc import Mapping, Sequence
from typing import Self


class Terminal:
    """Starts a program; a context manager that ends it."""

    def __init__(self, command: Sequence[str], environment: Mapping[str, str]) -> None:
        self._pid, self._screen = pty.fork()
        if not self._pid:
            os.execvpe(command[0], list(command), environment)
        self._said = b""
        self._code: int | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._code is None:
            os.kill(self._pid, signal.SIGKILL)
            os.waitpid(self._pid, 0)
        os.close(self._screen)

    def type(self, line: str) -> None:
        """Type a line and press return."""
        os.write(self._screen, f"{line}\r".encode())

    def expect(self, text: str, within_s: float) -> None:
        """Wait for a text on the screen; what came until then counts as read."""
        limit_s = time.monotonic() + within_s
        while text.encode() not in self._said:
            left_s = limit_s - time.monotonic()
            assert left_s > 0.0, f"waited for {text!r}; on the screen: {self._said.decode(errors='replace')}"
            if select.select([self._screen], [], [], left_s)[0]:
                self._said += self._read()
        self._said = self._said.partition(text.encode())[2]

    def wait(self, within_s: float) -> int:
        """Wait for the program's end; return its exit code."""
        limit_s = time.monotonic() + within_s
        while self._code is None:
            assert time.monotonic() < limit_s, f"it goes on; on the screen: {self._said.decode(errors='replace')}"
            if select.select([self._screen], [], [], 0.1)[0]:
                self._said += self._read()
            pid, status = os.waitpid(self._pid, os.WNOHANG)
            if pid:
                self._code = os.waitstatus_to_exitcode(status)
        return self._code

    def _read(self) -> bytes:
        try:
            return os.read(self._screen, 65536)
        except OSError:  # the other end is closed: it has ended
            return b""
