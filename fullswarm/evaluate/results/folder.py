"""Read a results folder: one directory per trial is the truth, everything else can be made again of it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import msgspec

from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment.record import FORMAT, PROVENANCE_FILE, RESULT_FILE, TRIALS, Provenance, Record

T = TypeVar("T")
EXPERIMENT_FILE = "experiment.json"
"""What was asked for; the supervisor writes it beside the trials."""


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


class Asked(msgspec.Struct, frozen=True):
    """What this package needs of ``experiment.json``."""

    name: str = ""
    description: str = ""
    seeds: str | None = None  # the options of the newest run
    cells: tuple[str, ...] = ()
    small: bool = False
    engine: str | None = None
    how: str = ""  # "lockstep", "live", "live create", "fleet"
    file: str = ""  # of the experiment, or its name in the package
    network: str | None = None
    fleet: str | None = None  # its file
    trials: tuple[str, ...] = ()  # ids of all that were asked for


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
