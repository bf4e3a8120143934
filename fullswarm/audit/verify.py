"""Checks an audit log, with code that it does not share with what writes it.

Found are: an entry that was changed, removed, repeated or moved, and entries cut off at the end, by the newest entry
that was noted elsewhere: in ``head.json``, in the core's database, or by a person. Not found is a log whose entries,
hashes and notes were all replaced by a user who may write all of them: only a note kept elsewhere shows that.
"""

from __future__ import annotations

import hashlib
import json
import re
import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, field
from pathlib import Path

_LINE = re.compile(rb'(\{"n":([1-9][0-9]{0,17}),.*,"previous":"([0-9a-f]{64})"),"hash":"([0-9a-f]{64})"\}\Z')
_ZEROS = "0" * 64
NOTED = "audit/head"
"""Key of the core's database that holds the newest entry."""


@dataclass(slots=True)
class Findings:
    """What a check found.

    Attributes
    ----------
    first, last, head : numbers of the first and the last entry, hash of the last
    problems : what is broken, the first one first
    notes : what the log itself states as missing
    """

    entries: int = 0
    first: int = 0
    last: int = 0
    head: str = _ZEROS
    problems: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def verify(path: Path, store: Path | None = None, expect: Mapping[int, str] | None = None) -> Findings:
    """Check a log's folder, or one file of it.

    Parameters
    ----------
    store : the core's database, which holds the newest entry too
    expect : hashes of entries, by their number, as a person noted them
    """
    # First, because the log may grow meanwhile.
    noted, found = [(f"noted by hand: entry {n}", n, digest) for n, digest in (expect or {}).items()], Findings()
    if path.is_dir():
        noted += _head_file(path / "head.json", found)
    if store is not None:
        noted += _in_store(store, found)
    wanted = {n for _, n, _ in noted}
    hashes: dict[int, str] = {}
    removed: dict[int, str] = {}
    before = ""  # what the first entry says of the one before it
    for file, number, line in _lines(path, found):
        where = f"{file.name}:{number}"
        match = _LINE.match(line)
        if match is None:
            found.problems.append(f"{where}: the entry after {found.last} is no entry of an audit log")
            continue
        n, previous, digest = int(match[2]), match[3].decode(), match[4].decode()
        if hashlib.sha256(match[1]).hexdigest() != digest:
            found.problems.append(f"{where}: entry {n} was changed")
        if not found.entries:
            found.first, before = n, previous
        elif n > found.last + 1:
            found.problems.append(f"{where}: {_range(found.last + 1, n - 1)} missing before entry {n}")
        elif n <= found.last:
            found.problems.append(f"{where}: entry {n} comes after entry {found.last}: repeated or moved")
        elif previous != found.head:
            found.problems.append(f"{where}: entry {n} does not follow entry {found.last}: one of them was replaced")
        found.entries, found.last, found.head = found.entries + 1, n, digest
        if n in wanted:
            hashes[n] = digest
        _read_own_words(line, n, found, removed)
    if path.is_dir() and (found.entries or noted):
        _check_start(found, before, removed)
    for what, n, digest in noted:
        if n > found.last:
            found.problems.append(f"{what}, but the log ends with entry {found.last}: cut off at the end")
        elif hashes.get(n, digest) != digest:
            found.problems.append(f"{what}, but that entry has another hash: it was replaced")
        elif n not in hashes and n >= found.first:
            found.problems.append(f"{what}, but that entry is missing")
    return found


def _lines(path: Path, found: Findings) -> Iterator[tuple[Path, int, bytes]]:
    files = sorted(each for each in path.glob("*.jsonl") if each.stem.isdecimal()) if path.is_dir() else [path]
    for file in files:
        try:
            stream = file.open("rb")
        except FileNotFoundError:
            continue  # removed by the writer meanwhile, which states it
        with stream:
            for number, line in enumerate(stream, 1):
                if line.endswith(b"\n"):
                    yield file, number, line[:-1]
                elif file == files[-1]:
                    found.notes.append(f"{file.name}:{number}: the last line is incomplete: being written, or torn")
                else:
                    found.problems.append(f"{file.name}:{number}: the line is incomplete")


def _read_own_words(line: bytes, n: int, found: Findings, removed: dict[int, str]) -> None:
    """Note what an entry says of others."""
    if b'"act":"gap"' not in line and b'"act":"retention"' not in line:
        return
    entry = _json(line)  # the words may also stand in a message
    what = entry.get("what")
    if entry.get("act") == "gap":
        found.notes.append(f"entry {n} states a gap: {json.dumps(what)}")
    elif entry.get("act") == "retention" and isinstance(what, dict) and isinstance(what.get("until"), int):
        removed[what["until"]] = str(what.get("hash"))


def _json(text: bytes) -> dict[str, object]:
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def _check_start(found: Findings, before: str, removed: Mapping[int, str]) -> None:
    if not found.entries:
        found.problems.insert(0, "the log has no entries")
    elif found.first == 1:
        if before != _ZEROS:
            found.problems.insert(0, "entry 1 is not the first of a log")
    elif removed.get(found.first - 1) == before:
        found.notes.append(f"entries 1 to {found.first - 1} were removed with their files, as the log states")
    else:
        found.problems.insert(0, f"{_range(1, found.first - 1)} missing at the start")


def _head_file(path: Path, found: Findings) -> list[tuple[str, int, str]]:
    try:
        fields = _json(path.read_bytes())
    except OSError as error:
        found.problems.append(f"{path.name}: {error.strerror}: entries cut off at the end would not be noticed")
        return []
    n, digest = fields.get("n"), fields.get("hash")
    if not isinstance(n, int) or not isinstance(digest, str):
        found.problems.append(f"{path.name}: holds no number and hash")
        return []
    return [(f"{path.name} names entry {n}", n, digest)]


def _in_store(path: Path, found: Findings) -> list[tuple[str, int, str]]:
    try:
        with closing(sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=1.0)) as database:
            rows = database.execute("SELECT value FROM entry WHERE key = ?", (NOTED,)).fetchall()
    except sqlite3.Error as error:
        found.problems.append(f"{path}: cannot be read: {error}")
        return []
    for row in rows:
        fields = _json(str(row[0]).encode())
        n, digest = fields.get("n"), fields.get("hash")
        if isinstance(n, int) and isinstance(digest, str):
            return [(f"{path.name} names entry {n}", n, digest)]
    return []


def _range(first: int, last: int) -> str:
    return f"entry {first} is" if first == last else f"entries {first} to {last} are"
