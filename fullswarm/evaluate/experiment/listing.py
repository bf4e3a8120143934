"""Lists the experiments that can be run and how far each one is (`fullswarm experiment list`): package, files, results.

The web console runs it as a process of its own (``--to``) and shows what it writes: see decision 88.
"""

from __future__ import annotations

import heapq
import math
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec
from rich.markup import escape
from rich.table import Table

from fullswarm import output
from fullswarm.clock import MonotonicClock, wall_time_s
from fullswarm.errors import ConfigError, FullswarmError
from fullswarm.evaluate.experiment import Experiment, experiment_names, load_experiment, parse_seeds, plan
from fullswarm.evaluate.experiment.outcomes import CellResult
from fullswarm.evaluate.experiment.run import check_behaviours
from fullswarm.evaluate.experiment.watch import EXPERIMENT_FILE, ExperimentFolder, Finished, Progress, progress_of
from fullswarm.evaluate.results.report import REPORT_FILE
from fullswarm.evaluate.trial_folder import TRIALS
from fullswarm.files import replace_file
from fullswarm.runtime import Runtime

FORMAT = "fullswarm.experiments/1"
PACKAGE, FILE, FOLDER = "package", "file", "folder"
REFRESH_S = 1.0
MOST_FILES, MOST_FOLDERS = 100, 100
LARGEST_FILE = 1_000_000
MOST_PLANNED, MOST_STORED, MOST_ROBOTS = 200_000, 50_000, 5_000
"""Trials of an experiment that is listed, and of a results folder that is read; robots of a trial."""
MOST_CELLS, MOST_LAST = 12, 5
LONGEST_TEXT, LONGEST_FAULT = 300, 800


@dataclass(frozen=True, slots=True)
class Source:
    """An experiment that can be run.

    Attributes
    ----------
    id : its kind and name, unlike any other's
    source : what `experiment run` is given; empty: it can only be looked at
    out : its results folder
    fault : why it cannot be run; empty: it can
    trials, small_trials : their number, with the file's seeds
    """

    id: str
    kind: str
    name: str
    source: str
    out: str
    description: str = ""
    fault: str = ""
    trials: int = 0
    small_trials: int = 0
    seeds: str = ""
    small_seeds: str = ""


@dataclass(slots=True)
class _Results:
    """A results folder that is read again when something in it has changed."""

    folder: ExperimentFolder
    stamp: tuple[int, ...] = ()
    progress: Progress | None = None
    fault: str = ""


@dataclass(slots=True)
class Listing:
    """What can be run, and what is in the results folders.

    Parameters
    ----------
    folder : holds experiment files, and results in a folder for each; it may be missing
    wall_s : seconds since 1970, as the folder's files have them
    """

    folder: Path
    wall_s: Callable[[], float] = wall_time_s
    _files: dict[str, tuple[tuple[int, ...], Source]] = field(default_factory=dict)
    _package: tuple[Source, ...] | None = None
    _results: dict[str, _Results] = field(default_factory=dict)
    _folder_stamp: tuple[int, ...] = ()

    def entries(self) -> list[dict[str, Any]]:
        """Return all of them as they are now: files, those of the package, other results folders."""
        if self._package is None:
            self._package = tuple(_of_package(name, self.folder) for name in experiment_names())
        sources = [*self._of_files(), *self._package]
        known = {each.out for each in sources}
        sources += [_of_folder(path) for path in self._folders() if str(path) not in known]
        for gone in self._results.keys() - {each.out for each in sources}:
            del self._results[gone]
        return [self._entry(each) for each in sources]

    def _of_files(self) -> list[Source]:
        stamp = _stamp(self.folder)
        changed, self._folder_stamp = stamp != self._folder_stamp, stamp
        found: dict[str, tuple[tuple[int, ...], Source]] = {}
        for path in _named(self.folder, lambda each: each.name.endswith(".toml") and each.is_file(), MOST_FILES):
            known = self._files.get(path.name)
            stamp = _stamp(path)
            # A fault may be in a scenario's file beside it.
            if known is None or known[0] != stamp or (known[1].fault and changed):
                known = stamp, _of_file(path)
            found[path.name] = known
        self._files = found
        return [source for _, source in found.values()]

    def _folders(self) -> list[Path]:
        def holds_results(each: os.DirEntry[str]) -> bool:
            return each.is_dir() and (Path(each.path) / EXPERIMENT_FILE).is_file()

        return _named(self.folder, holds_results, MOST_FOLDERS)

    # ---------------------------------------------------------------- results
    def _entry(self, source: Source) -> dict[str, Any]:
        results = self._read(source.out)
        plain: dict[str, Any] = msgspec.to_builtins(source)
        progress = None if results is None else results.progress
        name = progress.name if progress is not None and source.kind == FOLDER else source.name
        return {
            **plain,
            "name": name[:LONGEST_TEXT],
            "fault": source.fault or ("" if results is None else results.fault),
            "results": None if progress is None else _shown(progress, Path(source.out), self.wall_s()),
        }

    def _read(self, out: str) -> _Results | None:
        path, results = Path(out), self._results.get(out)
        if results is None:
            try:
                results = self._results[out] = _Results(ExperimentFolder(path))
            except ConfigError:
                return None  # it was not run yet
        stamp = (*_stamp(path / TRIALS), *_stamp(path / EXPERIMENT_FILE))
        going = results.progress is not None and results.progress.trials_per_s is not None
        if stamp == results.stamp and not going:
            return results
        results.stamp = stamp
        try:
            if (stored := _count(path / TRIALS)) > MOST_STORED:
                raise ConfigError(f"{stored} trials are too many to show here", hint="fullswarm results report FOLDER")
            results.folder.refresh()
            results.progress, results.fault = progress_of(results.folder, self.wall_s()), ""
        except ConfigError as error:
            results.progress, results.fault = None, _fault(error)
        return results


