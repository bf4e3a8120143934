"""Exports read back equal, the same columns in every format."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import msgspec
import openpyxl
import pytest
from pyarrow import parquet
from scipy.io import loadmat

from fullswarm.errors import ConfigError
from fullswarm.evaluate.results import read_records
from fullswarm.evaluate.results.export import Table, Value, column_of, long, wide, write_table
from tests.unit.results_fixture import a_record, a_trial, write_folder, write_trial

FORMS = ("csv", "xlsx", "parquet", "mat")


def read_back(path: Path, form: str) -> dict[str, list[Value]]:
    if form == "csv":
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
        return {name: [row[name] for row in rows] for name in rows[0]}
    if form == "xlsx":
        book = openpyxl.load_workbook(path)
        header, *body = book["results"].iter_rows(values_only=True)
        book.close()
        return {str(name): [row[place] for row in body] for place, name in enumerate(header)}
    if form == "parquet":
        found: dict[str, list[Value]] = parquet.read_table(path).to_pydict()
        return found
    results = loadmat(path, squeeze_me=False)["results"][0, 0]
    return {name: [_cell(each) for each in results[name].ravel()] for name in results.dtype.names}


def _cell(value: object) -> Value:
    if hasattr(value, "tolist"):
        value = value.tolist()
    while isinstance(value, list):
        value = value[0] if value else ""
    return value if isinstance(value, str) else float(str(value))


def same(one: Value, other: Value) -> bool:
    """Tell whether a value survived; what a format has no word for counts as no value; a sheet keeps 16 digits."""
    empty = (None, "")
    if one in empty or (isinstance(one, float) and math.isnan(one)):
        return other in empty or (isinstance(other, float) and math.isnan(other))
    return str(other) == one if isinstance(one, str) else math.isclose(float(str(other)), one, rel_tol=1e-15)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("shape", [wide, long])
def test_an_export_reads_back_equal(tmp_path: Path, form: str, shape: object) -> None:
    write_folder(tmp_path, seeds=2)
    trials = read_records(tmp_path)
    table = wide(trials) if shape is wide else long(trials)
    path = tmp_path / f"table.{form}"
    write_table(table, path, form)
    found = read_back(path, form)
    assert list(found) == list(table.columns)
    for name, values in table.columns.items():
        assert len(found[name]) == len(values)
        assert all(map(same, values, found[name])), name


def test_columns_say_their_unit(tmp_path: Path) -> None:
    write_folder(tmp_path, seeds=2)
    table = wide(read_records(tmp_path))
    assert {"onboard_work_total_m", "truth_work_total_m", "outcome_simulated_s", "outcome_events"} <= set(table.columns)
    assert all(name.isidentifier() for name in table.columns)
    assert len(table.rows) == 16
    assert table.columns["outcome_events"].count(None) == 1  # the failed one
    units = dict(zip(*(long(read_records(tmp_path)).columns[name] for name in ("name", "unit")), strict=True))
    assert units["work.total_m"] == "m"
    assert column_of("truth", "a.b-c") == "truth_a_b_c"


@pytest.mark.parametrize("form", FORMS)
def test_hostile_text_stays_text(tmp_path: Path, form: str) -> None:
    trial = a_trial("move_to_goal", "empty", 4, 0)
    text = '=1+1, "quoted"\nsecond line é'
    write_trial(tmp_path, trial, record=msgspec.structs.replace(a_record(trial, "x"), failure=text))
    path = tmp_path / "t"
    write_table(wide(read_records(tmp_path)), path, form)
    if form == "xlsx":
        path = path.rename(tmp_path / "t.xlsx")
    assert read_back(path, form)["failure"] == [text]


def test_control_characters_do_not_break_a_sheet(tmp_path: Path) -> None:
    write_table(Table({"failure": ["a\x00b"]}), tmp_path / "t.xlsx", "xlsx")
    assert read_back(tmp_path / "t.xlsx", "xlsx") == {"failure": ["ab"]}


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    table = Table({"a": [1, 2]})
    with pytest.raises(ConfigError, match=r"did you mean 'parquet'"):
        write_table(table, tmp_path / "t", "parket")
    with pytest.raises(ConfigError, match="cannot write"):
        write_table(table, tmp_path / "none" / "t.csv", "csv")
    with pytest.raises(ConfigError, match="too long for Matlab"):
        write_table(Table({"a" * 64: [1]}), tmp_path / "t.mat", "mat")
    assert list(tmp_path.iterdir()) == []
