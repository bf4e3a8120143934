"""Reads and prepares a results folder: one directory per trial is the truth, all else can be made again of it.

<out>/experiment.json   an `Asked`: what was asked for; the same for all shards of one experiment
      trials/           see `fullswarm.evaluate.trial_folder`
      report.html       when a run has come to its end
"""

from __future__ import annotations

import hashlib
import os
import socket
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import TypeVar

import msgspec

import fullswarm
from fullswarm.clock import wall_time_s
from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment import Experiment, Trial, TrialResult, arena_of
from fullswarm.evaluate.provenance import Provenance, commit
from fullswarm.evaluate.trial_folder import (
    FORMAT,
    PROVENANCE_FILE,
    RESULT_FILE,
    TRIALS,
    Record,
    read_kept,
    read_provenance,
    sweep,
    trial_id,
)

LOCKSTEP = "lockstep"
EXPERIMENT_FILE = "experiment.json"


class Asked(msgspec.Struct, frozen=True, kw_only=True):
    """``experiment.json``: what was asked for."""

    format: str = "fullswarm.experiment/1"
    name: str = ""
    description: str = ""
    configuration: str = ""  # sha256 of the experiment and its scenarios as they were read
    started: str = ""  # the newest run, ISO 8601, UTC
    seeds: str | None = None  # the options of the newest run, None: as in the file
    cells: tuple[str, ...] = ()
    small: bool = False
    engine: str | None = None
    how: str = LOCKSTEP  # "live", "live create", "fleet": their figures do not go together
    file: str = ""  # of the experiment, or its name in the package
    network: str | None = None
    fleet: str | None = None  # its file
    trials: tuple[str, ...] = ()  # ids of all trials that were ever asked for of this configuration


def configuration_of(experiment: Experiment) -> str:
    """Return what tells one version of an experiment from another: its file, and those of its scenarios."""
    digest = hashlib.sha256(experiment.model_dump_json().encode())
    for name in sorted({name for group in experiment.groups for name in group.scenarios}):
        digest.update(f"{name}\n{_arena(name)}\n".encode())
    return digest.hexdigest()


def _arena(scenario: str) -> str:
    try:
        return arena_of(scenario)
    except ConfigError:
        return ""  # of a cell that is not asked for: `plan` has read the others


def open_folder(out: Path, asked: Asked, trials: Iterable[Trial]) -> tuple[Asked, int]:
    """Make the folder ready for `trials` and say in it what was asked for.

    Returns
    -------
    tuple[Asked, int]
        What stands there now, and how many half-written trials were removed.

    Raises
    ------
    ConfigError
        It holds another experiment, or trials that were run in another way; or it cannot be written.
    """
    swept = sweep(out)
    before = read_asked(out)
    ids = tuple(trial_id(trial) for trial in trials)
    if before is not None:
        if before.name != asked.name:
            raise ConfigError(
                f"the folder holds the experiment '{before.name}'", where=str(out), hint="use another one with --out"
            )
        if before.how != asked.how:
            raise ConfigError(
                f"its trials were run in another way ({before.how}, not {asked.how})",
                where=str(out),
                hint="use another folder with --out",
            )
        if before.configuration == asked.configuration:
            ids = tuple(dict.fromkeys((*before.trials, *ids)))
    started = datetime.fromtimestamp(wall_time_s(), UTC).isoformat(timespec="seconds")
    now = msgspec.structs.replace(asked, trials=ids, started=started)
    _write(out / EXPERIMENT_FILE, msgspec.json.format(msgspec.json.encode(now), indent=2) + b"\n")
    return now, swept


def read_asked(out: Path) -> Asked | None:
    """Return what was asked for; None: nothing yet.

    Raises
    ------
    ConfigError
        The file cannot be read, or is another one.
    """
    path = out / EXPERIMENT_FILE
    try:
        asked = msgspec.json.decode(path.read_bytes(), type=Asked)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(f"cannot read it: {error.strerror or error}", where=str(path)) from error
    except (msgspec.DecodeError, ValueError) as error:  # ValueError: not UTF-8
        raise ConfigError(
            f"not the file of an experiment: {error}", where=str(path), hint="remove it, the trials stay"
        ) from error
    return asked


def kept_of(out: Path, trials: Sequence[Trial]) -> dict[Trial, TrialResult]:
    """Return the results of the trials that have an outcome already."""
    found = ((trial, read_kept(out, trial)) for trial in trials)
    return {trial: result for trial, result in found if result is not None}


def other_code(out: Path, trials: Iterable[Trial]) -> Counter[str]:
    """Return how many of these trials were run by which other version or commit of fullswarm."""
    found = ((about.fullswarm, about.git) for about in (read_provenance(out, trial) for trial in trials))
    other = Counter(each for each in found if any(each) and each != (fullswarm.__version__, commit()))
    return Counter({" ".join(("fullswarm", *filter(None, each))): count for each, count in other.items()})


def _write(path: Path, data: bytes) -> None:
    part = path.with_name(f".{path.name}-{socket.gethostname()}-{os.getpid()}")
    try:
        part.write_bytes(data)
        part.replace(path)
    except OSError as error:
        part.unlink(missing_ok=True)
        raise ConfigError(f"cannot write it: {error.strerror or error}", where=str(path)) from error


