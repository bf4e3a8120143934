"""The folder of an experiment: what was asked for, and the trials that are in it already.

<out>/experiment.json   an `Asked`; the same for all shards of one experiment
      trials/           see `fullswarm.evaluate.experiment.record`
      report.html       when a run has come to its end
"""

from __future__ import annotations

import hashlib
import os
import socket
from collections import Counter
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime
from pathlib import Path

import msgspec

import fullswarm
from fullswarm.clock import wall_time_s
from fullswarm.errors import ConfigError
from fullswarm.evaluate.experiment import Experiment, Trial, TrialResult, arena_of
from fullswarm.evaluate.experiment.record import trial_id
from fullswarm.evaluate.provenance import commit
from fullswarm.evaluate.trial_folder import read_kept, read_provenance, sweep

FORMAT, LOCKSTEP = "fullswarm.experiment/1", "lockstep"
EXPERIMENT_FILE = "experiment.json"


class Asked(msgspec.Struct, frozen=True, kw_only=True):
    """``experiment.json``: what was asked for."""

    format: str = FORMAT
    name: str
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
