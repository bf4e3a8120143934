"""The commands that look at an experiment: `watch` while it runs, `replay` a trial. ``main`` hangs them in."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fullswarm.operator.cli import run_guarded

Debug = Annotated[bool, typer.Option("--debug", help="Show where an error comes from.")]


def watch(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="Where the experiment keeps its trials (--out).")],
    once: Annotated[bool, typer.Option("--once", help="As it is now, then end.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="JSON: one document with --once, else a line at each change.")
    ] = False,
    debug: Debug = False,
) -> None:
    """Show how an experiment goes, until all its trials have ended or Ctrl-C, which leaves it running."""

    def command() -> int:
        from fullswarm.launch.evaluate import watch_run

        return watch_run.watch(watch_run.Watch(folder, once, as_json))

    raise typer.Exit(run_guarded(command, debug))


def replay(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="An experiment's, or one trial's.")],
    to: Annotated[
        Path,
        typer.Option("--to", metavar="FILE", help="A picture (.png, .svg) of the whole way, or a film (.gif, .mp4)."),
    ],
    trial: Annotated[
        str, typer.Option("--trial", metavar="ID", help="Which one: how its id begins; * fits anything.")
    ] = "",
    speed: Annotated[
        float, typer.Option("--speed", min=0.01, max=1000.0, help="Seconds of the trial in one of the film.")
    ] = 4.0,
    fps: Annotated[float, typer.Option("--fps", min=0.1, max=120.0, help="Frames per second of the film.")] = 10.0,
    from_s: Annotated[
        float | None, typer.Option("--from", metavar="SECONDS", help="Begin here; none: at the start.")
    ] = None,
    until_s: Annotated[
        float | None, typer.Option("--until", metavar="SECONDS", help="End here; a picture shows the robots then.")
    ] = None,
    width_px: Annotated[
        int, typer.Option("--width", metavar="PIXELS", help="Of the picture or film, 320 to 3840.")
    ] = 720,
    debug: Debug = False,
) -> None:
    """Draw or film a trial: the world from above."""

    def command() -> int:
        from fullswarm.launch.evaluate import replay as replays
        from fullswarm.perf.pictures import Film

        film = Film(speed=speed, fps=fps, from_s=from_s, until_s=until_s, width_px=width_px)
        return replays.replay(replays.Replay(folder, to, film, trial))

    raise typer.Exit(run_guarded(command, debug))
