"""Implements `fullswarm results`."""

from __future__ import annotations

import math
import sqlite3
import sys
import tempfile
import webbrowser
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fullswarm import output
from fullswarm.errors import ConfigError, did_you_mean
from fullswarm.evaluate.experiment.plan import fits
from fullswarm.evaluate.results.compare import Comparison, MetricComparison, compare_by
from fullswarm.evaluate.results.compare import compare as compare_folders
from fullswarm.evaluate.results.export import WRITERS, long, wide, write_table
from fullswarm.evaluate.results.folder import Folder, StoredTrial, find_trial, older_text, read_folder
from fullswarm.evaluate.results.index import INDEX_FILE, open_index, rebuild
from fullswarm.evaluate.results.quantities import SHARES, Key, in_order, is_dull, range_of, values_of
from fullswarm.evaluate.results.statistics import Described, describe, wilson
from fullswarm.evaluate.scenarios.maps import coverage_map, occupied_cells, write_map
from fullswarm.evaluate.trial_folder import TRAJECTORY_FILE, read_coverage, read_trajectory
from fullswarm.units import unit_of

STDOUT = Path("-")
ALIKE = ("label", "scenario", "robots", "engine", "limits", "network", "noise_m", "noise_rad")
CELLS = """
SELECT "group", behaviour, parameters, label, scenario, robots, engine, limits, network, noise_m, noise_rad,
    count(*) AS trials, sum(failed) AS failed,
    sum(NOT failed AND safe.value = 0) AS unsafe_starts,
    sum(CASE WHEN safe.value THEN events.value END) AS collisions,
    avg(CASE WHEN safe.value THEN arrived.value END) AS arrived_fraction,
    sum(simulated.value) AS simulated_s, sum(wall_s) AS wall_s
FROM trials
LEFT JOIN metrics AS events ON events.trial = id AND events.source = 'outcome' AND events.name = 'events'
LEFT JOIN metrics AS arrived ON arrived.trial = id AND arrived.source = 'outcome' AND arrived.name = 'arrived_fraction'
LEFT JOIN metrics AS safe ON safe.trial = id AND safe.source = 'outcome' AND safe.name = 'safe_start'
LEFT JOIN metrics AS simulated ON simulated.trial = id AND simulated.source = 'outcome'
    AND simulated.name = 'simulated_s'
GROUP BY "group", label, scenario, robots, engine, limits, network, noise_m, noise_rad
ORDER BY engine, limits, network, scenario, robots, label, "group"
"""


# ---------------------------------------------------------------------------------------------------- looking
def list_cells(folder: Path, as_json: bool) -> int:
    """Print the cells with their counts, from the index."""
    with open_index(folder) as connection:
        connection.row_factory = sqlite3.Row
        cells = [dict(row) for row in connection.execute(CELLS)]
        problems = [dict(row) for row in connection.execute("SELECT directory, reason FROM problems")]
        older = int(connection.execute("SELECT value FROM meta WHERE key = 'older'").fetchone()[0])
    if older:
        output.progress(older_text(older))
    for cell in cells:
        cell["parameters"] = msgspec.json.decode(cell["parameters"])
    if as_json:
        output.data_json({"cells": cells, "problems": problems})
        return 0
    alike = {tuple(cell[name] for name in ALIKE) for cell in cells}
    grouped = len(alike) < len(cells)  # some differ by nothing else
    texts = (*["group"] * grouped, "behaviour", "scenario", "engine", "limits", "network")
    numbers = ("N", "trials", "failed", "apart", "coll.", "arrived %", "simulated s")
    table = output.plain_table(*texts, numbers=numbers)
    for cell in cells:
        table.add_row(*[cell["group"]] * grouped, *_cell_row(cell), style="red" if cell["failed"] else None)
    output.data_table(table, into_file=130)
    for problem in problems:
        output.progress(f"unreadable: {folder / problem['directory']}: {problem['reason']}")
    return 0


def _cell_row(cell: dict[str, Any]) -> tuple[str, ...]:
    collisions, arrived = cell["collisions"], cell["arrived_fraction"]
    return (
        *(str(cell[name]) for name in ("label", "scenario", "engine", "limits", "network", "robots", "trials")),
        str(cell["failed"]),
        str(cell["unsafe_starts"] or 0),
        "-" if collisions is None else f"{collisions:.0f}",
        "-" if arrived is None else f"{100.0 * arrived:.1f}",
        f"{cell['simulated_s'] or 0.0:.0f}",
    )


