"""Shows a supervisor that the loop of each of its processes runs: a byte on a pipe, four times a second.

A process that is stopped, or whose loop hangs, writes none, although the system still lists it as running. Only the
loop itself writes: a thread of its own would go on while the loop that drives the wheels hangs.
"""

from __future__ import annotations

import os
from contextlib import suppress

from fullswarm.runtime import Scheduler

ALIVE = "FULLSWARM_ALIVE_FD"
"""Environment variable with the number of the pipe's file descriptor, set by the supervisor."""
PERIOD_S = 0.25
_AT_ONCE = 4096


def report_alive(scheduler: Scheduler) -> None:
    """Write to the supervisor's pipe from the loop of `scheduler`, if there is a pipe."""
    text = os.environ.pop(ALIVE, "")
    if not text.isdecimal():
        return
    descriptor = int(text)
    os.set_inheritable(descriptor, False)  # a child that held it would keep this process "alive"
    os.set_blocking(descriptor, False)

    def write() -> None:
        with suppress(OSError):  # full or without a reader: a supervisor that is stopped must not stop robots
            os.write(descriptor, b".")

    scheduler.every(PERIOD_S, write, first_s=0.0)


class AlivePipe:
    """The supervisor's end of the pipe of one process.

    Attributes
    ----------
    inherited : file descriptor for the process to write to; close it here once the process has it
    seen : whether anything was written so far
    """

    def __init__(self) -> None:
        self._reading, self.inherited = os.pipe()
        os.set_blocking(self._reading, False)
        self.seen = False

    def close_inherited(self) -> None:
        """Close the end that the process has now."""
        if self.inherited >= 0:
            os.close(self.inherited)
            self.inherited = -1

    def read(self) -> bool:
        """Return whether anything was written since the last call."""
        try:
            wrote = bool(os.read(self._reading, _AT_ONCE))
        except BlockingIOError:
            wrote = False
        self.seen |= wrote
        return wrote

    def close(self) -> None:
        """Close both ends. Closing twice is fine."""
        self.close_inherited()
        if self._reading >= 0:
            os.close(self._reading)
            self._reading = -1
