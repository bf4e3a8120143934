"""`fullswarm viewer`: shows a live swarm in Foxglove, Lichtblick or Rerun, and makes a layout for it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm import output
from fullswarm.cli.options import Json, shell_command

if TYPE_CHECKING:
    from fullswarm.cli.options import Target

viewer_app = typer.Typer(
    help="Show live swarms in Foxglove, Lichtblick and Rerun; they can send nothing.", no_args_is_help=True
)


@viewer_app.command()
@shell_command(logs=True)
def foxglove(
    target: Target,
    listen: Annotated[
        str,
        typer.Option(
            metavar="HOST:PORT",
            help="The address to listen on; port 0: any free port. Programs that reach it can read all of the swarm.",
        ),
    ] = "127.0.0.1:8765",
    allow_origin: Annotated[
        list[str] | None,
        typer.Option(
            metavar="URL",
            help="Let pages of this origin connect, such as https://viewer.example (default: Foxglove's own, and pages "
            "of this computer).",
        ),
    ] = None,
    as_json: Json = False,
) -> int:
    """Serve a live swarm as a Foxglove WebSocket until Ctrl-C. Print the address to open."""
    from fullswarm.launch.observer import need

    need(("foxglove", "mcap", "starlette", "uvicorn", "websockets"), "the view", "record,console")
    from fullswarm.record.live import show

    origins = frozenset(each.strip().rstrip("/").lower() for each in allow_origin or ())
    return show(target, listen, origins, as_json)


@viewer_app.command()
@shell_command()
def layout(
    target: Target,
    fleet: Annotated[
        Path | None,
        typer.Argument(metavar="[FLEET.toml]", help="The fleet file (default: the robots of the live swarm)."),
    ] = None,
) -> int:
    """Print a layout for Foxglove and Lichtblick: arena, charts of each robot, log, table."""
    from fullswarm.launch.observer import need

    need(("foxglove", "mcap"), "a layout", "record")
    from fullswarm.record import layout as layouts

    output.data_json(layouts.layout(layouts.of_swarm(target) if fleet is None else layouts.of_fleet(fleet)))
    return 0


@viewer_app.command()
@shell_command(logs=True)
def rerun(
    target: Target,
    recording: Annotated[
        Path | None, typer.Argument(metavar="[RUN.mcap]", help="A recording (default: the live swarm, until Ctrl-C).")
    ] = None,
    connect: Annotated[
        str | None,
        typer.Option(metavar="HOST:PORT", help="A viewer that runs, or its URL, as it prints it."),
    ] = None,
    save: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help="A new file, in place of a viewer.")] = None,
) -> int:
    """Show a live swarm or a recording in Rerun: the arena from above, charts, cameras, log."""
    from fullswarm.errors import ConfigError
    from fullswarm.launch.observer import need

    if connect is not None and save is not None:
        raise ConfigError("either a viewer or a file", where="--connect, --save", hint="leave one out")
    need(("foxglove", "mcap"), "Rerun", "record,console")
    need(("rerun",), "this view", "rerun")
    from fullswarm.record.rerun_view import draw_recording, show

    return show(target, connect, save) if recording is None else draw_recording(recording, connect, save)
