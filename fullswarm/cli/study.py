"""`fullswarm study`: checks, runs, shows, exports and unblinds human-swarm studies."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fullswarm import output
from fullswarm.cli.options import Json, shell_command
from fullswarm.errors import ConfigError

study_app = typer.Typer(no_args_is_help=True)

File = Annotated[Path, typer.Argument(metavar="FILE", help="The study file (TOML).")]
Folder = Annotated[Path, typer.Argument(metavar="FOLDER", help="The folder of the study (--out of `run`).")]


@study_app.command()
@shell_command()
def check(file: File, as_json: Json = False) -> int:
    """Check a study file with all its fleets and missions; print the design. Nothing is started."""
    from fullswarm.study.file import check_fleets, load_study
    from fullswarm.study.folder import LABELS
    from fullswarm.study.order import orders, rows_of

    study = load_study(file)
    check_fleets(study)
    section = study.section
    count, people = len(section.conditions), len(section.codes)
    block = len(rows_of(section.order, count))
    rows = orders(section.order, count, people, section.seed)
    design = {code: [LABELS[each] for each in row] for code, row in zip(section.codes, rows, strict=True)}
    if as_json:
        output.data_json({"study": section.name, "order": section.order, "block": block, "participants": design})
        return 0
    output.data(f"study '{section.name}': {people} participants, {count} conditions, order: {section.order}")
    for code, labels in design.items():
        output.data(f"{code}  {' '.join(labels)}")
    minutes = count * section.duration_s / 60.0
    output.progress(f"{minutes:.1f} min of trials per participant; labels are drawn when the study begins")
    if block and people % block:
        output.progress(f"warning: the design is balanced for a multiple of {block} participants, not for {people}")
    return 0


@study_app.command()
@shell_command()
def run(
    file: File,
    participant: Annotated[str, typer.Option("--participant", metavar="CODE", help="The participant's code: P01.")],
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FOLDER", help="The folder of the study (default: NAME-study).")
    ] = None,
    open_page: Annotated[bool, typer.Option("--open", help="Open the page in this machine's browser.")] = False,
) -> int:
    """Run the participant's next trial: start its swarm and the console, and print the address of the page."""
    from fullswarm.study.file import check_fleets, load_study
    from fullswarm.study.folder import begin
    from fullswarm.study.session import prepare, record_of
    from fullswarm.study.session import run as run_trial

    study = load_study(file)
    check_fleets(study)
    if participant not in study.section.codes:
        raise ConfigError(
            f"the study has no participant '{participant}'", where="--participant", hint=", ".join(study.section.codes)
        )  # fmt: skip
    folder = begin(study, out or Path(f"{study.section.name}-study"))
    due = folder.due(participant)
    if due is None:
        output.progress(f"{participant} has completed all conditions")
        return 0
    again = f", attempt {due.attempt}" if due.attempt > 1 else ""
    output.progress(f"{participant}: condition {due.label}, {due.number} of {due.of}{again}; Ctrl-C interrupts it")

    def on_address(url: str) -> None:
        output.data(url)
        output.progress("open this address on the participant's screen")

    prepared = prepare(folder, due)
    code = run_trial(prepared, open_page=open_page, on_address=on_address)
    record = record_of(prepared.folder)
    state, reason = (record.state, record.reason) if record is not None else ("interrupted", "")
    output.progress(f"trial {state}{f': {reason}' if reason else ''}; stored in {prepared.folder}")
    after = folder.due(participant)
    text = f"condition {after.label} is next" if after is not None else f"{participant} has completed all conditions"
    output.progress(text)
    return code


@study_app.command()
@shell_command()
def status(folder: Folder, as_json: Json = False) -> int:
    """Show which trials are complete, by labels."""
    from dataclasses import asdict

    from fullswarm.study.folder import open_folder, progress

    study = open_folder(folder)
    rows = progress(study)
    if as_json:
        output.data_json(
            {
                "study": study.study.section.name,
                "unblinded": study.opened,
                "participants": [asdict(row) for row in rows],
            }
        )
        return 0
    signs = {"complete": "+", "interrupted": "!", "running": "…", "prepared": "…", "": "-"}
    for row in rows:
        cells = "  ".join(f"{label}{signs[state]}" for label, state in zip(row.order, row.states, strict=True))
        note = f"  ({row.interrupted} interrupted)" if row.interrupted else ""
        output.data(f"{row.participant:<12} {cells}{note}")
    output.progress("+ complete, ! interrupted, … running, - not yet")
    output.progress("unblinded" if study.opened else "blinded; `fullswarm study unblind` opens the key")
    return 0


@study_app.command()
@shell_command()
def export(
    folder: Folder,
    out: Annotated[
        Path, typer.Option("-o", "--out", metavar="FILE", help="The file to write: .csv, .xlsx or .parquet.")
    ],
) -> int:
    """Write all measures of all complete trials as a tidy table; print the file's name."""
    from fullswarm.study.folder import open_folder
    from fullswarm.study.tidy import export as write

    study = open_folder(folder)
    count = write(study, out)
    output.data(str(out))
    names = "with the conditions' names" if study.opened else "with labels only: the study is blinded"
    output.progress(f"{count} rows, {names}")
    return 0


@study_app.command()
@shell_command()
def unblind(
    folder: Folder,
    yes: Annotated[bool, typer.Option("--yes", help="Skip the confirmation prompt.")] = False,
    as_json: Json = False,
) -> int:
    """Open the sealed key and show which label is which condition. The time is noted in the folder."""
    from fullswarm.study.folder import open_folder, progress

    study = open_folder(folder)
    missing = sum(row.next is not None for row in progress(study))
    if missing and not study.opened and not yes:
        output.progress(f"{missing} participants have not completed all conditions")
        if not typer.confirm("Open the key now? It cannot be closed again."):
            return 1
    key = study.unblind()
    if as_json:
        output.data_json(key)
    else:
        output.data("\n".join(f"{label}  {name}" for label, name in key.items()))
    return 0
