"""What a command prints, reads and returns: data on stdout, progress on stderr, polled stdin, an exit code."""

from __future__ import annotations

import json
import os
import select
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import typer

from fullswarm.errors import FullswarmError

if TYPE_CHECKING:  # imported in the functions that draw: a shell completion draws nothing
    from rich.console import RenderableType
    from rich.table import Table

INTERRUPTED = 130
BUG = 70
"""``EX_SOFTWARE`` of sysexits.h: not the user's fault."""


def data(text: str) -> None:
    """Print a line of results."""
    typer.echo(text)


def data_json(value: object, *, indent: int | None = 2) -> None:
    """Print results for programs; without `indent` in one line."""
    typer.echo(json.dumps(value, indent=indent, allow_nan=False, ensure_ascii=False))


def data_table(table: RenderableType, into_file: int = 80) -> None:
    """Print results for people, at the width of the terminal, or `into_file` columns into a file."""
    from rich.console import Console

    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = into_file
    console.print(table)


def plain_table(*columns: str, numbers: Sequence[str] = ()) -> Table:
    """Return a table without lines whose long cells are wrapped; columns of `numbers` are to the right and never are.

    Cells are rich markup, so escape other texts.
    """
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for name in columns:
        table.add_column(name, overflow="fold")
    for name in numbers:
        table.add_column(name, justify="right", no_wrap=True, min_width=len(name))
    return table


def progress(text: str) -> None:
    """Print what is going on."""
    typer.echo(text, err=True)


def log_to_stderr(*, warnings_only: bool = False) -> None:
    """Send log lines to stderr: structlog's default is stdout, which is for data."""
    import logging

    import structlog

    # Looked up at each line: a redirected stderr, a test's for one, may be closed again.
    structlog.configure(
        logger_factory=lambda *_: structlog.PrintLogger(sys.stderr),
        wrapper_class=structlog.make_filtering_bound_logger(logging.WARNING if warnings_only else logging.NOTSET),
    )


def quiet() -> None:
    """Log nothing, unless the program has set its log up: for a library whose errors are raised."""
    import logging

    import structlog

    if not structlog.is_configured():
        structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))


# ---------------------------------------------------------------- errors and exit codes
def run_guarded(call: Callable[[], int | None], debug: bool = False) -> int:
    """Run a command and return its exit code (None counts as 0); an error becomes one line on stderr.

    With `debug` errors are raised as they are, with their traceback. ``typer.Exit``, ``typer.Abort``,
    ``typer.BadParameter`` and ``SystemExit`` pass through, so whole applications may be wrapped too.
    """
    try:
        return call() or 0
    except (typer.Exit, typer.Abort, typer.BadParameter):
        raise
    except KeyboardInterrupt:
        progress("interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our stdout has had enough (`| head`); Python must not complain again at its own exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except FullswarmError as error:
        if debug:
            raise
        text = str(error)
        progress(f"error: {text}" if "\n" not in text else f"error: {text.count(chr(10)) + 1} things are wrong\n{text}")
        return error.exit_code
    except Exception as error:
        if debug:
            raise
        progress(f"error: {type(error).__name__}: {error} (a bug in fullswarm; --debug shows where)")
        return BUG


# ---------------------------------------------------------------- input
class TypedLines:
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
        if sys.platform == "win32":  # there a process in the background may read
            return False
        return os.isatty(self._descriptor) and os.tcgetpgrp(self._descriptor) != os.getpgrp()
