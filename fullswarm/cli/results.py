"""`fullswarm results`: shows, compares, exports and reports the results of experiments."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fullswarm.cli.options import shell_command

results_app = typer.Typer(no_args_is_help=True)

Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="The results folder (--out of the experiment).")]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON document.")]


@results_app.command("list")
@shell_command()
def list_cells(
    folder: Annotated[
        Path, typer.Argument(metavar="[FOLDER]", help="The results folder (default: this folder).")
    ] = Path(),
    as_json: AsJson = False,
) -> int:
    """List the cells of a results folder with counts."""
    from fullswarm.evaluate.results import commands as results

    return results.list_cells(folder, as_json)


@results_app.command()
@shell_command()
def show(
    folder: Folder,
    what: Annotated[str, typer.Argument(metavar="ID|FILTER", help="A trial's id, or 'scenario=concave,robots=32'.")],
    as_json: AsJson = False,
) -> int:
    """Show all figures of one trial, or of a cell: means with intervals."""
    from fullswarm.evaluate.results import commands as results

    return results.show(folder, what, as_json)


@results_app.command()
@shell_command()
def export(
    folder: Folder,
    form: Annotated[str, typer.Option("--format", metavar="csv|xlsx|parquet|mat", help="The file format.")] = "csv",
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="The file to write (default: results.FORMAT in the folder)."),
    ] = None,
    long: Annotated[bool, typer.Option("--long", help="Write a row per trial and quantity, not per trial.")] = False,
    mlflow: Annotated[
        str | None,
        typer.Option("--mlflow", metavar="URI|DIR", help="Write a run per trial into MLflow instead of a table."),
    ] = None,
) -> int:
    """Write all figures of all trials as a table, and print the file's name; or as runs into MLflow."""
    from fullswarm.evaluate.results import commands as results

    if mlflow is not None:
        return results.export_mlflow(folder, mlflow)
    return results.export(folder, form, out, long)


@results_app.command("map")
@shell_command()
def coverage(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="The folder of an experiment or a trial.")],
    trial: Annotated[str, typer.Option("--trial", metavar="ID", help="The trial, by the start of its id.")] = "",
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE", help="The file to write (default: coverage.pgm in the trial's folder)."),
    ] = None,
) -> int:
    """Write what a trial's robots have covered as a map: PGM and YAML, as ROS's map_server reads them."""
    from fullswarm.evaluate.results import commands as results

    return results.write_coverage_map(folder, trial, out)


@results_app.command()
@shell_command()
def compare(
    words: Annotated[
        list[str], typer.Argument(metavar="A B | FOLDER A B", help="Two folders; with --by: a folder and two values.")
    ],
    by: Annotated[
        str | None, typer.Option("--by", metavar="FIELD", help="Compare within a folder: behaviour, engine, limits, …")
    ] = None,
    cells: Annotated[bool, typer.Option("--cells", help="Compare each cell too.")] = False,
    as_json: AsJson = False,
) -> int:
    """Compare trials in pairs of the same seed: differences B - A with intervals, effect sizes, tests."""
    from fullswarm.evaluate.results import commands as results

    return results.compare(words, by, cells, as_json)


@results_app.command()
@shell_command()
def report(
    folder: Folder,
    open_it: Annotated[bool, typer.Option("--open", help="Open the report in the browser.")] = False,
    plots: Annotated[
        Path | None, typer.Option("--plots", metavar="DIR", help="Write plots (SVG) and tables (Markdown) there too.")
    ] = None,
) -> int:
    """Write report.html, one self-contained file, into the folder; print its name."""
    from fullswarm.evaluate.results import commands as results

    return results.report(folder, open_it, plots)


@results_app.command()
@shell_command()
def audit(
    folder: Folder,
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Number of processes.")] = 2,
    as_json: AsJson = False,
) -> int:
    """Recount contacts, arrivals and commands from the stored motion. Exit code 1: a result differs."""
    from fullswarm.evaluate.results.audit import audit as audit_folder

    return audit_folder(folder, as_json, jobs)


@results_app.command()
@shell_command()
def index(folder: Folder, as_json: AsJson = False) -> int:
    """Rebuild the SQLite index from the trials' directories. Exit code 1: some cannot be read."""
    from fullswarm.evaluate.results import commands as results

    return results.index(folder, as_json)