def show(folder: Path, what: str, as_json: bool) -> int:
    """Print one trial by its id or the beginning of it, or all trials that fit a filter together."""
    read = _read(folder)
    ids = [each for each in read.trials if each.record.id == what]
    if ids:
        return _show_trial(ids[0], as_json)
    trials = [each for each in read.trials if _fits(each, what)]
    if not trials:
        known = [each.record.id for each in read.trials]
        hint = did_you_mean(what, known) if len(known) < 10 or "=" not in what else "fullswarm results list shows them"
        raise ConfigError(f"no trial fits '{what}'", where=str(folder), hint=hint)
    return _show_trial(trials[0], as_json) if len(trials) == 1 else _show_sample(trials, what, as_json)


def _show_trial(stored: StoredTrial, as_json: bool) -> int:
    record = stored.record
    if as_json:
        document = {"path": str(stored.path), "record": record, "provenance": stored.provenance}
        output.data_json(msgspec.json.decode(msgspec.json.encode(document)))
        return 0
    output.data(f"{record.trial.label}\n{stored.path}\nend: {record.end_reason or '-'}")
    if record.failure:
        output.data(f"failure: {record.failure}")
    table = output.plain_table("source", "quantity", numbers=("value",))
    table.add_column("unit")
    values = values_of(record)
    for key in in_order(values):
        table.add_row(*key, f"{values[key]:.6g}", unit_of(key[1]))
    output.data_table(table, into_file=130)
    how = stored.provenance
    facts = (how.started, f"{how.wall_s:.1f} s", how.host, f"fullswarm {how.fullswarm}", how.git, how.runner)
    output.data(" · ".join(filter(None, facts)))
    return 0


def _show_sample(trials: list[StoredTrial], what: str, as_json: bool) -> int:
    values = [values_of(each.record) for each in trials if each.counts]
    found = [
        (key, _described(key, [each[key] for each in values if key in each]))
        for key in in_order(key for each in values for key in each)
    ]
    failed = sum(each.record.outcome is None for each in trials)
    counts = {"trials": len(trials), "failed": failed, "unsafe_starts": len(trials) - failed - len(values)}
    if as_json:
        rows = [{"source": key[0], "name": key[1], "unit": unit_of(key[1]), **_plain(each)} for key, each in found]
        output.data_json({"filter": what, **counts, "ids": [each.record.id for each in trials], "metrics": rows})
        return 0
    output.data(", ".join(f"{count} {name.replace('_', ' ')}" for name, count in counts.items()))
    numbers = ("trials", "mean", "95 % interval", "median", "95 % interval", "quartiles", "least", "most")
    table = output.plain_table("source", "quantity", "unit", numbers=numbers)
    for key, each in found:
        if is_dull(key[1]):
            continue
        table.add_row(
            *key,
            unit_of(key[1]),
            str(each.count),
            _number(each.mean),
            _interval(each.low, each.high),
            _number(each.median),
            _interval(each.median_low, each.median_high),
            f"{_number(each.lower_quartile)} to {_number(each.upper_quartile)}",
            _number(each.minimum),
            _number(each.maximum),
        )
    output.data_table(table, into_file=175)
    return 0


def _fits(stored: StoredTrial, what: str) -> bool:
    fields = {**stored.record.trial.cell.fields(), "seed": stored.record.trial.seed}
    parts = [part.strip() for part in what.split(",") if part.strip()]
    return stored.record.id.startswith(what) or (bool(parts) and all(fits(fields, part) for part in parts))


# ---------------------------------------------------------------------------------------------------- making
def export(folder: Path, form: str, out: Path | None, as_long: bool) -> int:
    """Write a table of all trials; ``-`` prints csv."""
    if form not in WRITERS:
        raise ConfigError(f"there is no format '{form}'", where="--format", hint=did_you_mean(form, WRITERS))
    table = (long if as_long else wide)(_read(folder).trials)
    if out == STDOUT:
        if form != "csv":
            raise ConfigError(f"{form} cannot be printed", where="--out -", hint="name a file, or use --format csv")
        with tempfile.TemporaryDirectory() as place:
            write_table(table, Path(place) / "table", form)
            sys.stdout.write((Path(place) / "table").read_text("utf-8"))
        return 0
    path = out or folder / f"results.{form}"
    write_table(table, path, form)
    output.data(str(path))
    return 0


def export_mlflow(folder: Path, target: str) -> int:
    """Write all trials into MLflow and print what was done."""
    from fullswarm.evaluate.results.mlflow import export_mlflow as write

    done = write(_read(folder), target)
    output.data(f"{done.experiment}: {done.new} runs written, {done.replaced} replaced, {done.kept} unchanged")
    return 0


def report(folder: Path, open_it: bool, plots: Path | None) -> int:
    """Write the report and print its name."""
    from fullswarm.evaluate.results.report import STEPS, write_plots, write_report

    with output.Progress("steps", STEPS, at_once=True) as progress:
        path = write_report(folder, progress.parts)
    output.data(str(path))
    _print_problems(read_folder(folder))
    if plots is not None:
        for each in write_plots(folder, plots):
            output.data(str(each))
    if open_it and not webbrowser.open(path.resolve().as_uri()):
        output.progress("no browser to open it with")
    return 0


