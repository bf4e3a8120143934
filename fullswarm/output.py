"""stdout is data, stderr is progress."""

from __future__ import annotations

import json
import sys

import typer
from rich.console import Console, RenderableType


def data(text: str) -> None:
    """Print a line of results."""
    typer.echo(text)


def data_json(value: object) -> None:
    """Print results for programs."""
    typer.echo(json.dumps(value, indent=2, allow_nan=False, ensure_ascii=False))


def data_table(table: RenderableType, into_file: int = 80) -> None:
    """Print results for people, at the width of the terminal, or `into_file` columns into a file."""
    console = Console(highlight=False)
    if not console.is_terminal:
        console.width = into_file
    console.print(table)


def progress(text: str) -> None:
    """Tell what is going on."""
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
