"""`fullswarm experiment`: runs, repeats, watches and draws trials."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fullswarm.cli import completion
from fullswarm.cli.options import Json, shell_command

experiment_app = typer.Typer(no_args_is_help=True)


@experiment_app.command("run")
@shell_command(logs=True)
def run_experiment(
    name: Annotated[
        str,
        typer.Argument(
            metavar="NAME|FILE.toml",
            help="An experiment of the package (paper, safety), or a file.",
            autocompletion=completion.experiments,
        ),
    ],
    seeds: Annotated[
        str | None, typer.Option(metavar="A-B", help="Run these seeds, not the file's: 0-19, or 7.")
    ] = None,
    cells: Annotated[
        list[str] | None,
        typer.Option(
            "--cells",
            metavar="FILTER",
            help="Run only these cells: 'behaviour=navigate_bc,robots=32'; may be repeated.",
        ),
    ] = None,
    small: Annotated[bool, typer.Option("--small", help="Run the file's small version: a minute or two.")] = False,
    engine: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Use this engine, not the file's: kinematic, pybullet, pybullet-wheels."),
    ] = None,
    network: Annotated[
        str | None,
        typer.Option(metavar="SPEC", help="Inject network faults in all trials: loss=20%,delay=100ms±50."),
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, max=256, help="Number of processes.")] = 2,
    timeout_s: Annotated[
        float, typer.Option("--trial-timeout", min=1.0, metavar="SECONDS", help="Wall-clock limit of one trial.")
    ] = 600.0,
    retries: Annotated[
        int, typer.Option(min=0, max=10, help="Repeat a trial whose process died or ran out of time.")
    ] = 1,
    shard: Annotated[
        str | None, typer.Option(metavar="I/N", help="Run every Nth trial from the Ith on, for N machines.")
    ] = None,
    folder: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Keep each trial here; run again to continue.")
    ] = None,
    dask: Annotated[
        str | None, typer.Option(metavar="local|ADDRESS", help="Run on Dask, here or at its scheduler.")
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="Run real processes in real time, not in lockstep, one trial at a time.")
    ] = False,
    emulate: Annotated[
        str | None, typer.Option(metavar="MAKE", help="With --live: emulate robots of this make on real ports.")
    ] = None,
    fleet: Annotated[
        Path | None,
        typer.Option("--fleet", metavar="FILE", help="Run on the robots of a fleet file; pause for their set-up."),
    ] = None,
    yes: Annotated[
        bool,
        typer.Option("--yes", help="With --fleet: skip the confirmation prompts; robots are in place and may drive."),
    ] = False,
    insecure_network: Annotated[
        bool, typer.Option("--insecure-network", help="With --fleet: listen beyond this machine.")
    ] = False,
    evidence: Annotated[
        str | None,
        typer.Option(
            metavar="always|contacts|never",
            help="Keep the motion of all trials, of those with a contact, or of none, for `results audit`"
            " (default: the file's, else contacts).",
        ),
    ] = None,
    record: Annotated[
        bool | None,
        typer.Option(
            "--record/--no-record",
            help="Record each trial into --out, for viewers and `fullswarm replay` (default: with --live or --fleet).",
        ),
    ] = None,
    as_json: Json = False,
    parent: Annotated[int | None, typer.Option("--parent", hidden=True)] = None,
) -> int:
    """Run an experiment. Exit code 0: none failed, and none collided except where the file expects it; 1 otherwise."""
    from fullswarm.evaluate.experiment import run as experiment

    options = experiment.Options(
        experiment=name,
        seeds=seeds,
        cells=tuple(cells or ()),
        small=small,
        jobs=jobs,
        timeout_s=timeout_s,
        folder=folder,
        as_json=as_json,
        engine=engine,
        network=network,
        shard=shard,
        retries=retries,
        dask=dask,
        live=live,
        emulate=emulate,
        fleet=fleet,
        yes=yes,
        insecure_network=insecure_network,
        evidence=evidence,
        record=record,
        parent=parent,
    )
    return experiment.run(options)


@experiment_app.command("list")
@shell_command()
def list_experiments(
    folder: Annotated[
        Path, typer.Argument(metavar="[FOLDER]", help="Experiment files, with their results beside them.")
    ] = Path(),
    as_json: Json = False,
    to: Annotated[Path | None, typer.Option("--to", hidden=True)] = None,
    parent: Annotated[int, typer.Option("--parent", hidden=True)] = 0,
) -> int:
    """List the experiments that can be run, the package's and those of a folder, and how far each one is."""
    from fullswarm.evaluate.experiment import listing

    return listing.list_experiments(folder, as_json) if to is None else listing.follow(folder, to, parent)


@experiment_app.command("trial")
@shell_command(logs=True)
def run_trial(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A trial.toml, or the directory that holds it.")],
    folder: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="Keep the trial here, in FOLDER/trials.")
    ] = None,
    evidence: Annotated[
        str, typer.Option(metavar="always|contacts|never", help="Keep its motion, for `results audit`.")
    ] = "contacts",
    as_json: Json = False,
) -> int:
    """Run one trial again, from its file alone. Exit code 1: it failed, or collided where that is not expected."""
    from fullswarm.evaluate.experiment import run as experiment

    return experiment.run_again(file, folder, as_json, evidence)


@experiment_app.command()
@shell_command()
def watch(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="The folder of the experiment (its --out).")],
    once: Annotated[bool, typer.Option("--once", help="Print the present state and end.")] = False,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print JSON: one document with --once, else a line at each change.")
    ] = False,
) -> int:
    """Show the progress of an experiment, until its trials have ended or Ctrl-C, which leaves it running."""
    from fullswarm.evaluate.experiment import watch as watch_run

    return watch_run.watch(watch_run.Watch(folder, once, as_json))


@experiment_app.command()
@shell_command()
def replay(
    folder: Annotated[Path, typer.Argument(metavar="FOLDER", help="The folder of an experiment or a trial.")],
    to: Annotated[
        Path,
        typer.Option(
            "--to", metavar="FILE", help="Write a picture (.png, .svg) of the whole trial, or a film (.gif, .mp4)."
        ),
    ],
    trial: Annotated[
        str, typer.Option("--trial", metavar="ID", help="The trial, by the start of its id; * matches anything.")
    ] = "",
    speed: Annotated[
        float, typer.Option("--speed", min=0.01, max=1000.0, help="Seconds of the trial per second of the film.")
    ] = 4.0,
    fps: Annotated[float, typer.Option("--fps", min=0.1, max=120.0, help="Frames per second of the film.")] = 10.0,
    from_s: Annotated[
        float | None, typer.Option("--from", metavar="SECONDS", help="Start here (default: at 0).")
    ] = None,
    until_s: Annotated[
        float | None,
        typer.Option("--until", metavar="SECONDS", help="End here; a picture shows the robots at this time."),
    ] = None,
    width_px: Annotated[
        int, typer.Option("--width", metavar="PIXELS", help="Width of the picture or film, 320 to 3840.")
    ] = 720,
) -> int:
    """Draw or film a trial: the world from above."""
    from fullswarm.evaluate.pictures import Film
    from fullswarm.evaluate.pictures import replay as replays

    film = Film(speed=speed, fps=fps, from_s=from_s, until_s=until_s, width_px=width_px)
    return replays.replay(replays.Replay(folder, to, film, trial))