def index(folder: Path, as_json: bool) -> int:
    """Make the index anew."""
    read = rebuild(folder)
    if as_json:
        problems = [{"directory": str(each.path), "reason": each.reason} for each in read.problems]
        output.data_json({"index": str(folder / INDEX_FILE), "trials": len(read.trials), "problems": problems})
    else:
        output.data(f"{folder / INDEX_FILE}: {len(read.trials)} trials, {len(read.failed)} of them failed")
        _print_problems(read)
    return 1 if read.problems else 0


def compare(words: list[str], by: str | None, with_cells: bool, as_json: bool) -> int:
    """Print a paired comparison."""
    wanted, usage = (2, "compare A B") if by is None else (3, "compare FOLDER A B --by FIELD")
    if len(words) != wanted:
        raise ConfigError(f"{len(words)} words instead of {wanted}", hint=f"fullswarm results {usage}")
    if by is None:
        found = compare_folders(Path(words[0]), Path(words[1]), _trials)
    else:
        found = compare_by(Path(words[0]), by, words[1], words[2], _trials)
    if as_json:
        output.data_json(found.to_json())
        return 0
    _print_comparison(found, with_cells)
    return 0


def _print_comparison(found: Comparison, with_cells: bool) -> None:
    output.data(f"A: {found.a}\nB: {found.b}\n{found.pairs} pairs; alone: {found.alone_a} of A, {found.alone_b} of B")
    numbers = ("pairs", "A", "B", "B - A", "95 % interval", "dz", "r", "p rank", "p Holm", "p sign")
    table = output.plain_table(*["cell"] * with_cells, "source", "quantity", "unit", numbers=numbers)
    for each in found.overall + (found.cells if with_cells else []):
        if is_dull(each.name):
            continue
        row = _comparison_row(each)
        table.add_row(*row if with_cells else row[1:])
    output.data_table(table, into_file=190 if with_cells else 140)
    output.data(
        "interval: Student's t; dz: Cohen's; r: rank-biserial; p rank, p sign: signed-rank and sign test, two-sided;\n"
        f"p Holm: p rank, corrected for the rows of {'all cells, or of all together' if with_cells else 'this table'}"
    )


def _comparison_row(each: MetricComparison) -> tuple[str, ...]:
    result = each.result
    return (
        each.cell or "all",
        each.source,
        each.name,
        each.unit,
        str(result.count),
        _number(result.mean_a),
        _number(result.mean_b),
        _number(result.mean_difference),
        _interval(result.low, result.high),
        "-" if result.dz is None else f"{result.dz:.2f}",
        f"{result.rank_biserial:+.2f}",
        f"{result.wilcoxon_p:.3g}",
        f"{each.wilcoxon_holm_p:.3g}",
        f"{result.sign_p:.3g}",
    )


# ---------------------------------------------------------------------------------------------------- helpers
def _read(folder: Path) -> Folder:
    """Return the trials; print on stderr what cannot be read."""
    read = read_folder(folder)
    _print_problems(read)
    return read


def _trials(folder: Path) -> list[StoredTrial]:
    return _read(folder).trials


def _print_problems(read: Folder) -> None:
    for each in read.problems:
        output.progress(f"unreadable: {each.path}: {each.reason}")
    if read.older:
        output.progress(older_text(read.older))


def _described(key: Key, values: list[float]) -> Described:
    least, most = range_of(key)
    described = describe(values, at_least=least, at_most=most)
    if key not in SHARES:
        return described
    low, high = wilson(sum(value > 0.0 for value in values), len(values))
    return replace(described, low=low, high=high)


def _plain(described: Described) -> dict[str, float | None]:
    """Return a description for JSON, which has no NaN."""
    return {name: None if math.isnan(value) else value for name, value in asdict(described).items()}


def _number(value: float) -> str:
    return "-" if math.isnan(value) else f"{value:.4g}"


def _interval(low: float, high: float) -> str:
    return "-" if math.isnan(low) else f"{low:.4g} to {high:.4g}"


def write_coverage_map(folder: Path, trial: str, out: Path | None) -> int:
    """Write the map of a trial and print both files' names.

    Raises
    ------
    ConfigError
        No such trial, it has no grid (a failed one, a fleet's), or the map cannot be written.
    """
    place = find_trial(folder, trial)
    frame, covered = read_coverage(place)
    boxes = read_trajectory(place).boxes if (place / TRAJECTORY_FILE).exists() else np.zeros((0, 5))
    occupied = occupied_cells(frame, tuple((x, y, size_x, size_y, yaw) for x, y, size_x, size_y, yaw in boxes.tolist()))
    output.data("\n".join(map(str, write_map(coverage_map(frame, covered, occupied), out or place / "coverage"))))
    return 0
