"""`fullswarm scenario`: lists, shows, imports and exports worlds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fullswarm.cli import completion
from fullswarm.cli.options import Json, shell_command

scenario_app = typer.Typer(no_args_is_help=True, help="List, show, import and export worlds.")

Name = Annotated[
    str,
    typer.Argument(
        metavar="NAME|FILE.toml", help="A scenario of the package, or a file.", autocompletion=completion.scenarios
    ),
]
Seed = Annotated[int, typer.Option(min=0, help="Places random boxes and robots.")]
Robots = Annotated[int, typer.Option(min=0, max=1000, help="Number of robots at their starts.")]


@scenario_app.command("list")
@shell_command(logs=True)
def list_scenarios(as_json: Json = False) -> int:
    """List the scenarios of the package."""
    from fullswarm.evaluate.scenarios import commands as scenario_tasks

    return scenario_tasks.list_all(as_json)


@scenario_app.command()
@shell_command(logs=True)
def show(name: Name, seed: Seed = 0, robots: Robots = 4, as_json: Json = False) -> int:
    """Show a scenario from above, in text; with --json every box, start and goal."""
    from fullswarm.evaluate.scenarios import commands as scenario_tasks

    return scenario_tasks.show(name, seed, robots, as_json)


@scenario_app.command("import")
@shell_command(logs=True)
def import_world(
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="A world of Gazebo, ARGoS, Player/Stage, Menge or IR-SIM, or a ROS map."),
    ],
    form: Annotated[
        str | None,
        typer.Option(
            "--format", metavar="sdf|argos|stage|player|menge|irsim|map", help="The format (default: from the file)."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE.toml", help="Write to this file, not to stdout.")
    ] = None,
    as_json: Json = False,
) -> int:
    """Convert another simulator's world or a ROS map to a scenario. Notes name what was omitted or approximated."""
    from fullswarm.evaluate.scenarios import commands as scenario_tasks

    return scenario_tasks.import_world(file, form, out, as_json)


@scenario_app.command()
@shell_command(logs=True)
def export(
    name: Name,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="The file to write; with pgm a .yaml beside it.")],
    form: Annotated[str, typer.Option("--format", metavar="sdf|pgm", help="A Gazebo world, or a ROS map.")] = "sdf",
    robots: Robots = 4,
    seed: Seed = 0,
    cell: Annotated[float, typer.Option(metavar="METRES", min=0.001, max=10, help="Size of the map's cells.")] = 0.05,
    model: Annotated[
        str, typer.Option("--model", metavar="create2|create1|roomba500", help="The robot of an SDF world.")
    ] = "create2",
    driven: Annotated[
        bool, typer.Option("--driven", help="Write robots with wheels and Gazebo's DiffDrive, not cylinders.")
    ] = False,
) -> int:
    """Write a scenario for Gazebo (SDF 1.9), or as a map for ROS (PGM and YAML)."""
    from fullswarm.evaluate.scenarios import commands as scenario_tasks

    return scenario_tasks.export(name, form, robots, seed, out, cell, model, driven)
