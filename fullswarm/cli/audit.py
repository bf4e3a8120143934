"""`fullswarm audit`: shows and checks the audit log of a core."""

from __future__ import annotations

import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from fullswarm import output
from fullswarm.cli.options import Json, Swarm, shell_command
from fullswarm.errors import ConfigError

if TYPE_CHECKING:
    from fullswarm.audit.read import Reader, Selection

FOLLOW_S = 0.3
LONGEST_WORDS = 100

audit_app = typer.Typer(help="Show and check the audit log: who asked what of which robots.", no_args_is_help=True)
Log = Annotated[
    Path | None,
    typer.Argument(metavar="[FOLDER]", help="The log's folder (default: that of the swarm's core on this machine)."),
]


@audit_app.command()
@shell_command()
def show(
    folder: Log = None,
    since: Annotated[
        str, typer.Option(metavar="TIME", help="Only from then on: 10m, 2h, 1d, or 2026-11-25T14:30.")
    ] = "",
    robot: Annotated[str, typer.Option(metavar="ID", help="Only entries that concern this robot.")] = "",
    operator: Annotated[str, typer.Option(metavar="NAME", help="Only entries of this operator.")] = "",
    follow: Annotated[
        bool, typer.Option("--follow", "-f", help="Print new entries as they come, until Ctrl-C.")
    ] = False,
    swarm: Swarm = "swarm",
    as_json: Json = False,
) -> int:
    """Show the entries, the oldest first; with --json one object per line, as they are in the log."""
    from fullswarm.audit.read import Reader, Selection
    from fullswarm.audit.read import since as time_of

    selection = Selection(time_of(since, datetime.now(UTC)) if since else None, robot, operator)
    reader = Reader(_folder(folder, swarm))
    _print_new(reader, selection, as_json)
    return _follow(reader, selection, as_json) if follow else 0


@audit_app.command()
@shell_command()
def verify(
    path: Annotated[
        Path | None,
        typer.Argument(
            metavar="[FOLDER|FILE]", help="The log, or one file of it (default: that of the swarm's core here)."
        ),
    ] = None,
    store: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="The core's database, which notes the newest entry (default: beside the log)."
        ),
    ] = None,
    expect: Annotated[
        list[str] | None,
        typer.Option(metavar="N:HASH", help="An entry as it was printed before; it must still be there."),
    ] = None,
    swarm: Swarm = "swarm",
    as_json: Json = False,
) -> int:
    """Check that no entry was changed, removed, moved or cut off; exit code 1 names the first broken one."""
    from fullswarm.audit.verify import verify as check

    log = _folder(path, swarm)
    if not log.exists():
        raise ConfigError("there is no audit log", where=str(log), hint="name the folder of the log")
    if store is None and log.is_dir() and log.name.endswith("-audit"):
        beside = [each for each in log.parent.glob(f"{log.name.removesuffix('-audit')}.*") if _is_database(each)]
        store = beside[0] if beside else None
    found = check(log, store, dict(map(_noted, expect or ())))
    if as_json:
        output.data_json(
            {
                "log": str(log), "whole": not found.problems, "entries": found.entries, "first": found.first,
                "last": found.last, "hash": found.head, "problems": found.problems, "notes": found.notes,
            }
        )  # fmt: skip
        return 1 if found.problems else 0
    for note in found.notes:
        output.progress(f"note: {_printable(note)}")
    if found.problems:
        output.data(f"{log}: BROKEN: {_printable(found.problems[0])}")
        for problem in found.problems[1:10]:
            output.data(f"  {_printable(problem)}")
        if len(found.problems) > 10:
            output.data(f"  and {len(found.problems) - 10} more")
        return 1
    output.data(f"{log}: whole: {found.entries} entries, {found.first} to {found.last}")
    output.data(f"to check later that nothing before was replaced: --expect {found.last}:{found.head}")
    return 0


def _folder(given: Path | None, swarm: str) -> Path:
    """Return the log that is meant: of several of a swarm the one that was written last."""
    from fullswarm.launch.processes import newest_audit_folder

    return given if given is not None else newest_audit_folder(swarm)


def _is_database(path: Path) -> bool:
    try:
        with path.open("rb") as file:
            return file.read(16) == b"SQLite format 3\0"
    except OSError:
        return False


def _noted(text: str) -> tuple[int, str]:
    number, _, digest = text.partition(":")
    if not number.isdecimal() or len(digest) != 64:
        raise ConfigError(f"invalid entry '{text}'", where="--expect", hint="as `audit verify` prints it: N:HASH")
    return int(number), digest.lower()


def _follow(reader: Reader, selection: Selection, as_json: bool) -> int:
    from fullswarm.clock import MonotonicClock
    from fullswarm.runtime import Runtime

    runtime = Runtime(MonotonicClock())
    runtime.stop_on_signals()
    runtime.every(FOLLOW_S, lambda: _print_new(reader, selection, as_json))
    runtime.run()
    return output.INTERRUPTED


def _print_new(reader: Reader, selection: Selection, as_json: bool) -> None:
    for entry in reader.read():
        if not selection.wants(entry):
            continue
        if as_json:
            output.data_json(entry, indent=None)
        else:
            output.data(_words(entry))
    sys.stdout.flush()


def _words(entry: dict[str, Any]) -> str:
    """Return an entry on one line: time, act, who, robots, result, what."""
    try:
        when = datetime.fromisoformat(str(entry.get("time"))).astimezone().strftime("%Y-%m-%d %H:%M:%S")
    except ValueError:
        when = "?"
    operator, source, sender = (str(entry.get(name) or "") for name in ("operator", "source", "sender"))
    who = operator or source or sender or "-"
    if sender and sender not in (who, source):
        who += f" (by {sender})"
    robots, what = entry.get("robots") or (), entry.get("what") or {}
    named = ",".join(map(str, robots)) if robots else "all" if entry.get("act") in ("stop", "estop", "request") else "-"
    details = (
        " ".join(f"{name}={value}" for name, value in what.items() if value != "") if isinstance(what, dict) else ""
    )
    details = details if len(details) <= LONGEST_WORDS else f"{details[:LONGEST_WORDS]}…"
    line = f"{when}  {entry.get('act')!s:13}  {who}  {named}  {entry.get('result') or '-'}  {details}"
    return _printable(line.rstrip())


def _printable(text: str) -> str:
    """Return a text without control characters: names come from the network and must not command the terminal."""
    return "".join(each if each.isprintable() else "?" for each in text)
