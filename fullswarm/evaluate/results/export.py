"""Results for other programs: csv, xlsx, parquet, mat. The same columns in each of them, units in their names."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from fullswarm.errors import ConfigError, MissingExtra, did_you_mean
from fullswarm.evaluate.results.folder import StoredTrial
from fullswarm.evaluate.results.quantities import in_order, values_of
from fullswarm.evaluate.trial_folder import whole_file
from fullswarm.units import unit_of

Value = str | int | float | None
EXTRA = "pip install 'fullswarm[experiments]'"
MAT_NAME = 63
"""Longest name of a field in Matlab."""
XLSX_ROWS = 1_048_575


@dataclass(frozen=True, slots=True)
class Table:
    """Columns of equal length; None: no value."""

    columns: dict[str, list[Value]]

    @property
    def rows(self) -> list[tuple[Value, ...]]:
        """The same row by row."""
        return list(zip(*self.columns.values(), strict=True))


def wide(trials: list[StoredTrial]) -> Table:
    """Return one row per trial; each measured quantity is a column such as ``onboard_work_total_m``."""
    measured = [values_of(each.record) for each in trials]
    columns = _about(trials)
    for key in in_order(key for values in measured for key in values):
        columns[column_of(*key)] = [values.get(key) for values in measured]
    return Table(columns)


def long(trials: list[StoredTrial]) -> Table:
    """Return one row per trial and quantity, with columns ``source``, ``name``, ``value`` and ``unit``."""
    rows = [(each, key, value) for each in trials for key, value in values_of(each.record).items()]
    columns = _about([each for each, _, _ in rows])
    columns["source"] = [source for _, (source, _), _ in rows]
    columns["name"] = [name for _, (_, name), _ in rows]
    columns["value"] = [value for _, _, value in rows]
    columns["unit"] = [unit_of(name) for _, (_, name), _ in rows]
    return Table(columns)


def column_of(source: str, name: str) -> str:
    """Return a column's name that is an identifier everywhere."""
    return re.sub(r"\W+", "_", f"{source}_{name}", flags=re.ASCII)


def write_table(table: Table, path: Path, form: str) -> None:
    """Write a table; the file appears whole or not at all.

    Raises
    ------
    ConfigError
        Unknown format, or the file cannot be written.
    MissingExtra
        The library for this format is not installed.
    """
    if form not in WRITERS:
        raise ConfigError(f"there is no format '{form}'", where="--format", hint=did_you_mean(form, WRITERS))
    if path.is_dir():
        raise ConfigError("cannot write: it is a folder", where=str(path), hint="name a file")
    try:
        with whole_file(path) as part:
            WRITERS[form](table, part)
    except ImportError as error:
        raise MissingExtra(f"writing {form} needs {error.name}", hint=EXTRA) from error


def about_trial(stored: StoredTrial) -> dict[str, Value]:
    """Return which trial it is and how it was run."""
    record, how, cell = stored.record, stored.provenance, stored.record.trial.cell
    return {
        "trial": record.id,
        "experiment": record.experiment,
        "group": cell.group,
        "behaviour": cell.behaviour,
        "parameters": msgspec.json.encode(dict(cell.parameters)).decode(),
        "team": cell.team,
        "needs": msgspec.json.encode(dict(cell.needs)).decode(),
        "roles": msgspec.json.encode(dict(cell.roles)).decode(),
        "scenario": cell.scenario,
        "robots": cell.robots,
        "engine": cell.engine,
        "limits": cell.limits,
        "network": cell.network,
        "noise_m": cell.noise_m,
        "noise_rad": cell.noise_rad,
        "seed": record.trial.seed,
        "end_reason": record.end_reason,
        "failure": record.failure,
        "wall_s": how.wall_s,
    }


def _about(trials: list[StoredTrial]) -> dict[str, list[Value]]:
    """Return the columns that say which trial it is and how it was run."""
    rows = [about_trial(stored) for stored in trials]
    names = rows[0] if rows else ("trial",)
    return {name: [row[name] for row in rows] for name in names}


def _write_csv(table: Table, path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table.columns)
        writer.writerows(table.rows)


def _write_xlsx(table: Table, path: Path) -> None:
    from openpyxl import Workbook
    from openpyxl.cell import WriteOnlyCell
    from openpyxl.cell.cell import ILLEGAL_CHARACTERS_RE

    if len(table.rows) > XLSX_ROWS:
        raise ConfigError(f"{len(table.rows)} rows do not fit into a sheet", hint="use parquet, or leave out --long")
    book = Workbook(write_only=True)
    sheet = book.create_sheet("results")
    sheet.freeze_panes = "A2"
    sheet.append(list(table.columns))
    for row in table.rows:
        cells = []
        for value in row:
            if isinstance(value, str):  # text stays text, also when it begins with "="
                cell = WriteOnlyCell(sheet, ILLEGAL_CHARACTERS_RE.sub("", value))
                cell.data_type = "s"
                cells.append(cell)
            else:
                cells.append(value)
        sheet.append(cells)
    with path.open("wb") as file:
        book.save(file)


def _write_parquet(table: Table, path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    kinds = {"text": pa.string(), "integer": pa.int64(), "number": pa.float64()}
    arrays = {name: pa.array(values, kinds[_kind(values)]) for name, values in table.columns.items()}
    parquet.write_table(pa.table(arrays), path)


def _write_mat(table: Table, path: Path) -> None:
    """Write a struct `results` of columns: numbers as (n, 1), no value as NaN, text as cells."""
    from scipy.io import savemat

    fields = {}
    for name, values in table.columns.items():
        if len(name) > MAT_NAME:
            raise ConfigError(f"the column '{name}' is too long for Matlab", hint="use parquet, or --long")
        if _kind(values) == "text":
            cells = np.empty((len(values), 1), object)
            cells[:, 0] = values
            fields[name] = cells
        else:
            fields[name] = np.array([np.nan if each is None else each for each in values], float).reshape(-1, 1)
    with path.open("wb") as file:
        savemat(file, {"results": fields}, long_field_names=True, do_compression=True)


def _kind(values: list[Value]) -> Literal["text", "integer", "number"]:
    if any(isinstance(each, str) for each in values):
        return "text"
    return "integer" if values and all(isinstance(each, int) for each in values) else "number"


WRITERS: dict[str, Callable[[Table, Path], None]] = {
    "csv": _write_csv,
    "xlsx": _write_xlsx,
    "parquet": _write_parquet,
    "mat": _write_mat,
}
