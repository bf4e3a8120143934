"""`fullswarm experiment trial FILE`: one trial again, from its file alone."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
from rich.table import Table

from fullswarm import output
from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment.record import TRIALS, Provenance, Record, trial_id
from fullswarm.evaluate.trial import Measure, Measurement, measure
from fullswarm.evaluate.trial_file import load_trial
from fullswarm.evaluate.trial_folder import perform, read_record, record_of, write_trial


def run(file: Path, folder: Path | None = None, as_json: bool = False, run_one: Measure = measure) -> int:
    """Run the trial in this process, tell its record, and keep it in `folder` if there is one.

    Returns
    -------
    int
        0; 1 when it failed, or collided where that is not expected.

    Raises
    ------
    ConfigError
        The file is not that of a trial, or the folder cannot be written.
    """
    launch = load_trial(file)
    before = read_record(file if file.is_dir() else file.parent)  # now: --out may replace it
    result, found, about = perform(launch.trial, launch.experiment, 1, run_one, "trial")
    record = record_of(launch.trial, launch.experiment, found)
    if folder is not None:
        _keep(folder, record, about, found)
    _compare(before, record)
    if as_json:
        output.data_json(msgspec.to_builtins(record))
    else:
        output.data_table(_table(record))
    if result.outcome is None:
        output.progress(f"failed: {launch.trial.label}: {result.failure}")
        return 1
    return int(result.outcome.events > 0 and not launch.trial.cell.collisions_expected)


def _keep(folder: Path, record: Record, about: Provenance, found: Measurement | str) -> None:
    """Keep the trial, unless it has an outcome there already; tell which."""
    there = read_record(folder / TRIALS / record.id)
    if there is not None and there.outcome is not None:
        output.progress(f"not kept: it has a result in {folder / TRIALS / record.id} already, which stays")
        return
    try:
        output.progress(f"kept in {write_trial(folder, record, about, found)}")
    except OSError as error:
        raise ConfigError(f"cannot keep the trial: {error.strerror or error}", where=str(folder)) from error


def _compare(before: Record | None, record: Record) -> None:
    """Tell whether it came out as it did before, if a result of it stood beside its file."""
    if before is None or before.id != trial_id(record.trial):
        return
    same = before == record
    output.progress("the same result as before" if same else "not the result that it had before: see its provenance")


def _table(record: Record) -> Table:
    view = Table(box=None, pad_edge=False, show_header=True)
    for name, side in (("", "left"), ("onboard", "right"), ("truth", "right")):
        view.add_column(name, justify="right" if side == "right" else "left")
    for row in _rows(record):
        view.add_row(*row)
    return view


def _rows(record: Record) -> Iterator[tuple[str, str, str]]:
    yield record.trial.label, "", ""
    yield f"ended: {record.end_reason}", "", ""
    if record.outcome is not None:
        for name, value in msgspec.structs.asdict(record.outcome).items():
            yield f"outcome.{name}", "", f"{value:g}" if isinstance(value, float) else str(value)
    for name in sorted(record.onboard.keys() | record.truth.keys()):
        onboard, truth = (f"{each[name]:.6g}" if name in each else "" for each in (record.onboard, record.truth))
        yield name, onboard, truth
