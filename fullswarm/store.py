"""A layer's local database (paper II.A): key → JSON value with its author, its time and its newest changes.

One SQLite file per layer, or memory. A value that an operator set stays until an operator changes it: seeding
from the TOML files, at every start, replaces only what the seed itself wrote. The file is in WAL mode, each change
is one transaction, so a process that dies leaves the last whole state behind.
"""

from __future__ import annotations

import contextlib
import json
import os
import sqlite3
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

import structlog

from fullswarm.clock import wall_time_s
from fullswarm.errors import ConfigError
from fullswarm.messages import ParamEntry, Value

Stored = Value | dict[str, object] | None
"""What a key may hold; None: nothing (any more)."""

Rows = dict[str, list[tuple[object, ...]]]
"""Table → its rows."""

log = structlog.get_logger()

SEED = "seed"
BUSY_S = 1.0
CHANGES_KEPT = 100
"""Of each key. The orders of a core change with every request: a year of them must not fill the disk, nor
be read at each start."""

_TABLES = """
CREATE TABLE IF NOT EXISTS history (
    change INTEGER PRIMARY KEY, key TEXT NOT NULL, value TEXT NOT NULL, author TEXT NOT NULL,
    changed REAL NOT NULL);
CREATE INDEX IF NOT EXISTS history_by_key ON history (key, change);
CREATE TABLE IF NOT EXISTS entry (
    key TEXT PRIMARY KEY, value TEXT NOT NULL, author TEXT NOT NULL, changed REAL NOT NULL) WITHOUT ROWID;
"""

TABLES = ("history", "entry")

_FORGET = """
DELETE FROM history WHERE key = ? AND change <= (
    SELECT change FROM history WHERE key = ? ORDER BY change DESC LIMIT 1 OFFSET ?);
"""