# ---------------------------------------------------------------- sources
def _of_package(name: str, folder: Path) -> Source:
    return _described(Source(f"{PACKAGE}:{name}", PACKAGE, name, name, str(folder / name)))


def _of_file(path: Path) -> Source:
    name = path.stem
    # Of the same name as one of the package: each has results of its own.
    out = path.with_name(f"{name}-file" if name in experiment_names() else name)
    return _described(Source(f"{FILE}:{path.name}", FILE, name, str(path), str(out)))


def _of_folder(path: Path) -> Source:
    return Source(f"{FOLDER}:{path.name}", FOLDER, path.name, "", str(path))


def _described(source: Source) -> Source:
    """Return an experiment with what its file says, or with what is wrong in it."""
    try:
        if source.kind == FILE and Path(source.source).stat().st_size > LARGEST_FILE:
            raise ConfigError(f"the file has more than {LARGEST_FILE // 1000} kB", where=source.source)
        experiment = load_experiment(source.source)
        if (count := _most_trials(experiment)) > MOST_PLANNED:
            raise ConfigError(f"up to {count} trials are too many to list", where=source.source)
        if (robots := max(number for each in experiment.groups for number in each.robots)) > MOST_ROBOTS:
            raise ConfigError(f"{robots} robots in a trial are too many to list", where=source.source)
        trials = plan(experiment)
        small = plan(experiment, small=True)
        check_behaviours(trials, source.source)
    except (FullswarmError, OSError) as error:
        return replace(source, fault=_fault(error))
    return replace(
        source, name=experiment.name[:LONGEST_TEXT], description=experiment.description[:LONGEST_TEXT],
        trials=len(trials), small_trials=len(small), seeds=experiment.seeds, small_seeds=experiment.small.seeds,
    )  # fmt: skip


def _most_trials(experiment: Experiment) -> int:
    """Return a bound of the number of trials, without making them."""
    seeds = len(parse_seeds(experiment.seeds))
    return sum(
        min(seeds, each.seeds_at_most or seeds)
        * math.prod(map(len, (each.behaviours, each.scenarios, each.robots, each.engines, each.limits)))
        for each in experiment.groups
    )


def _fault(error: Exception) -> str:
    text = str(error)
    return text if len(text) <= LONGEST_FAULT else f"{text[:LONGEST_FAULT]} …"


def _named(folder: Path, wanted: Callable[[os.DirEntry[str]], bool], most: int) -> list[Path]:
    """Return the entries of a folder that are wanted, by name; hidden ones never, and not more than `most`."""
    try:
        with os.scandir(folder) as entries:
            names = [each.name for each in entries if not each.name.startswith(".") and _holds(wanted, each)]
    except OSError:
        return []
    return [folder / name for name in heapq.nsmallest(most, names)]


def _holds(wanted: Callable[[os.DirEntry[str]], bool], entry: os.DirEntry[str]) -> bool:
    try:
        return wanted(entry)
    except OSError:  # it went meanwhile, or may not be looked at
        return False


def _stamp(path: Path) -> tuple[int, ...]:
    """Return what differs when a file or a folder has changed; nothing for one that is not there."""
    try:
        status = path.stat()
    except OSError:
        return ()
    return status.st_mtime_ns, status.st_size, status.st_ino


