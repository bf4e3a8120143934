"""The SQLite index of a results folder. It is made of the directories alone, and made anew whenever they changed.

trials    one row per trial: what was run, how it ended, where its directory is
metrics   trial, source (outcome, onboard, truth), name, value
problems  directories that cannot be read, with the reason
meta      format, the signature of the directories that the index was made of, how many trials are of older settings
"""

from __future__ import annotations

import hashlib
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import msgspec

from fullswarm.errors import ConfigError
from fullswarm.evaluate.results.folder import EXPERIMENT_FILE, Folder, StoredTrial, read_folder, trial_paths
from fullswarm.evaluate.results.quantities import values_of
from fullswarm.evaluate.trial_folder import PROVENANCE_FILE, RESULT_FILE, TRIALS, whole_file

INDEX_FILE = "index.sqlite"
INDEX_FORMAT = "fullswarm.index/2"

SCHEMA = """
CREATE TABLE meta (key TEXT PRIMARY KEY, value TEXT NOT NULL);
CREATE TABLE trials (
    id TEXT PRIMARY KEY, directory TEXT NOT NULL, experiment TEXT NOT NULL, "group" TEXT NOT NULL,
    behaviour TEXT NOT NULL, parameters TEXT NOT NULL, label TEXT NOT NULL, scenario TEXT NOT NULL,
    robots INTEGER NOT NULL, engine TEXT NOT NULL, limits TEXT NOT NULL, network TEXT NOT NULL,
    noise_m REAL NOT NULL, noise_rad REAL NOT NULL, seed INTEGER NOT NULL,
    failed INTEGER NOT NULL, failure TEXT NOT NULL, end_reason TEXT NOT NULL,
    started TEXT NOT NULL, wall_s REAL NOT NULL, attempts INTEGER NOT NULL, host TEXT NOT NULL,
    runner TEXT NOT NULL, git TEXT NOT NULL, fullswarm TEXT NOT NULL, configuration TEXT NOT NULL
);
CREATE TABLE metrics (
    trial TEXT NOT NULL REFERENCES trials (id), source TEXT NOT NULL, name TEXT NOT NULL, value REAL NOT NULL,
    PRIMARY KEY (trial, source, name)
) WITHOUT ROWID;
CREATE TABLE problems (directory TEXT NOT NULL, reason TEXT NOT NULL);
CREATE INDEX trials_by_cell ON trials (scenario, behaviour, robots, seed);
"""
INSERT_TRIAL = "INSERT INTO trials VALUES (?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?,?)"


@contextmanager
def open_index(out: Path) -> Iterator[sqlite3.Connection]:
    """Open the index for reading; missing, stale or broken it is made first.

    In a folder that cannot be written the index lives in memory.

    Raises
    ------
    ConfigError
        The folder holds no trials.
    """
    if not is_fresh(out):
        folder = read_folder(out)
        try:
            _write(folder)
        except (ConfigError, sqlite3.Error):
            with closing(sqlite3.connect(":memory:")) as connection:
                _fill(connection, folder)
                yield connection
            return
    address = f"{(out / INDEX_FILE).resolve().as_uri()}?mode=ro"
    with closing(sqlite3.connect(address, uri=True)) as connection:
        yield connection


def rebuild(out: Path) -> Folder:
    """Make the index anew and return what it was made of.

    Raises
    ------
    ConfigError
        The folder holds no trials, or it cannot be written.
    """
    folder = read_folder(out)
    try:
        _write(folder)
    except sqlite3.Error as error:
        raise ConfigError(f"cannot write the index: {error}", where=str(out / INDEX_FILE)) from error
    return folder


def is_fresh(out: Path) -> bool:
    """Tell whether there is a whole index of the directories as they are now."""
    path = out / INDEX_FILE
    if not path.is_file():
        return False
    try:
        with closing(sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)) as connection:
            meta = dict(connection.execute("SELECT key, value FROM meta"))
            whole = connection.execute("PRAGMA quick_check").fetchone() == ("ok",)
    except sqlite3.Error:
        return False
    return whole and (meta.get("format"), meta.get("signature")) == (INDEX_FORMAT, signature(out))


def signature(out: Path) -> str:
    """Return a hash of names, sizes and times of the files that the index is made of."""
    digest = hashlib.sha256()
    files = [path / name for path in trial_paths(out) for name in (RESULT_FILE, PROVENANCE_FILE)]
    for path in (*files, out / EXPERIMENT_FILE):
        try:
            stat = path.stat()
            found = f"{stat.st_size} {stat.st_mtime_ns}"
        except OSError:
            found = "missing"
        digest.update(f"{path.relative_to(out)} {found}\n".encode())
    return digest.hexdigest()


def _write(folder: Folder) -> None:
    """Write the index; a reader never sees half of one."""
    with whole_file(folder.path / INDEX_FILE) as part:
        part.unlink()
        with closing(sqlite3.connect(part)) as connection:
            _fill(connection, folder)


def _fill(connection: sqlite3.Connection, folder: Folder) -> None:
    connection.executescript(SCHEMA)
    with connection:
        connection.executemany(INSERT_TRIAL, map(_row, folder.trials))
        connection.executemany(
            "INSERT INTO metrics VALUES (?, ?, ?, ?)",
            (
                (stored.record.id, source, name, value)
                for stored in folder.trials
                for (source, name), value in values_of(stored.record).items()
            ),
        )
        connection.executemany(
            "INSERT INTO problems VALUES (?, ?)",
            ((str(each.path.relative_to(folder.path)), each.reason) for each in folder.problems),
        )
        # Last: the signature was true when the directories had been read, or the index is made again.
        meta = {"format": INDEX_FORMAT, "signature": signature(folder.path), "older": str(folder.older)}
        connection.executemany("INSERT INTO meta VALUES (?, ?)", meta.items())


def _row(stored: StoredTrial) -> tuple[object, ...]:
    record, how = stored.record, stored.provenance
    cell = record.trial.cell
    return (
        *(record.id, f"{TRIALS}/{stored.path.name}", record.experiment, cell.group),
        *(cell.behaviour, msgspec.json.encode(dict(cell.parameters)).decode(), cell.label, cell.scenario),
        *(cell.robots, cell.engine, cell.limits, cell.network, cell.noise_m, cell.noise_rad, record.trial.seed),
        *(record.outcome is None, record.failure, record.end_reason),
        *(how.started, how.wall_s, how.attempts, how.host, how.runner, how.git, how.fullswarm, how.configuration),
    )