class Store:
    """Keys with values, their authors and their past.

    Parameters
    ----------
    path
        SQLite file, made with its folder when missing; None keeps everything in memory.
    wall_s
        Seconds since 1970, for the record of authors and changes.

    Raises
    ------
    ConfigError
        The file cannot be opened or is not a database. Any method may raise it when the disk fails later.
    """

    def __init__(self, path: Path | None = None, wall_s: Callable[[], float] = wall_time_s) -> None:
        self.path = path
        self.wall_s = wall_s
        self._watchers: list[Callable[[ParamEntry], None]] = []
        # What `keep` and `forget` could not write yet: the newest value of each key and its author; no author: forget.
        self._unsaved: dict[str, tuple[Stored, str | None]] = {}
        self._failing = False
        self._open = True
        try:
            if path is not None:
                path.parent.mkdir(parents=True, exist_ok=True)
                _make_private(path)
            # The runtime's thread may be another than the one that built the nodes; only one uses it at a time.
            self._db = sqlite3.connect(
                path or ":memory:", timeout=BUSY_S, isolation_level=None, check_same_thread=False
            )
        except (sqlite3.Error, OSError) as error:
            raise self._explain(error) from error
        try:
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=NORMAL")
            self._db.executescript(_TABLES)
        except sqlite3.Error as error:
            self._db.close()
            raise self._explain(error) from error

    def entry(self, key: str) -> ParamEntry | None:
        """Return the value of `key` and its author; None when it was never set."""
        rows = self._query("SELECT key, value, author, changed FROM entry WHERE key = ?", key)
        return rows[0] if rows else None

    def get(self, key: str, default: Stored = None) -> Stored:
        """Return the value of `key`, `default` when there is none."""
        found = self.entry(key)
        return default if found is None or found.value is None else found.value

    def list(self, prefix: str = "") -> tuple[ParamEntry, ...]:
        """Return all keys with a value that begin with `prefix`, sorted."""
        rows = self._query(
            "SELECT key, value, author, changed FROM entry WHERE substr(key, 1, ?) = ? ORDER BY key",
            len(prefix),
            prefix,
        )
        return tuple(row for row in rows if row.value is not None)

    def history(self, key: str) -> tuple[ParamEntry, ...]:
        """Return the newest changes of `key`, oldest first; ``prefix*`` means all keys with that prefix.

        A key's changes before its last `CHANGES_KEPT` are forgotten.
        """
        if not key.endswith("*"):
            return self._query("SELECT key, value, author, changed FROM history WHERE key = ? ORDER BY change", key)
        return self._query(
            "SELECT key, value, author, changed FROM history WHERE substr(key, 1, ?) = ? ORDER BY change",
            len(key) - 1,
            key[:-1],
        )

    def set(self, key: str, value: Stored, author: str) -> ParamEntry:
        """Write one value; None takes it away. Returns the new entry."""
        return self.set_many({key: value}, author)[0]

    def set_many(self, values: Mapping[str, Stored], author: str) -> tuple[ParamEntry, ...]:
        """Write several values in one transaction, then call the watchers.

        Raises
        ------
        ConfigError
            A value is not JSON (NaN, infinity, an object), or the database cannot be written.
        """
        now = self.wall_s()
        rows = [(key, _encode(key, value), author, now) for key, value in values.items()]
        try:
            self._db.execute("BEGIN IMMEDIATE")
            try:
                self._db.executemany("INSERT INTO history (key, value, author, changed) VALUES (?, ?, ?, ?)", rows)
                self._db.executemany("INSERT OR REPLACE INTO entry VALUES (?, ?, ?, ?)", rows)
                self._db.executemany(_FORGET, [(row[0], row[0], CHANGES_KEPT) for row in rows])
            except sqlite3.Error:
                self._db.execute("ROLLBACK")
                raise
            self._db.execute("COMMIT")
        except sqlite3.Error as error:
            raise self._explain(error) from error
        for key in values:
            self._unsaved.pop(key, None)  # this is newer
        entries = tuple(_entry(row) for row in rows)
        for entry in entries:
            for watcher in tuple(self._watchers):
                watcher(entry)
        return entries

    def keep(self, values: Mapping[str, Stored], author: str) -> None:
        """Write `values` for the next start; None takes a key away, where there is one.

        A full or locked disk must not end the process: what cannot be written is logged, and written by a later
        :meth:`save`, or with the next values.
        """
        for key, value in values.items():
            try:
                _encode(key, value)
            except ConfigError as error:
                log.error("not saved: the next start will not restore it", error=str(error), keys=[key])
            else:
                self._unsaved[key] = value, author
        self.save()

    def forget(self, *keys: str) -> None:
        """Take keys away with all their changes, as if they had never been set; later if the disk fails, as `keep`."""
        self._unsaved.update(dict.fromkeys(keys, (None, None)))
        self.save()

    @property
    def unsaved(self) -> bool:
        """Whether something has not been written, because the disk fails."""
        return bool(self._unsaved)

    def save(self, *, wait: bool = True) -> None:
        """Write what :meth:`keep` and :meth:`forget` could not.

        Parameters
        ----------
        wait : up to `BUSY_S` for another process that holds the database
        """
        if not self._unsaved:
            return
        late = self._failing
        try:
            if not wait:
                self._db.execute("PRAGMA busy_timeout = 0")
            try:
                for author in dict.fromkeys(author for _, author in self._unsaved.values()):
                    self._write({key: value for key, (value, by) in self._unsaved.items() if by == author}, author)
            finally:
                if not wait:
                    self._db.execute(f"PRAGMA busy_timeout = {round(1000.0 * BUSY_S)}")
        except (ConfigError, sqlite3.Error) as error:
            self._failing = True
            if not late:
                text = "not saved: a restart would not restore it; tried again until it is"
                log.error(text, error=str(error), keys=sorted(self._unsaved)[:5])
            return
        self._failing = False
        if late:
            log.warning("saved what the database could not take before")

    def _write(self, values: Mapping[str, Stored], author: str | None) -> None:
        if author is None:
            self._delete(values)
        elif wanted := {key: each for key, each in values.items() if each is not None or self.get(key) is not None}:
            self.set_many(wanted, author)
        for key in values:
            self._unsaved.pop(key, None)

    def _delete(self, keys: Iterable[str]) -> None:
        self._db.execute("BEGIN IMMEDIATE")
        try:
            for table in ("entry", "history"):
                self._db.executemany(f"DELETE FROM {table} WHERE key = ?", [(key,) for key in keys])  # noqa: S608
        except sqlite3.Error:
            self._db.execute("ROLLBACK")
            raise
        self._db.execute("COMMIT")

    def seed(self, entries: Mapping[str, Stored], author: str = SEED) -> tuple[str, ...]:
        """Write the values of the TOML files, where nothing else was written since; return the keys that changed."""
        changed: dict[str, Stored] = {}
        for key, value in entries.items():
            old = self.entry(key)
            if old is None or (old.author == author and old.value != _plain(key, value)):
                changed[key] = value
        if changed:
            self.set_many(changed, author)
        return tuple(changed)

    def dump(self) -> Rows:
        """Return all rows of all tables, for `restore`."""
        try:
            return {table: self._db.execute(f"SELECT * FROM {table}").fetchall() for table in TABLES}  # noqa: S608
        except sqlite3.Error as error:
            raise self._explain(error) from error

    def restore(self, rows: Mapping[str, Iterable[Sequence[object]]]) -> None:
        """Put the rows of a `dump` into this store, which is new. Raises `ConfigError` where they are none."""
        try:
            for table in TABLES:
                for row in rows.get(table, ()):
                    places = ", ".join("?" for _ in row)
                    self._db.execute(f"INSERT INTO {table} VALUES ({places})", tuple(row))  # noqa: S608
        except sqlite3.Error as error:
            raise self._explain(error) from error

    def watch(self, callback: Callable[[ParamEntry], None]) -> Callable[[], None]:
        """Have `callback` called after every change; call what is returned to end that."""
        self._watchers.append(callback)

        def unwatch() -> None:
            if callback in self._watchers:
                self._watchers.remove(callback)

        return unwatch

    def close(self) -> None:
        """Fold the log into the file and let go of it. Closing twice is fine."""
        if self._open:
            self.save()
            self._open = False
            self._watchers.clear()
            self._db.close()

    def _query(self, sql: str, *args: object) -> tuple[ParamEntry, ...]:
        try:
            rows = self._db.execute(sql, args).fetchall()
        except sqlite3.Error as error:
            raise self._explain(error) from error
        entries = []
        for row in rows:
            try:
                entries.append(_entry(row))
            except (ValueError, TypeError, RecursionError) as error:  # another program has written into the file
                raise self._unreadable(row[0], error) from None
        return tuple(entries)

    def _unreadable(self, key: str, error: Exception) -> ConfigError:
        name = key.replace("'", "''")
        # To be read by a person, not to be executed here.
        away = "; ".join(f"DELETE FROM {table} WHERE key = '{name}'" for table in ("entry", "history"))  # noqa: S608
        hint = f'bring back a copy of the file, or take the value away: sqlite3 {self.path} "{away}"'
        return ConfigError(f"the value of '{key}' is not JSON: {error}", where=str(self.path or "memory"), hint=hint)

    def _explain(self, error: Exception) -> ConfigError:
        if "locked" in str(error):
            hint = "another process holds it: stop the other core or give this one its own file"
        elif "not a database" in str(error):
            hint = "the file is something else: name another file"
        else:
            hint = "check that the folder exists, is writable and has room"
        return ConfigError(f"the local database fails: {error}", where=str(self.path or "memory"), hint=hint)


def _make_private(path: Path) -> None:
    """Make the file, and what SQLite keeps beside it, for this user only: SQLite gives new ones the file's mode."""
    os.close(os.open(path, os.O_RDWR | os.O_CREAT, 0o600))
    for each in (path, *(path.with_name(path.name + suffix) for suffix in ("-wal", "-shm", "-journal"))):
        with contextlib.suppress(FileNotFoundError, PermissionError):  # of another user, who has let this one write
            each.chmod(0o600)


def _encode(key: str, value: Stored) -> str:
    try:
        return json.dumps(value, allow_nan=False, separators=(",", ":"))
    except (TypeError, ValueError) as error:
        raise ConfigError(
            f"{key}: {error}", hint="values are flags, finite numbers, words, lists and tables"
        ) from error


def _plain(key: str, value: Stored) -> Stored:
    """Return `value` as it would come back: a tuple as a list."""
    plain: Stored = json.loads(_encode(key, value))
    return plain


def _entry(row: tuple[str, str, str, float]) -> ParamEntry:
    return ParamEntry(key=row[0], value=json.loads(row[1], parse_constant=_refuse), author=row[2], changed=row[3])


def _refuse(word: str) -> None:
    raise ValueError(f"{word} is no number of JSON")
