"""`fullswarm rehearse`: simulated years of faults for the whole stack, from a seed."""

from __future__ import annotations

from typing import Annotated

import typer

from fullswarm.cli.options import Json, shell_command
from fullswarm.errors import ConfigError


@shell_command(needs="posix")
def rehearse(
    hours: Annotated[float, typer.Option(min=0.001, max=1e6, help="Simulated hours of the whole swarm.")] = 0.1,
    seed: Annotated[int, typer.Option(min=0, help="Chooses all faults and requests.")] = 0,
    robots: Annotated[int, typer.Option(min=2, max=64, help="Number of robots.")] = 8,
    only: Annotated[
        str, typer.Option(metavar="FAULTS", help="Kinds of faults, separated by commas (default: all).")
    ] = "",
    episode: Annotated[
        int | None, typer.Option(min=0, help="Run only this episode (default: as many as --hours needs).")
    ] = None,
    faults: Annotated[
        str | None,
        typer.Option(metavar="INDICES", help="Inject only these faults of --episode: 3,17 or none (default: all)."),
    ] = None,
    jobs: Annotated[int, typer.Option(min=0, max=256, help="Processes at once (default: one per core).")] = 0,
    seconds: Annotated[
        float | None,
        typer.Option(min=1.0, help="Begin no further episode after so many real seconds (default: no limit)."),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="Real processes in real time on this machine, not a simulated clock.")
    ] = False,
    minutes: Annotated[float, typer.Option(min=0.2, max=1e5, help="With --live: how long faults happen.")] = 5.0,
    every: Annotated[
        float, typer.Option(min=0.5, max=600.0, help="With --live: seconds from one fault to the next.")
    ] = 5.0,
    as_json: Json = False,
) -> int:
    """Inject seeded faults into the whole stack on a simulated clock; exit code 1 when an invariant broke.

    With `--live` the same of a swarm of real processes: killed, stopped, cut off, with a full disk.
    """
    if live:
        return _live(robots, minutes, every, seed, as_json=as_json)
    from fullswarm.logs import quiet
    from fullswarm.output import Progress, data, data_json
    from fullswarm.rehearse.faults import check_kinds
    from fullswarm.rehearse.rehearsal import Options, text_of
    from fullswarm.rehearse.rehearsal import rehearse as run

    quiet()
    kinds = tuple(each.strip() for each in only.split(",") if each.strip())
    check_kinds(kinds)
    keep = None if faults is None else _indices(faults)
    with Progress("episodes", at_once=True) as progress:
        report = run(Options(seed, hours, robots, kinds, episode, keep, jobs=jobs, wall_s=seconds), progress)
    if as_json:
        data_json(report.as_dict())
    else:
        data(text_of(report))
    return 1 if report.failures else 0


def _indices(text: str) -> tuple[int, ...]:
    if text == "none":
        return ()
    try:
        return tuple(sorted({int(each) for each in text.split(",")}))
    except ValueError:
        raise ConfigError(f"'{text}' is no list of indices", where="--faults", hint="for example 3,17") from None


def _live(robots: int, minutes: float, every_s: float, seed: int, *, as_json: bool) -> int:
    from dataclasses import asdict

    from fullswarm.logs import log_to_stderr
    from fullswarm.output import data, data_json
    from fullswarm.portability import need_linux
    from fullswarm.rehearse.live.rehearsal import LOSS, rehearse_live, text_of

    need_linux("fullswarm rehearse --live")
    log_to_stderr(warnings_only=True)
    report = rehearse_live(robots, 60.0 * minutes, every_s, seed, LOSS)
    if as_json:
        data_json(asdict(report))
    else:
        data(text_of(report))
    return 1 if report.failed else 0
