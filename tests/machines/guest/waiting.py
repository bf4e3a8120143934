"""Waiting for what the kernel or another process does, with a deadline."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable
from types import TracebackType
from typing import NoReturn, Self

from fullswarm.cli.main import main

DEADLINE_S = 20.0
"""For one event, in the guest's own time, in which its processor is always equally fast."""


def until(condition: Callable[[], bool], what: str, deadline_s: float = DEADLINE_S) -> float:
    """Wait for a condition; return how long it took, in seconds.

    Raises
    ------
    TimeoutError
        It did not come; `what` says what.
    """
    began_s = time.monotonic()
    while not condition():
        if time.monotonic() - began_s > deadline_s:
            raise TimeoutError(f"waited {deadline_s:.0f} s for: {what}")
        time.sleep(0.01)
    return time.monotonic() - began_s


class Command:
    """A ``fullswarm`` command that runs; its two outputs come together, line by line.

    A fork of this interpreter, which has loaded most of what a command needs: to start another one takes an emulated
    processor ten seconds. No thread of ours may run at that moment.
    """

    def __init__(self, *arguments: str) -> None:
        self._out, theirs = os.pipe()
        self._pid = os.fork()
        if self._pid == 0:
            _become(arguments, theirs)
        os.close(theirs)
        os.set_blocking(self._out, False)
        self._code: int | None = None
        self.said = ""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._ended() is None:
            os.kill(self._pid, signal.SIGKILL)
            self.ends()
        os.close(self._out)

    def says(self, condition: Callable[[str], bool], what: str) -> str:
        """Wait for a line; return it. Lines before it are passed over."""
        found: list[str] = []

        def heard() -> bool:
            self._listen()
            while not found and "\n" in self.said:
                line, _, self.said = self.said.partition("\n")
                if condition(line):
                    found.append(line)
            if not found and self._ended() is not None:
                raise EOFError(f"waited for: {what}; the command has ended with {self._code}: {self.said}")
            return bool(found)

        until(heard, what)
        return found[0]

    def interrupt(self) -> int:
        """Press Ctrl-C; return the exit code."""
        os.kill(self._pid, signal.SIGINT)
        return self.ends()

    def ends(self) -> int:
        """Wait for its end; return the exit code."""
        until(lambda: self._ended() is not None, "the command ends")
        self._listen()
        assert self._code is not None
        return self._code

    def _listen(self) -> None:
        with contextlib.suppress(BlockingIOError):
            while piece := os.read(self._out, 65536):
                self.said += piece.decode(errors="replace")

    def _ended(self) -> int | None:
        if self._code is None:
            pid, status = os.waitpid(self._pid, os.WNOHANG)
            self._code = os.waitstatus_to_exitcode(status) if pid else None
        return self._code


def _become(arguments: tuple[str, ...], out: int) -> NoReturn:
    """Be the command, in the child."""
    code = 70
    try:
        os.dup2(out, 1)
        os.dup2(out, 2)
        sys.stdout = open(1, "w", buffering=1, closefd=False)  # noqa: SIM115  (lives as long as the process)
        sys.stderr = open(2, "w", buffering=1, closefd=False)  # noqa: SIM115
        sys.argv = ["fullswarm", *arguments]
        main()
        code = 0
    except SystemExit as exit_:
        code = exit_.code if isinstance(exit_.code, int) else int(exit_.code is not None)
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)


def run(*arguments: str) -> tuple[int, str]:
    """Run a ``fullswarm`` command to its end; return its exit code and what it said."""
    with Command(*arguments) as command:
        return command.ends(), command.said
