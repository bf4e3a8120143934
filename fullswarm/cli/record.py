"""`fullswarm record`: records live swarms as MCAP files, says what a file holds, repairs one that was cut off."""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fullswarm import output
from fullswarm.cli.options import Json, Swarm, shell_command
from fullswarm.launch.recorder import need_recordings

if TYPE_CHECKING:
    from fullswarm.cli.options import Target
    from fullswarm.record.reading import Contents

record_app = typer.Typer(
    help="Record live swarms as MCAP files, for Foxglove, Lichtblick, Rerun and your own scripts.",
    no_args_is_help=True,
)
File = Annotated[Path, typer.Argument(metavar="FILE.mcap", help="The recording.")]


@record_app.command()
@shell_command(logs=True, needs="posix")
def start(
    target: Target,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE.mcap", help="A new file (default: SWARM-DATE-TIME.mcap in this folder)."),
    ] = None,
    fleet: Annotated[
        Path | None, typer.Option(metavar="FLEET.toml", help="Have the fleet file in the recording, too.")
    ] = None,
    limit_mb: Annotated[
        float, typer.Option(metavar="MB", min=0, help="Begin a new file from this size on; 0: never.")
    ] = 500.0,
    keep: Annotated[int, typer.Option(metavar="N", min=0, help="Keep the newest N of these files; 0: all.")] = 0,
    ranges: Annotated[
        float,
        typer.Option(metavar="HZ", min=0.0, max=20.0, help="Ask robots for their range scans so often; 0: do not ask."),
    ] = 0.0,
    with_parent: Annotated[bool, typer.Option("--with-parent", hidden=True)] = False,
) -> int:
    """Record every message of a live swarm until Ctrl-C."""
    need_recordings()
    from fullswarm.record.session import start as run

    return run(target, out, fleet, limit_mb, keep, with_parent, ranges)


@record_app.command()
@shell_command(needs="posix")
def stop(swarm: Swarm = "swarm") -> int:
    """End the recordings of a swarm that run on this computer."""
    need_recordings()
    from fullswarm.record.session import stop as run

    return run(swarm)


@record_app.command()
@shell_command()
def info(file: File, as_json: Json = False) -> int:
    """Say what a recording holds; exit code 1: it was cut off, see `repair`."""
    need_recordings()
    from fullswarm.record.reading import contents

    found = contents(file)
    if as_json:
        output.data_json(_as_json(found))
    else:
        _print(found)
    return 0 if found.whole else 1


@record_app.command()
@shell_command()
def repair(
    file: File,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE.mcap", help="The new file (default: FILE.repaired.mcap).")
    ] = None,
) -> int:
    """Write what can be read of a recording that was cut off into a new file, with its index."""
    need_recordings()
    from fullswarm.record.reading import repair as run

    target = out or file.with_name(f"{file.stem}.repaired{file.suffix}")
    found = run(file, target)
    output.progress(f"{target}: {found.messages} messages of {found.seconds:.1f} s")
    return 0


@record_app.command()
@shell_command()
def clip(
    file: File,
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="The new file; its ending says what it is: .mcap, .gif or .mp4.")
    ],
    from_: Annotated[
        str, typer.Option("--from", metavar="TIME", help="Seconds from its beginning, or 2026-11-27T12:03:14.")
    ] = "",
    to: Annotated[str, typer.Option("--to", metavar="TIME", help="The same, for the end (default: its end).")] = "",
    speed: Annotated[float, typer.Option(metavar="X", help="Of a film: seconds of the recording per second.")] = 1.0,
    width: Annotated[int, typer.Option(metavar="PX", help="Of a film.")] = 720,
    as_json: Json = False,
) -> int:
    """Write a part of a recording: as a recording of its own, or as a film from above."""
    need_recordings()
    from fullswarm.record.clip import clip as run
    from fullswarm.record.clip import range_of

    if out.suffix.lower() in (".gif", ".mp4"):
        from fullswarm.evaluate.pictures.recording import film

        frames = film(file, out, range_of(file, from_, to), speed, width)
        output.data_json({"file": str(out), "frames": frames}) if as_json else output.data(str(out))
        return 0
    with output.Progress("messages read") as progress:
        found = run(file, out, range_of(file, from_, to), progress.at)
    if as_json:
        output.data_json(_as_json(found))
    else:
        output.data(str(out))
        output.progress(f"{found.messages} messages of {found.seconds:.1f} s, {found.bytes / 1e6:.1f} MB")
    return 0


def _as_json(found: Contents) -> dict[str, object]:
    return {
        "file": str(found.path), "whole": found.whole, "bytes": found.bytes, "messages": found.messages,
        "seconds": round(found.seconds, 3), "start": _when(found.first_ns), "about": found.about,
        "attachments": found.attachments,
        "topics": [
            {"topic": topic, "schema": schema, "messages": count}
            for (topic, schema), count in sorted(found.topics.items())
        ],
    }  # fmt: skip


def _when(time_ns: int) -> str:
    return datetime.fromtimestamp(1e-9 * time_ns).astimezone().isoformat(timespec="seconds") if time_ns else ""


def _print(found: Contents) -> None:
    about = found.about.get("fullswarm", {})
    output.data(f"swarm {about.get('swarm', '?')}, recorded by fullswarm {about.get('version', '?')}")
    output.data(
        f"from {_when(found.first_ns)}, {found.seconds:.1f} s, {found.messages} messages, {found.bytes / 1e6:.1f} MB"
    )
    if found.attachments:
        output.data("with " + ", ".join(sorted(found.attachments)))
    lost = {name: count for name, count in found.about.get("fullswarm.end", {}).items() if count != "0"}
    if lost:
        output.data("not recorded: " + ", ".join(f"{count} {name}" for name, count in lost.items()))
    table = output.plain_table("topic", "schema", numbers=("messages",))
    for (topic, schema), count in sorted(found.topics.items()):
        table.add_row(topic, schema, str(count))
    output.data_table(table, into_file=120)
    if not found.whole:
        output.progress(f"it was cut off; `fullswarm record repair {found.path}` makes a whole file of it")
