"""stdout is data, stderr is progress."""

from __future__ import annotations

import json
import sys
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:  # imported in the functions that draw: a shell completion draws nothing
    from rich.console import RenderableType
    from rich.table import Table


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


def plain_table(*columns: str) -> Table:
    """Return a table without lines whose long cells are wrapped; cells are rich markup, so escape other texts."""
    from rich.table import Table

    table = Table(box=None, padding=(0, 2, 0, 0), header_style="bold")
    for name in columns:
        table.add_column(name, overflow="fold")
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