T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class StoredTrial:
    """A trial's directory: what came of it, and how that was found."""

    record: Record
    provenance: Provenance
    path: Path  # the directory

    @property
    def counts(self) -> bool:
        """Whether its figures belong to the cell's: it has an outcome and began in the safe set."""
        return self.record.outcome is not None and self.record.outcome.safe_start


@dataclass(frozen=True, slots=True)
class Problem:
    """Something in the folder that cannot be read."""

    path: Path
    reason: str


@dataclass(frozen=True, slots=True)
class Folder:
    """A results folder."""

    path: Path
    trials: list[StoredTrial]
    problems: list[Problem]
    asked: Asked = field(default_factory=Asked)
    older: int = 0  # trials that experiment.json does not list: the experiment has changed since

    @property
    def missing(self) -> list[str]:
        """Ids of trials that were asked for and have no directory yet."""
        there = {each.path.name for each in self.trials} | {each.path.name for each in self.problems}
        return [name for name in self.asked.trials if name not in there]

    @property
    def failed(self) -> list[StoredTrial]:
        """Trials without an outcome."""
        return [each for each in self.trials if each.record.outcome is None]


def read_records(out: Path) -> list[StoredTrial]:
    """Return the trials of a results folder, sorted by cell and seed; unreadable ones are left out.

    Raises
    ------
    ConfigError
        The folder holds no trials at all.
    """
    return read_folder(out).trials


def read_folder(out: Path) -> Folder:
    """Return the trials of a results folder and what could not be read.

    A trial whose provenance is broken still counts, because nothing in it may change a figure; it is named too.
    When ``experiment.json`` lists trials, the others are of older settings: they are counted, and not read.

    Raises
    ------
    ConfigError
        The folder holds no trials at all.
    """
    trials: list[StoredTrial] = []
    problems: list[Problem] = []
    asked = Asked()
    if (out / EXPERIMENT_FILE).is_file():
        try:
            asked = _read(out / EXPERIMENT_FILE, Asked)
        except ConfigError as error:
            problems.append(Problem(out / EXPERIMENT_FILE, str(error)))
    there = trial_paths(out)
    paths = _listed(there, asked.trials)
    for path in paths:
        provenance = Provenance()
        try:
            record = _read(path / RESULT_FILE, Record)
            if record.format != FORMAT:
                raise ConfigError(f"its format is '{record.format}', not '{FORMAT}'")
            if record.id != path.name:
                raise ConfigError(f"its {RESULT_FILE} is of another trial: {record.id}")
        except ConfigError as error:
            problems.append(Problem(path, str(error)))
            continue
        try:
            provenance = _read(path / PROVENANCE_FILE, Provenance)
        except ConfigError as error:
            problems.append(Problem(path, f"{error}; the trial counts"))
        trials.append(StoredTrial(record, provenance, path))
    if not there and not problems:
        raise ConfigError(
            f"no trials in '{TRIALS}'", where=str(out), hint="fullswarm experiment run NAME --out FOLDER makes them"
        )
    trials.sort(key=_order)
    return Folder(out, trials, problems, asked, older=len(there) - len(paths))


def older_in(out: Path, listed: Iterable[str]) -> int:
    """Return how many trials stand in the folder that are not `listed`; `ConfigError` as `trial_paths`."""
    there = trial_paths(out)
    return len(there) - len(_listed(there, listed))


def _listed(paths: list[Path], names: Iterable[str]) -> list[Path]:
    wanted = set(names)
    return [path for path in paths if path.name in wanted] if wanted else paths  # joined shards may have no list


def older_text(count: int) -> str:
    """Return what is to be said of trials that no figure counts."""
    are = "1 trial of older settings is" if count == 1 else f"{count} trials of older settings are"
    return f"{are} in no figure; another --out keeps them apart"


def trial_paths(out: Path) -> list[Path]:
    """Return the directories of the trials, by name; those that begin with a dot are not finished.

    Raises
    ------
    ConfigError
        The folder holds no trials, or cannot be read.
    """
    try:
        return sorted(each for each in (out / TRIALS).iterdir() if each.is_dir() and not each.name.startswith("."))
    except (FileNotFoundError, NotADirectoryError) as error:
        raise ConfigError(
            f"not a results folder: it has no directory '{TRIALS}'",
            where=str(out),
            hint="fullswarm experiment run NAME --out FOLDER makes one",
        ) from error
    except OSError as error:
        raise ConfigError(f"cannot read the folder: {error.strerror or error}", where=str(out)) from error


def _read(path: Path, kind: type[T]) -> T:
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except OSError as error:
        raise ConfigError(f"cannot read {path.name}: {error.strerror or error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path.name}: {error}") from error


def _order(stored: StoredTrial) -> tuple[object, ...]:
    trial = stored.record.trial
    cell = trial.cell
    return cell.engine, cell.limits, cell.network, cell.scenario, cell.robots, cell.label, trial.seed, stored.record.id
