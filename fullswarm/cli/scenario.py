"""`fullswarm scenario`: the arenas of the package and those that users bring along."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import typer

from fullswarm.cli import completion
from fullswarm.cli.operate import Debug, Json, run_guarded

scenario_app = typer.Typer(no_args_is_help=True, help="Arenas: list, show, import from other simulators, export.")

Name = Annotated[
    str,
    typer.Argument(
        metavar="NAME|FILE.toml", help="One of the package, or your own.", autocompletion=completion.scenarios
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Places random boxes and robots.")]
Robots = Annotated[int, typer.Option(min=0, max=1000, help="How many stand at their starts.")]


def _run(debug: bool, command: Callable[[], int]) -> None:
    from fullswarm.output import log_to_stderr

    log_to_stderr()
    raise typer.Exit(run_guarded(command, debug))


@scenario_app.command("list")
def list_scenarios(as_json: Json = False, debug: Debug = False) -> None:
    """List the scenarios of the package."""

    def command() -> int:
        from fullswarm.evaluate.scenarios import commands as scenario_tasks

        return scenario_tasks.list_all(as_json)

    _run(debug, command)


@scenario_app.command()
def show(name: Name, seed: Seed = 0, robots: Robots = 4, as_json: Json = False, debug: Debug = False) -> None:
    """Show a scenario from above, in text; with --json every box, start and goal."""

    def command() -> int:
        from fullswarm.evaluate.scenarios import commands as scenario_tasks

        return scenario_tasks.show(name, seed, robots, as_json)

    _run(debug, command)


@scenario_app.command("import")
def import_world(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A world of Gazebo, ARGoS, Stage, Menge or IR-SIM.")],
    form: Annotated[
        str | None, typer.Option("--format", metavar="sdf|argos|stage|menge|irsim", help="Guessed unless told.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.toml", help="Write the scenario here, not to stdout.")
    ] = None,
    as_json: Json = False,
    debug: Debug = False,
) -> None:
    """Make a scenario of another simulator's world. Notes say what was left out or approximated."""

    def command() -> int:
        from fullswarm.evaluate.scenarios import commands as scenario_tasks

        return scenario_tasks.import_world(file, form, out, as_json)

    _run(debug, command)


@scenario_app.command()
def export(
    name: Name,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Where to write; pgm: the .yaml goes beside it.")],
    form: Annotated[str, typer.Option("--format", metavar="sdf|pgm", help="A Gazebo world, or a ROS map.")] = "sdf",
    robots: Robots = 4,
    seed: Seed = 0,
    cell: Annotated[float, typer.Option(metavar="METRES", min=0.001, max=10, help="Of the map's cells.")] = 0.05,
    driven: Annotated[
        bool, typer.Option("--driven", help="Robots with wheels and Gazebo's DiffDrive, not plain cylinders.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Write a scenario for Gazebo (SDF 1.9), or as a map for ROS (PGM and YAML)."""

    def command() -> int:
        from fullswarm.evaluate.scenarios import commands as scenario_tasks

        return scenario_tasks.export(name, form, robots, seed, out, cell, driven)

    _run(debug, command)
