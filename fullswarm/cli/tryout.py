"""`fullswarm try`: runs a Python file as a behaviour on simulated robots and shows it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fullswarm.cli.options import Json, shell_command
from fullswarm.cli.values import parse_parameters


@shell_command()
def try_(
    behaviour: Annotated[
        str,
        typer.Argument(
            metavar="FILE.py|BEHAVIOUR",
            help="A file with the function `velocity(view)` or `twist(view)`, or the name of a behaviour.",
        ),
    ],
    parameters: Annotated[
        list[str] | None,
        typer.Argument(metavar="KEY=VALUE", help="Its parameters: 1.5, true, 5,5 (a point), or a word."),
    ] = None,
    robots: Annotated[int, typer.Option(min=1, max=1000, help="Number of robots.")] = 6,
    size: Annotated[float, typer.Option(metavar="METRES", min=1, max=1000, help="Side of the arena.")] = 8.0,
    fleet: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.toml", help="Use the robots and the world of a fleet file, not --robots and --size."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Chooses start places, noise and random numbers.")] = 0,
    seconds: Annotated[float, typer.Option(min=0.1, max=3600, help="Simulated time.")] = 20.0,
    speed: Annotated[
        float,
        typer.Option(
            min=0,
            max=1000,
            show_default=False,
            help="Simulated seconds per second (default: 2 in a window; what fits into 15 s in a film).",
        ),
    ] = 0.0,
    save: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write a .png, .svg, .gif or .mp4 instead of opening a window (default without a display: a .png).",
        ),
    ] = None,
    filtered: Annotated[bool, typer.Option("--filter/--no-filter", help="Run a file behind the safety filter.")] = True,
    twist: Annotated[
        bool, typer.Option("--twist", help="The one function of a file returns speed and turn rate.")
    ] = False,
    as_json: Json = False,
) -> int:
    """Run a Python file as a behaviour on simulated robots, show it, and print its metrics."""
    from fullswarm.lab.tryout import Tryout, run

    values = parse_parameters(parameters or (), "parameters")
    return run(
        Tryout(
            behaviour=behaviour, parameters=values, robots=robots, size_m=size, fleet=fleet,
            seed=seed, seconds=seconds, speed=speed, save=save, filtered=filtered, twist=twist, as_json=as_json,
        )
    )  # fmt: skip
