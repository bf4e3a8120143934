"""The directory of a trial: written beside its place and moved there, so that it is whole or not there at all."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

from fullswarm.clock import MonotonicClock, wall_time_s
from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment.plan import Trial
from fullswarm.evaluate.experiment.record import (
    CONTACTS_FILE,
    COVERAGE_FILE,
    PROVENANCE_FILE,
    RESULT_FILE,
    TRAJECTORY_FILE,
    TRIAL_FILE,
    TRIALS,
    Provenance,
    Record,
    trial_id,
)
from fullswarm.evaluate.experiment.results import TrialResult
from fullswarm.evaluate.provenance import provenance
from fullswarm.evaluate.trial import Measure, Measurement, attempt, measure
from fullswarm.evaluate.trial_file import launch_text

FAILED, OLD = "failed", ".old"
OLD_S = 86400.0
"""Parts of directories of another machine are removed when they are older."""
Files = Mapping[str, bytes]


@dataclass(frozen=True, slots=True)
class Keeper:
    """Runs trials and keeps them in `out`: what a worker process does.

    Parameters
    ----------
    run : measures a trial; importable by its name
    """

    out: Path
    experiment: str
    run: Measure = measure
    runner: str = "pool"

    def __call__(self, trial: Trial, attempts: int = 1) -> TrialResult:
        """Run a trial; a failure is its result, also when it cannot be kept."""
        result, found, about = perform(trial, self.experiment, attempts, self.run, self.runner)
        try:
            write_trial(self.out, record_of(trial, self.experiment, found), about, found)
        except OSError as error:
            return not_kept(result, self.out, error)
        return result


def perform(
    trial: Trial, experiment: str, attempts: int, run: Measure, runner: str
) -> tuple[TrialResult, Measurement | str, Provenance]:
    """Run a trial; return its result, all that it measured or why it failed, and where from."""
    started_s, clock = wall_time_s(), MonotonicClock()
    began_s = clock.now_s()
    found = attempt(trial, run)
    wall_s = clock.now_s() - began_s
    about = provenance(started_s, wall_s, attempts, launch_text(trial, experiment), runner)
    return result_of(trial, found, wall_s, attempts), found, about


def result_of(trial: Trial, found: Measurement | str, wall_s: float, attempts: int = 1) -> TrialResult:
    """Return what a report needs of a trial."""
    if isinstance(found, str):
        return TrialResult(
            seed=trial.seed, outcome=None, failure=found, wall_s=wall_s, end_reason=FAILED, attempts=attempts
        )
    return TrialResult(
        seed=trial.seed, outcome=found.outcome, wall_s=wall_s, end_reason=found.end_reason, attempts=attempts
    )


def record_of(trial: Trial, experiment: str, found: Measurement | str) -> Record:
    """Return ``result.json`` of a trial, or of one that failed."""
    name = trial_id(trial)
    if isinstance(found, str):
        return Record(id=name, experiment=experiment, trial=trial, outcome=None, failure=found, end_reason=FAILED)
    return Record(
        id=name,
        experiment=experiment,
        trial=trial,
        outcome=found.outcome,
        end_reason=found.end_reason,
        onboard=dict(found.onboard),
        truth=dict(found.truth),
        per_robot={key: dict(values) for key, values in found.per_robot.items()},
    )


def not_kept(result: TrialResult, out: Path, error: OSError) -> TrialResult:
    """Return the result of a trial whose directory could not be written: it failed, and is run again another time."""
    failure = f"{out}: cannot keep the trial: {error.strerror or error}"
    return msgspec.structs.replace(result, outcome=None, failure=failure, end_reason=FAILED)


# ---------------------------------------------------------------------------------------------------- writing
def write_trial(out: Path, record: Record, about: Provenance, found: Measurement | str | None = None) -> Path:
    """Write the directory of a trial and return it; one with an outcome stays as it is, a failed one is replaced.

    Raises
    ------
    OSError
        The disk is full or not writable; nothing is left of it.
    """
    with _beside(out, record.id) as folder:
        fill(folder, record, about, found)
    return out / TRIALS / record.id


def fill(folder: Path, record: Record, about: Provenance, found: Measurement | str | None = None) -> None:
    """Write the files of a trial into a folder."""
    (folder / TRIAL_FILE).write_text(launch_text(record.trial, record.experiment), "utf-8")
    (folder / RESULT_FILE).write_bytes(_pretty(record))
    (folder / PROVENANCE_FILE).write_bytes(_pretty(about))
    if not isinstance(found, Measurement):
        return
    if found.trajectory is not None:
        found.trajectory.save(folder / TRAJECTORY_FILE)
    if found.contacts is not None:
        found.contacts.save(folder / CONTACTS_FILE)
    if found.coverage is not None:
        frame, covered = found.coverage
        numbers = np.array([frame.origin_x_m, frame.origin_y_m, frame.cell_m, frame.rows, frame.columns])
        np.savez_compressed(folder / COVERAGE_FILE, frame=numbers, covered=covered)


def files_of(record: Record, about: Provenance, found: Measurement | str | None) -> Files:
    """Return the files of a trial, for a machine that shares no disk with the folder of the results."""
    with TemporaryDirectory() as path:
        fill(Path(path), record, about, found)
        return {each.name: each.read_bytes() for each in sorted(Path(path).iterdir())}


def write_files(out: Path, name: str, files: Files) -> None:
    """Write the directory of trial `name`; as `write_trial`."""
    with _beside(out, name) as folder:
        for file, data in files.items():
            (folder / file).write_bytes(data)


@contextmanager
def _beside(out: Path, name: str) -> Iterator[Path]:
    """Yield a folder that takes the place of trial `name` at the end, or is gone if anything goes wrong."""
    place = out / TRIALS / name
    folder = place.with_name(f".{name}-{socket.gethostname()}-{os.getpid()}")
    old = folder.with_name(f"{folder.name}{OLD}")
    place.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    try:
        yield folder
        if place.exists():
            kept = read_record(place)
            if kept is not None and kept.outcome is not None:
                return
            place.rename(old)  # one directory cannot replace another in one step; cut off here, the trial runs again
        folder.rename(place)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.rmtree(old, ignore_errors=True)


def _pretty(value: msgspec.Struct) -> bytes:
    return msgspec.json.format(msgspec.json.encode(value), indent=2) + b"\n"


# ---------------------------------------------------------------------------------------------------- reading
def read_record(folder: Path) -> Record | None:
    """Return the record of a trial's directory; None: there is none that can be read, so the trial is to be run."""
    try:
        return msgspec.json.decode((folder / RESULT_FILE).read_bytes(), type=Record)
    except (OSError, msgspec.DecodeError, ValueError):  # ValueError: not UTF-8
        return None


