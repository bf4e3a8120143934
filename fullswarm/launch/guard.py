"""Turns what a command raises into one line for people and an exit code for programs."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable

import typer

from fullswarm.errors import FullswarmError

INTERRUPTED = 130
BUG = 70
"""``EX_SOFTWARE`` of sysexits.h: not the user's fault."""


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
        _say("interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        # The reader of our stdout has had enough (`| head`); Python must not complain again at its own exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except FullswarmError as error:
        if debug:
            raise
        text = str(error)
        _say(f"error: {text}" if "\n" not in text else f"error: {text.count(chr(10)) + 1} things are wrong\n{text}")
        return error.exit_code
    except Exception as error:
        if debug:
            raise
        _say(f"error: {type(error).__name__}: {error} (a bug in fullswarm; --debug shows where)")
        return BUG


def _say(text: str) -> None:
    typer.echo(text, err=True)
