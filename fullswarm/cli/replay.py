"""`fullswarm replay`: runs the nodes of a recording again, and names the first thing that they do differently."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm import output
from fullswarm.cli.options import Json, shell_command
from fullswarm.errors import ConfigError

if TYPE_CHECKING:
    from fullswarm.record.replay import Outcome


@shell_command()
def replay(
    files: Annotated[list[Path], typer.Argument(metavar="FILE.mcap…", help="The files of one recording.")],
    robot: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Only this robot, or `core` or `centralised`; may be repeated."),
    ] = None,
    from_s: Annotated[
        float, typer.Option("--from", metavar="SECONDS", min=0, help="Compare from this time of the recording on.")
    ] = 0.0,
    to_s: Annotated[
        float | None, typer.Option("--to", metavar="SECONDS", min=0, help="Compare up to this time, and end there.")
    ] = None,
    with_code: Annotated[
        bool, typer.Option("--with-code", help="Run the code of today, though other code was recorded.")
    ] = False,
    jobs: Annotated[int, typer.Option(min=0, max=256, help="Processes at once (default: one per processor).")] = 0,
    as_json: Json = False,
) -> int:
    """Run all nodes of a recording again on what they received; exit code 1: they do something else than then."""
    from fullswarm.launch.recorder import need_recordings

    need_recordings()
    from fullswarm.record.replay import Window, check_code, recorded_in
    from fullswarm.record.replay import replay as run

    if to_s is not None and to_s <= from_s:
        raise ConfigError(f"--to {to_s:g} is not after --from {from_s:g}", where="--to")
    found = recorded_in(files)
    if not with_code:
        check_code(found)
    outcomes = run(found, robot or (), Window(from_s, float("inf") if to_s is None else to_s), jobs)
    if as_json:
        output.data_json([_as_json(each) for each in outcomes])
    else:
        _print(outcomes)
    return 0 if all(each.first is None and not each.trouble for each in outcomes) else 1


def _as_json(outcome: Outcome) -> dict[str, object]:
    first = outcome.first
    return {
        "process": outcome.process, "name": outcome.name, "events": outcome.events,
        "seconds": round(outcome.seconds, 3), "outputs": outcome.outputs, "commands": outcome.commands,
        "different": outcome.different, "trouble": outcome.trouble,
        "first": None if first is None else {
            "at_s": round(outcome.at_s, 6), "event": first.event, "during": first.during, "what": first.what,
            "then": first.then, "now": first.now,
        },
    }  # fmt: skip


def _print(outcomes: list[Outcome]) -> None:
    from rich.markup import escape

    table = output.plain_table("process", "result", numbers=("seconds", "events", "outputs", "commands"))
    for each in outcomes:
        numbers = f"{each.seconds:.1f}", str(each.events), str(each.outputs), str(each.commands)
        table.add_row(escape(each.name), escape(_result(each)), *numbers)
    output.data_table(table, into_file=120)
    ordered = sorted((each for each in outcomes if each.first is not None), key=lambda each: each.at_s)
    for each in ordered[:1]:
        first = each.first
        assert first is not None  # noqa: S101  (narrows the type)
        output.data(f"\nfirst difference: {each.name}, {each.at_s:.3f} s, event {first.event}, {first.during}")
        output.data(f"  {first.what}")
        output.data(f"  then  {first.then}")
        output.data(f"  now   {first.now}")
    if not ordered and not any(each.trouble for each in outcomes):
        commands = sum(each.commands for each in outcomes)
        output.data(f"\nall {sum(each.outputs for each in outcomes)} outputs are equal, {commands} commands among them")


def _result(outcome: Outcome) -> str:
    if outcome.first is not None:
        return f"different from {outcome.at_s:.3f} s on, {outcome.different} events" + (
            f"; {outcome.trouble}" if outcome.trouble else ""
        )
    return outcome.trouble or "equal"
