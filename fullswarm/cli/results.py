"""`fullswarm results`: look at, compare, export and report what an experiment left in a folder."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from fullswarm.cli.operate import run_guarded

results_app = typer.Typer(no_args_is_help=True)

Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="The results folder (--out of the experiment).")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document.")]
Debug = Annotated[bool, typer.Option("--debug", help="Show where an error comes from.")]


def _run(debug: bool, command: Callable[[], int]) -> None:
    raise typer.Exit(run_guarded(command, debug))


@results_app.command("list")
def list_cells(
    folder: Annotated[Path, typer.Argument(metavar="[FOLDER]", help="The results folder; else this one.")] = Path(),
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """List the cells of a results folder with counts."""

    def command() -> int:
        from fullswarm.evaluate.results import commands as results

        return results.list_cells(folder, as_json)

    _run(debug, command)


@results_app.command()
def show(
    folder: Folder,
    what: Annotated[str, typer.Argument(metavar="ID|FILTER", help="A trial's id, or 'scenario=concave,robots=32'.")],
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Show all figures of one trial, or of a cell: means with intervals."""

    def command() -> int:
        from fullswarm.evaluate.results import commands as results

        return results.show(folder, what, as_json)

    _run(debug, command)


@results_app.command()
def export(
    folder: Folder,
    form: Annotated[str, typer.Option("--format", metavar="csv|xlsx|parquet|mat", help="The kind of file.")] = "csv",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Where to; else results.FORMAT in the folder.")
    ] = None,
    long: Annotated[bool, typer.Option("--long", help="A row per trial and quantity instead of per trial.")] = False,
    debug: Debug = False,
) -> None:
    """Write all figures of all trials as a table; prints the file's name."""

    def command() -> int:
        from fullswarm.evaluate.results import commands as results

        return results.export(folder, form, out, long)

    _run(debug, command)


@results_app.command("map")
def coverage(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="An experiment's, or one trial's.")],
    trial: Annotated[str, typer.Option("--trial", metavar="ID", help="Which one: how its id begins.")] = "",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="Where to; else coverage.pgm in the trial's folder.")
    ] = None,
    debug: Debug = False,
) -> None:
    """Write what a trial's robots have covered as a map: PGM and YAML, as ROS's map_server reads them."""

    def command() -> int:
        from fullswarm.evaluate.results import coverage_map as results_map

        return results_map.write(folder, trial, out)

    _run(debug, command)


@results_app.command()
def compare(
    words: Annotated[
        list[str], typer.Argument(metavar="A B | FOLDER A B", help="Two folders; with --by: a folder and two values.")
    ],
    by: Annotated[
        str | None, typer.Option("--by", metavar="FIELD", help="Compare within a folder: behaviour, engine, limits, …")
    ] = None,
    cells: Annotated[bool, typer.Option("--cells", help="Also each cell by itself.")] = False,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Compare trials in pairs of the same seed: differences B - A with intervals, effect sizes, tests."""

    def command() -> int:
        from fullswarm.evaluate.results import commands as results

        return results.compare(words, by, cells, as_json)

    _run(debug, command)


@results_app.command()
def report(
    folder: Folder,
    open_it: Annotated[bool, typer.Option("--open", help="Open it in the browser.")] = False,
    plots: Annotated[
        Path | None, typer.Option("--plots", metavar="DIR", help="Also write plots (SVG) and tables (Markdown) there.")
    ] = None,
    debug: Debug = False,
) -> None:
    """Write report.html, one self-contained file, into the folder; prints its name."""

    def command() -> int:
        from fullswarm.evaluate.results import commands as results

        return results.report(folder, open_it, plots)

    _run(debug, command)


@results_app.command()
def index(folder: Folder, as_json: AsJson = False, debug: Debug = False) -> None:
    """Make the SQLite index anew from the trials' directories. Exit code 1: some cannot be read."""

    def command() -> int:
        from fullswarm.evaluate.results import commands as results

        return results.index(folder, as_json)

    _run(debug, command)
