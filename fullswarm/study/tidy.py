"""All measures of a study as one table in the long, tidy form: one row per trial and measure."""

from __future__ import annotations

from pathlib import Path

from fullswarm.errors import ConfigError
from fullswarm.evaluate.results.export import Table, Value, write_table
from fullswarm.study.folder import StudyFolder
from fullswarm.study.measures import measures_of, read_log

COLUMNS = ("study", "participant", "order", "condition", "condition_name", "after", "measure", "of", "value", "unit")
FORMATS = ("csv", "xlsx", "parquet")


def tidy(folder: StudyFolder) -> Table:
    """Return the measures of all complete trials.

    ``condition`` is the label and ``condition_name`` what is behind it, empty until the study is unblinded; ``order``
    counts a participant's conditions from 1, ``after`` is the label of the one before, for carry-over effects.

    Raises
    ------
    ConfigError
        A trial's log is missing or broken.
    """
    rows: list[tuple[Value, ...]] = []
    study = folder.study.section
    for stored in folder.complete():
        record = stored.record
        name = folder.condition(record.label) if folder.opened else ""
        before = folder.order(record.participant)[record.number - 2] if record.number > 1 else ""
        about = (study.name, record.participant, record.number, record.label, name, before)
        rows += [(*about, *each) for each in _measures(folder, stored.folder)]
    return Table({name: [row[index] for row in rows] for index, name in enumerate(COLUMNS)})


def _measures(folder: StudyFolder, trial: Path) -> list[tuple[Value, ...]]:
    found = measures_of(read_log(trial), folder.study.section.measures)
    return [(each.name, each.of, None if each.value is None else float(each.value), each.unit) for each in found]


def export(folder: StudyFolder, path: Path) -> int:
    """Write the table in the format that the file's name tells; return the number of rows.

    Raises
    ------
    ConfigError
        Unknown format, no complete trial, or the file cannot be written.
    MissingExtra
        The library for this format is not installed.
    """
    form = path.suffix.removeprefix(".")
    if form not in FORMATS:
        raise ConfigError(
            f"the name ends in none of {', '.join(FORMATS)}", where=f"-o {path}", hint="e.g. -o study.csv"
        )
    table = tidy(folder)
    if not table.rows:
        raise ConfigError(
            "no trial is complete yet", where=str(folder.path), hint="`fullswarm study status` shows them"
        )
    write_table(table, path, form)
    return len(table.rows)
