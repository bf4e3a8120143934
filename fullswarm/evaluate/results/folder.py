"""Reads and prepares a results folder: one directory per trial is the truth, all else can be made again of it.

<out>/experiment.json   an `Asked`: what was asked for; the same for all shards of one experiment
      trials/           see `fullswarm.evaluate.trial_folder`
      report.html       when a run has come to its end
"""

from __future__ import annotations

import difflib
import fnmatch
import hashlib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import msgspec

import fullswarm
from fullswarm.clock import wall_time_s
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.experiment import Experiment, Trial, TrialResult, arena_of
from fullswarm.evaluate.provenance import Provenance, commit
from fullswarm.evaluate.trial_folder import (
    FORMAT,
    PROVENANCE_FILE,
    RESULT_FILE,
    TRAJECTORY_FILE,
    TRIALS,
    Record,
    decode,
    read_kept,
    read_provenance,
    sweep,
    trial_id,
    whole_file,
)

LOCKSTEP = "lockstep"
EXPERIMENT_FILE = "experiment.json"
NAMED = 5
"""So many trials are named when the choice is not clear."""


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
    """Return a digest that differs between versions of an experiment: its file, and those of its scenarios.

    What is kept of the trials makes no other experiment.
    """
    digest = hashlib.sha256(experiment.model_dump_json(exclude={"evidence"}).encode())
    for name in sorted({name for group in experiment.groups for name in group.scenarios}):
        digest.update(f"{name}\n{_arena(name)}\n".encode())
    return digest.hexdigest()


def _arena(scenario: str) -> str:
    try:
        return arena_of(scenario)
    except ConfigError:
        return ""  # of a cell that is not asked for: `plan` has read the others


def open_folder(out: Path, asked: Asked, trials: Iterable[Trial]) -> tuple[Asked, int]:
    """Make the folder ready for `trials` and write down in it what was asked for.

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
    with whole_file(out / EXPERIMENT_FILE) as part:
        part.write_bytes(msgspec.json.format(msgspec.json.encode(now), indent=2) + b"\n")
    return now, swept


def read_asked(out: Path) -> Asked | None:
    """Return what was asked for; None: nothing yet.

    Raises
    ------
    ConfigError
        The file cannot be read, or is another one.
    """
    path = out / EXPERIMENT_FILE
    if not path.exists():
        return None
    try:
        return decode(path, Asked)
    except ConfigError as error:
        raise ConfigError(
            f"not the file of an experiment: {error.what}", where=str(path), hint="remove it, the trials stay"
        ) from error


def kept_of(out: Path, trials: Sequence[Trial]) -> dict[Trial, TrialResult]:
    """Return the results of the trials that have an outcome already."""
    found = ((trial, read_kept(out, trial)) for trial in trials)
    return {trial: result for trial, result in found if result is not None}


def other_code(out: Path, trials: Iterable[Trial]) -> Counter[str]:
    """Return how many of these trials were run by which other version or commit of fullswarm."""
    found = ((about.fullswarm, about.git) for about in (read_provenance(out, trial) for trial in trials))
    other = Counter(each for each in found if any(each) and each != (fullswarm.__version__, commit()))
    return Counter({" ".join(("fullswarm", *filter(None, each))): count for each, count in other.items()})


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
            asked = decode(out / EXPERIMENT_FILE, Asked)
        except ConfigError as error:
            problems.append(Problem(out / EXPERIMENT_FILE, str(error)))
    there = trial_paths(out)
    paths = _listed(there, asked.trials)
    for path in paths:
        provenance = Provenance()
        try:
            record = decode(path / RESULT_FILE, Record)
            if record.format != FORMAT:
                raise ConfigError(f"its format is '{record.format}', not '{FORMAT}'")
            if record.id != path.name:
                raise ConfigError(f"its {RESULT_FILE} is of another trial: {record.id}")
        except ConfigError as error:
            problems.append(Problem(path, str(error)))
            continue
        try:
            provenance = decode(path / PROVENANCE_FILE, Provenance)
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
    """Return the note on trials that no figure counts."""
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


def find_trial(folder: Path, wanted: str = "") -> Path:
    """Return a trial's directory: `folder` itself, or the one in an experiment's folder whose id begins so.

    Raises
    ------
    ConfigError
        There is none, or more than one.
    """
    if not folder.is_dir():
        raise ConfigError("no such folder", where=str(folder))
    trials = folder / TRIALS
    if not trials.is_dir():
        if (folder / TRAJECTORY_FILE).exists() or (folder / RESULT_FILE).exists():
            return folder
        raise ConfigError(
            "neither a trial's folder nor an experiment's",
            where=str(folder),
            hint=f"a trial's holds {TRAJECTORY_FILE}, an experiment's {TRIALS}/",
        )
    names = sorted(each.name for each in trials.iterdir() if each.is_dir() and not each.name.startswith("."))
    if wanted in names:
        return trials / wanted
    found = [name for name in names if fnmatch.fnmatchcase(name, f"{wanted}*")]
    if len(found) == 1:
        return trials / found[0]
    where = f"--trial {wanted}" if wanted else str(folder)
    if not found:
        near = did_you_mean(wanted, names) if len(names) <= NAMED else _near(wanted, names)
        raise ConfigError("no such trial", where=where, hint=near)
    some = ", ".join(found[:NAMED]) + (", …" if len(found) > NAMED else "")
    raise ConfigError(f"{len(found)} trials fit", where=where, hint=f"name one with --trial: {some}")


def _near(wanted: str, names: list[str]) -> str:
    """Return a hint that does not name hundreds."""
    near = difflib.get_close_matches(wanted, names, n=1, cutoff=0.4)
    return f"did you mean '{near[0]}'?" if near else f"there are {len(names)}, the first is '{names[0]}'"


def _order(stored: StoredTrial) -> tuple[object, ...]:
    trial = stored.record.trial
    cell = trial.cell
    return cell.engine, cell.limits, cell.network, cell.scenario, cell.robots, cell.label, trial.seed, stored.record.id
