"""What a command prints, reads and returns: data on stdout, progress on stderr, polled stdin, an exit code."""

from __future__ import annotations

import contextlib
import json
import os
import select
import shutil
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, ClassVar, TextIO

import typer

from fullswarm.clock import Clock, MonotonicClock
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
    Progress.clear()
    typer.echo(text, err=True)


class Progress:
    """Shows on stderr how far a long piece of work is: one line that is written over on a terminal, lines in a pipe.

    In a pipe the first line comes within two seconds and then one each five at most, as often as :meth:`at` or
    :meth:`tick` is called; work that is over before prints none.

    Parameters
    ----------
    what : the parts, in the plural: "trials"
    of : how many there are; None: unknown
    at_once : print a line at the first call already: the next one may come only when a long part is done
    """

    FIRST_S, NEXT_S, REDRAW_S = 1.5, 5.0, 0.1
    BAR = 24
    _drawn: ClassVar[Progress | None] = None
    """The one whose line stands on the terminal: what is printed between takes its place."""

    def __init__(
        self, what: str, of: int | None = None, *, clock: Clock | None = None, stream: TextIO | None = None,
        at_once: bool = False,
    ) -> None:  # fmt: skip
        self._what, self._of = what, of
        self._clock = clock or MonotonicClock()
        self._stream = stream or sys.stderr
        self._live = self._stream.isatty() and os.environ.get("TERM") != "dumb"
        self._began_s = self._clock.now_s()
        self._due_s = self._began_s + (0.0 if at_once or self._live else self.FIRST_S)
        self._done, self._note, self._shown = 0, "", ""
        self._left_s: float | None = None

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def at(self, done: int, note: str = "", left_s: float | None = None) -> None:
        """Take that `done` parts are done; `note` follows the count; without `left_s` what is left is estimated."""
        self._done, self._note, self._left_s = done, note, left_s
        self.tick(force=done == self._of and bool(self._shown))

    def parts(self, done: int, of: int, note: str = "", left_s: float | None = None) -> None:
        """Take that `done` of `of` parts are done."""
        self._of = of
        self.at(done, note, left_s)

    def tick(self, *, force: bool = False) -> None:
        """Show the state if it is time to, also when nothing has changed."""
        now_s = self._clock.now_s()
        if now_s < self._due_s and not force:
            return
        self._due_s = now_s + (self.REDRAW_S if self._live else self.NEXT_S)
        text = self._text(now_s - self._began_s)
        if self._live:
            self._draw(text, now_s)
        elif text != self._shown or not force:
            self.write(f"{text}\n")
        self._shown = text

    def say(self, text: str) -> None:
        """Print a line of its own between."""
        Progress.clear()
        self.write(f"{text}\n")

    def close(self) -> None:
        """End the live line; what is printed next begins a line of its own."""
        if Progress._drawn is self:
            self.write("\n")
            Progress._drawn = None

    @staticmethod
    def clear() -> None:
        """Take the live line off the terminal; it is drawn again at the next call of its :class:`Progress`."""
        drawn, Progress._drawn = Progress._drawn, None
        if drawn is not None:
            drawn.write("\r\x1b[K")

    def _text(self, took_s: float) -> str:
        count = f"{self._done} of {self._of} {self._what}" if self._of is not None else f"{self._done} {self._what}"
        note = f", {self._note}" if self._note else ""
        left_s = self._left_s
        if left_s is None and self._of and self._done:
            left_s = took_s / self._done * (self._of - self._done)
        return (
            f"{count}{note}, {duration(took_s)}" if left_s is None else f"{count}{note}, about {duration(left_s)} left"
        )

    def _draw(self, text: str, now_s: float) -> None:
        columns = shutil.get_terminal_size().columns
        full = self.BAR * self._done // self._of if self._of else int(now_s * 4) % self.BAR
        bar = "#" * full + "." * (self.BAR - full) if self._of else "." * full + "#" + "." * (self.BAR - full - 1)
        self.write("\r\x1b[K" + f"[{bar}] {text}"[: columns - 1])
        Progress._drawn = self

    def write(self, text: str) -> None:
        """Write to its stream."""
        with contextlib.suppress(OSError, ValueError):  # who reads it has gone: the work goes on
            self._stream.write(text)
            self._stream.flush()


def duration(seconds: float) -> str:
    """Return a time in its two largest units: ``40 s``, ``12 min``, ``3 h 20 min``."""
    if seconds < 100.0:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60.0)
    return f"{minutes} min" if minutes < 120 else f"{minutes // 60} h {minutes % 60} min"


def one_line(text: str) -> str:
    """Return a text from the network or a log for a terminal: in one line, without control characters."""
    return "".join(each if each.isprintable() else " " for each in text)


def warning(text: str) -> None:
    """Print one line about what is odd, but not wrong."""
    Progress.clear()
    typer.echo(f"warning: {text}", err=True)


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
