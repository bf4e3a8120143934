"""`fullswarm experiment run`: all trials of an experiment in worker processes, then a table or JSON."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

import msgspec
from rich.table import Table

from fullswarm.clock import MonotonicClock
from fullswarm.errors import ConfigError
from fullswarm.launch.experiment_pool import Pool, Work
from fullswarm.launch.trial import run_trial
from fullswarm.operator import output
from fullswarm.perf.experiment import CellResult, Report, Trial, TrialResult, load_experiment, plan, summarise
from fullswarm.perf.experiment.model import parse_seeds

TELL_S = 5.0
"""How often progress is told."""
TRIALS_FILE = "trials.jsonl"


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line says."""

    experiment: str
    seeds: str | None = None
    cells: tuple[str, ...] = ()
    small: bool = False
    jobs: int = 2
    timeout_s: float = 600.0
    folder: Path | None = None
    as_json: bool = False


def run(options: Options, work: Work = run_trial) -> int:
    """Run the experiment; return 0 when no trial collided and none failed, else 1.

    Raises
    ------
    ConfigError
        The experiment, a filter, the seeds or the folder are wrong.
    """
    experiment = load_experiment(options.experiment)
    trials = plan(experiment, _seeds(options.seeds), options.cells, options.small)
    kept = _read_kept(options.folder)
    left = [trial for trial in trials if _key(trial) not in kept]
    results = {trial: kept[_key(trial)] for trial in trials if _key(trial) in kept}
    if results:
        output.progress(f"{len(results)} of {len(trials)} trials are in {options.folder} already")
    clock = MonotonicClock()
    began_s = clock.now_s()
    results.update(_run_all(left, options, work))
    report = summarise(((trial, results[trial]) for trial in trials), clock.now_s() - began_s)
    if options.as_json:
        output.data_json(report.to_json())
    else:
        output.data_table(table(report), into_file=130)
        output.data(closing(report))
    return 0 if report.passed else 1


def _seeds(text: str | None) -> tuple[int, ...] | None:
    try:
        return None if text is None else parse_seeds(text)
    except ValueError as error:
        raise ConfigError(str(error), where="--seeds") from error


# ---------------------------------------------------------------------------------------------------- running
def _run_all(trials: list[Trial], options: Options, work: Work) -> Iterator[tuple[Trial, TrialResult]]:
    """Yield every trial with its result; tell on stderr how it goes, and keep each result in the folder."""
    if not trials:
        return
    clock = MonotonicClock()
    began_s = told_s = clock.now_s()
    collisions = failed = 0
    keep = None if options.folder is None else (options.folder / TRIALS_FILE).open("a", encoding="utf-8")
    try:
        with Pool(min(options.jobs, len(trials)), options.timeout_s, work, clock) as pool:
            for done, (trial, result) in enumerate(pool.run(trials), 1):
                failed += result.outcome is None
                collisions += result.outcome.events if result.outcome and result.outcome.safe_start else 0
                _tell_trouble(trial, result)
                if keep is not None and result.outcome is not None:
                    _keep(keep, trial, result)
                now_s = clock.now_s()
                if now_s - told_s >= TELL_S or done == len(trials):
                    told_s = now_s
                    left_s = (now_s - began_s) / done * (len(trials) - done)
                    output.progress(
                        f"{done} of {len(trials)} trials, {collisions} collisions, {failed} failed, "
                        f"about {left_s:.0f} s left"
                    )
                yield trial, result
    finally:
        if keep is not None:
            keep.close()


def _tell_trouble(trial: Trial, result: TrialResult) -> None:
    outcome = result.outcome
    if outcome is None:
        output.progress(f"failed: {trial.label}: {result.failure}")
    elif outcome.events:
        apart = "" if outcome.safe_start else " (it began outside the safe set)"
        output.progress(f"{outcome.events} collisions: {trial.label}{apart}")


# ---------------------------------------------------------------------------------------------------- resuming
def _key(trial: Trial) -> str:
    """Return all that a trial depends on, as text: a changed experiment does not reuse old results."""
    return msgspec.json.encode(trial).decode()


def _keep(file: TextIO, trial: Trial, result: TrialResult) -> None:
    line = msgspec.json.encode({"trial": _key(trial), "result": result}).decode()
    file.write(f"{line}\n")
    file.flush()


class _Kept(msgspec.Struct):
    """One line of the file of trials."""

    trial: str
    result: TrialResult


def _read_kept(folder: Path | None) -> dict[str, TrialResult]:
    """Return the results that a folder holds; make it when there is none."""
    if folder is None:
        return {}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / TRIALS_FILE
        lines = path.read_bytes().splitlines(keepends=True) if path.exists() else []
    except OSError as error:
        raise ConfigError(f"cannot use the folder: {error.strerror or error}", where=str(folder)) from error
    kept: dict[str, TrialResult] = {}
    for number, line in enumerate(lines, 1):
        try:
            record = msgspec.json.decode(line, type=_Kept)
        except msgspec.DecodeError as error:
            if number == len(lines):  # cut off while it was written; the trial runs again
                path.write_bytes(b"".join(lines[:-1]))
                break
            raise ConfigError(
                f"not a line of results: {error}", where=f"{path}:{number}", hint="use an empty folder"
            ) from error
        kept[record.trial] = record.result
    return kept


# ---------------------------------------------------------------------------------------------------- telling
def table(report: Report) -> Table:
    """Return the results for people."""
    view = Table(box=None, pad_edge=False)
    for name in ("behaviour", "scenario", "engine", "limits", "bad"):
        view.add_column(name, overflow="fold")
    for name in ("N", "seeds", "coll.", "robots %", "trials %", "mean s", "blocked"):
        view.add_column(name, justify="right", no_wrap=True, min_width=len(name))
    for cell in report.cells:
        view.add_row(*_row(cell), style="red" if cell.collisions or cell.failed else None)
    return view


def _row(cell: CellResult) -> tuple[str, ...]:
    of, mean_s = cell.cell, cell.mean_s()
    return (
        of.label,
        of.scenario,
        of.engine,
        of.limits,
        "network" if of.network else "noise" if of.noise_m or of.noise_rad else "",
        str(of.robots),
        str(len(cell.results)),
        str(cell.collisions),
        f"{100 * cell.arrived_fraction:.1f}",
        f"{100 * cell.all_arrived_fraction:.0f}",
        "-" if math.isnan(mean_s) else f"{mean_s:.1f}",
        str(sum(each.deadlocks for _, each in cell.outcomes)),
    )


def closing(report: Report) -> str:
    """Return the last lines for people."""
    apart = sum(len(each.results) - len(each.failed) - len(each.outcomes) for each in report.cells)
    above = sum(each.above_limits for cell in report.cells for _, each in cell.outcomes)
    counts = f"{report.trials_done} trials done, {report.trials_failed} failed, {report.collisions} collisions"
    lines = [
        f"{counts}, {above} commands above the limits, {apart} starts outside the safe set",
        f"{report.simulated_s:.0f} s simulated in {report.wall_s:.0f} s",
    ]
    for cell in report.cells:
        name = " ".join((*filter(None, _row(cell)[:5]), f"N={cell.cell.robots}"))
        if cell.colliding_seeds:
            lines.append(f"collided: {name}: seeds {cell.colliding_seeds}")
        lines += [f"failed: {name} seed {each.seed}: {each.failure}" for each in cell.failed]
    return "\n".join(lines)