def _count(folder: Path) -> int:
    try:
        with os.scandir(folder) as entries:
            return sum(1 for _ in entries)
    except OSError:
        return 0


# ---------------------------------------------------------------- what is shown
def _shown(progress: Progress, out: Path, now_s: float) -> dict[str, Any]:
    """Return how far the trials are, with the cells in which one ended last; unknown is null."""
    plain = progress.to_json(now_s)
    figures = ("trials", "finished", "failed", "collisions", "arrived_fraction", "over", "older")
    return {
        **{name: plain[name] for name in figures},
        "unexpected": sum(each.collisions for each in progress.cells if not each.cell.collisions_expected),
        "left_s": None if progress.left_s is None else round(progress.left_s),
        "going": progress.trials_per_s is not None and not progress.over,
        "unreadable": len(progress.unreadable),
        "cells": [_cell(each) for each in progress.cells[:MOST_CELLS]],
        "more_cells": max(0, len(progress.cells) - MOST_CELLS),
        "failures": [_failure(each) for each in progress.last[:MOST_LAST] if each.record.failure],
        "report": _report(out, progress),
    }


def _cell(each: CellResult) -> dict[str, Any]:
    cell, arrived = each.cell, each.arrived_fraction
    words = (cell.label, cell.scenario, cell.engine, cell.limits, cell.network)
    return {
        "words": " ".join(filter(None, words))[:LONGEST_TEXT],
        "behaviour": cell.label[:LONGEST_TEXT],
        "scenario": Path(cell.scenario).stem[:LONGEST_TEXT],
        "robots": cell.robots,
        "trials": len(each.results),
        "failed": len(each.failed),
        "collisions": None if each.is_empty else each.collisions,
        "expected": cell.collisions_expected,
        "arrived": None if math.isnan(arrived) else round(arrived, 4),
    }


def _failure(each: Finished) -> str:
    return f"{each.record.trial.label}: {each.record.failure}"[:LONGEST_TEXT]


def _report(out: Path, progress: Progress) -> str:
    """Return whether there is a report: ``fresh``, ``old`` when trials have ended since, or nothing."""
    try:
        made_s = (out / REPORT_FILE).stat().st_mtime
    except OSError:
        return ""
    return "old" if progress.last and progress.last[0].at_s > made_s else "fresh"


# ---------------------------------------------------------------- the command
def list_experiments(folder: Path, as_json: bool = False) -> int:
    """Print the experiments that can be run and how far each one is; return 0.

    Raises
    ------
    ConfigError
        There is no such folder.
    """
    if not folder.is_dir():
        raise ConfigError("no such folder", where=str(folder), hint="name the folder of your experiment files")
    entries = Listing(folder).entries()
    if as_json:
        output.data_json(document(entries))
    else:
        output.data_table(_table(entries), into_file=130)
    return 0


def follow(folder: Path, to: Path, parent: int, runtime: Runtime | None = None) -> int:
    """Keep the list in the file `to`, replaced at each change, until process `parent` has ended; return 0."""
    listing, runtime = Listing(folder), runtime or Runtime(MonotonicClock())
    written = b""

    def refresh() -> None:
        nonlocal written
        if os.getppid() != parent:
            runtime.stop()
            return
        data = msgspec.json.encode(document(listing.entries()))
        if data != written:
            with suppress(OSError):  # a full disk: the next time
                replace_file(to, data, mode=0o600)
                written = data

    runtime.stop_on_signals()
    runtime.every(REFRESH_S, refresh, first_s=0.0)
    runtime.run()
    return 0


def document(entries: Iterable[dict[str, Any]]) -> dict[str, Any]:
    """Return the document of ``--json``."""
    return {"format": FORMAT, "experiments": list(entries)}


def _table(entries: Iterable[dict[str, Any]]) -> Table:
    table = output.plain_table("experiment", "what", "state", numbers=("trials", "small"))
    for each in entries:
        name = each["source"] or each["out"]
        fault = each["fault"]
        counts = ("", "") if fault or not each["source"] else (str(each["trials"]), str(each["small_trials"]))
        table.add_row(escape(name), escape(fault or each["description"]), *_state(each), *counts)
    return table


def _state(each: dict[str, Any]) -> Iterator[str]:
    results = each["results"]
    if results is None:
        yield "faulty" if each["fault"] else "not run"
    elif results["over"]:
        yield f"ended, {results['failed']} failed, {results['collisions']} collisions"
    else:
        of = "" if results["trials"] is None else f" of {results['trials']}"
        yield f"{'running, ' * results['going']}{results['finished']}{of} trials"