def read_kept(out: Path, trial: Trial) -> TrialResult | None:
    """Return the result of a trial that has an outcome in this folder already."""
    folder = out / TRIALS / trial_id(trial)
    record = read_record(folder) if folder.is_dir() else None
    if record is None or record.outcome is None or record.trial != trial:
        return None
    about = read_provenance(out, trial)
    return TrialResult(
        seed=trial.seed,
        outcome=record.outcome,
        wall_s=about.wall_s,
        end_reason=record.end_reason,
        attempts=about.attempts,
    )


def read_provenance(out: Path, trial: Trial) -> Provenance:
    """Return where a trial's figures come from; empty when that cannot be read."""
    try:
        path = out / TRIALS / trial_id(trial) / PROVENANCE_FILE
        return msgspec.json.decode(path.read_bytes(), type=Provenance)
    except (OSError, msgspec.DecodeError, ValueError):
        return Provenance()


def sweep(out: Path) -> int:
    """Remove what dead processes left half-written; return how many.

    Raises
    ------
    ConfigError
        The folder cannot be made or read.
    """
    try:
        (out / TRIALS).mkdir(parents=True, exist_ok=True)
        found = [each for each in (out / TRIALS).iterdir() if each.name.startswith(".") and _is_dead(each)]
    except OSError as error:
        raise ConfigError(f"cannot use the folder: {error.strerror or error}", where=str(out)) from error
    for each in found:
        shutil.rmtree(each, ignore_errors=True)
    return len(found)


def _is_dead(folder: Path) -> bool:
    name, _, pid = folder.name.removesuffix(OLD).rpartition("-")
    if not name.endswith(f"-{socket.gethostname()}") or not pid.isdecimal():
        with suppress(OSError):
            return wall_time_s() - folder.stat().st_mtime > OLD_S
        return False
    try:
        os.kill(int(pid), 0)
    except ProcessLookupError:
        return True
    except PermissionError:
        return False
    return int(pid) == os.getpid()
