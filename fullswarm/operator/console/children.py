"""Starts processes that work for pages behind all else on this machine, and ends them with all that they started."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from typing import IO

NICENESS = 10
TAIL_BYTES = 4096


def start(arguments: Sequence[str], log: IO[bytes]) -> subprocess.Popen[bytes]:
    """Start ``fullswarm ARGUMENTS`` with low priority and no input; its stderr goes into `log`.

    It has a session of its own: Ctrl-C in the console's terminal does not reach it, :func:`end` does.

    Raises
    ------
    OSError
        It cannot be started.
    """
    nice = ["nice", "-n", str(NICENESS)] if shutil.which("nice") else []
    return subprocess.Popen(  # noqa: S603  (no shell; the parts are our own, or an id that a list has)
        [*nice, sys.executable, "-m", "fullswarm", *arguments],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=log, start_new_session=True,
    )  # fmt: skip


def interrupt(process: subprocess.Popen[bytes]) -> None:
    """Have it end as by Ctrl-C on a shell; where there is no such signal, at once."""
    with contextlib.suppress(OSError):
        if os.name == "posix":
            process.send_signal(signal.SIGINT)
        else:
            process.terminate()


def end(process: subprocess.Popen[bytes]) -> None:
    """End it at once, with what it has started in its session."""
    if process.poll() is None:
        with contextlib.suppress(OSError):
            if os.name == "posix":
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
        process.wait()


def last_line(log: IO[bytes]) -> str:
    """Return the last line that a process has written, without the word "error"; empty: none."""
    lines = tail(log).decode(errors="replace").strip().splitlines()
    return lines[-1].removeprefix("error: ") if lines else ""


def tail(log: IO[bytes]) -> bytes:
    """Return the end of what a process has written."""
    size = log.seek(0, os.SEEK_END)
    log.seek(max(0, size - TAIL_BYTES))
    return log.read()
