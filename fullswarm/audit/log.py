"""Appends entries to an audit log: one line each, chained by hashes, in files that only this user reads.

An entry is the line ``{"n":…,"time":…,"mono_s":…,"run":…,"act":…,…,"previous":"…","hash":"…"}``. ``hash`` is the
SHA-256 of the line's bytes in front of ``,"hash":``, and ``previous`` the ``hash`` of entry ``n - 1``, 64 zeros for the
first. Lines are ASCII. A file is named after its first entry.

Writing never raises and never waits for a failed disk: entries that could not be written are counted, and an entry
``gap`` says how many as soon as there is room again.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import structlog

from fullswarm.clock import MonotonicClock, wall_time_s
from fullswarm.errors import ConfigError
from fullswarm.portability import lock as lock_file

FIRST = "0" * 64
HEAD = "head.json"
SUFFIX = ".jsonl"
FILE_BYTES = 16 * 2**20
FILES = 64
"""With `FILE_BYTES` a log takes 1 GiB at most; then its oldest file is removed, which an entry ``retention`` states."""
LONGEST_ENTRY = 8192
"""Bytes of a line; a longer one is written without ``what``."""
LONGEST_TEXT, MOST_ITEMS, DEEPEST = 256, 64, 4
RETRY_S = 1.0
SAY_S = 60.0

log = structlog.get_logger()
_to_disk: Callable[[int], None] = getattr(os, "fdatasync", os.fsync)  # macOS has the second only


@dataclass(frozen=True, slots=True)
class Event:
    """What an entry states.

    Parameters
    ----------
    act
        The kind of entry: ``request``, ``stop``, ``estop``, …
    sender, operator, source
        The process as the bus states it, the person, and the process as the message states it.
    """

    act: str
    what: Mapping[str, object] = field(default_factory=dict)
    robots: Sequence[str] = ()
    result: str = ""
    sender: str = ""
    operator: str = ""
    source: str = ""


@dataclass(frozen=True, slots=True)
class Head:
    """The newest entry of a log: its number and its hash."""

    n: int = 0
    hash: str = FIRST


class AuditLog:
    """A log open for appending. Only one at a time writes a folder.

    Parameters
    ----------
    folder
        Made if missing, for this user only.
    run
        Name of the process that writes: monotonic times of one run compare.
    now_s, wall_s
        Monotonic seconds, and seconds since 1970.
    anchor
        The newest entry as another place remembers it. A log that ends before it goes on after it, so that the
        missing entries stay visible.
    wait
        Wait for another writer of the folder to end, instead of counting entries as lost meanwhile.

    Attributes
    ----------
    lost : entries that could not be written and that no ``gap`` states yet
    """

    def __init__(
        self,
        folder: Path,
        run: str,
        now_s: Callable[[], float],
        wall_s: Callable[[], float] = wall_time_s,
        *,
        anchor: Head | None = None,
        wait: bool = False,
        file_bytes: int = FILE_BYTES,
        files: int = FILES,
    ) -> None:
        self.folder, self.lost = folder, 0
        self._run, self._now_s, self._wall_s, self._wait = run, now_s, wall_s, wait
        self._anchor, self._file_bytes, self._files = anchor or Head(), file_bytes, max(2, files)
        self._head, self._synced = Head(), Head()
        self._lock = self._file = -1
        self._size = 0
        self._why = ""
        self._retry_s = self._say_s = -math.inf
        self._attempt(self._open)

    @property
    def head(self) -> Head:
        """The newest entry that was written."""
        return self._head

    def append(self, event: Event) -> bool:
        """Write an entry; return False if it could not be written and was counted instead."""
        if self.lost and self._now_s() < self._retry_s:
            self.lost += 1
            return False
        if self._attempt(lambda: self._append(event)):
            return True
        self.lost += 1
        return False

    def sync(self) -> bool:
        """Wait until the disk has all entries, then note the newest one in ``head.json``; return False on failure."""
        if self._file < 0 or self._head == self._synced:
            return True
        return self._attempt(self._sync)

    def close(self) -> None:
        """Write the entries to the disk and let go of the folder; closing twice is fine."""
        self.sync()
        for name in ("_file", "_lock"):
            descriptor = getattr(self, name)
            setattr(self, name, -1)
            if descriptor >= 0:
                with contextlib.suppress(OSError):
                    os.close(descriptor)

    # ---------------------------------------------------------------- failures
    def _attempt(self, act: Callable[[], None]) -> bool:
        try:
            act()
        except OSError as error:
            now_s = self._now_s()
            self._why, self._retry_s = error.strerror or str(error), now_s + RETRY_S
            if now_s >= self._say_s:
                self._say_s = now_s + SAY_S
                log.error(
                    "the audit log cannot be written; entries are counted", where=str(self.folder), error=str(error)
                )
            return False
        return True

    # ---------------------------------------------------------------- opening
    def _open(self) -> None:
        self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if self._lock < 0:
            lock = os.open(self.folder, os.O_RDONLY | os.O_DIRECTORY)
            try:
                lock_file(lock, wait=self._wait)
            except OSError as error:
                os.close(lock)
                raise OSError(error.errno, "another process writes this audit log") from error
            self._lock = lock
        found, note = self._find_head()
        self._head = self._synced = found
        paths = files_of(self.folder)
        self._use(paths[-1] if paths else self._path(found.n + 1))
        if note:
            self._put(Event("gap", note))

    def _find_head(self) -> tuple[Head, dict[str, object]]:
        """Return the entry to go on after, and what is wrong with the end of the log; cut off a torn last line."""
        note: dict[str, object] = {}
        written = Head()
        for number, path in enumerate(reversed(files_of(self.folder))):
            data = path.read_bytes()
            if number == 0 and data and not data.endswith(b"\n"):  # a crash of the computer while it was written
                whole = data.rfind(b"\n") + 1
                note["torn_bytes"] = len(data) - whole
                data = data[:whole]
                os.truncate(path, whole)
            written = _last_entry(data)
            if written.n:
                break
        noted = max((_read_head(self.folder / HEAD), self._anchor), key=lambda head: head.n)
        if noted.n > written.n:
            note["missing"] = [written.n + 1, noted.n]
            return noted, note
        return written, note

    def _path(self, n: int) -> Path:
        return self.folder / f"{n:012d}{SUFFIX}"

    def _use(self, path: Path) -> None:
        new = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o600)
        if self._file >= 0:
            os.close(self._file)
        self._file, self._size = new, os.fstat(new).st_size
        os.fsync(self._lock)  # the folder's list of files

    # ---------------------------------------------------------------- writing
    def _append(self, event: Event) -> None:
        if self._file < 0:
            self._open()
        if self.lost:
            self._put(Event("gap", {"not_written": self.lost, "reason": self._why}))
            self.lost = 0
        self._put(event)

    def _put(self, event: Event) -> None:
        line, head = self._line(event)
        if self._size and self._size + len(line) > self._file_bytes:
            self._rotate()
            line, head = self._line(event)
        try:
            written = os.write(self._file, line)
            if written < len(line):
                raise OSError(28, "No space left on device")
        except OSError:
            with contextlib.suppress(OSError):  # a part of a line must not stay
                os.ftruncate(self._file, self._size)
            raise
        self._size += len(line)
        self._head = head

    def _line(self, event: Event) -> tuple[bytes, Head]:
        n = self._head.n + 1
        fields: dict[str, object] = {
            "n": n,
            "time": datetime.fromtimestamp(self._wall_s(), UTC).isoformat(timespec="microseconds"),
            "mono_s": round(self._now_s(), 6),
            "run": self._run,
            "act": event.act,
            "sender": bounded(event.sender),
            "operator": bounded(event.operator),
            "source": bounded(event.source),
            "robots": bounded(list(event.robots)),
            "what": bounded(dict(event.what)),
            "result": bounded(event.result),
            "previous": self._head.hash,
        }
        body = json.dumps(fields, allow_nan=False, separators=(",", ":"))
        if len(body) > LONGEST_ENTRY:
            fields |= {"what": {"omitted_bytes": len(body)}, "robots": bounded(list(event.robots[:8]))}
            body = json.dumps(fields, allow_nan=False, separators=(",", ":"))
        start = body[:-1].encode("ascii")
        digest = hashlib.sha256(start).hexdigest()
        return start + b',"hash":"' + digest.encode() + b'"}\n', Head(n, digest)

    def _sync(self) -> None:
        _to_disk(self._file)
        # Not before the entries are on the disk: after a power cut the log must not end before its own note.
        text = json.dumps({"n": self._head.n, "hash": self._head.hash}) + "\n"
        part = self.folder / f".{HEAD}"
        descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW, 0o600)
        try:
            os.write(descriptor, text.encode())
        finally:
            os.close(descriptor)
        part.replace(self.folder / HEAD)
        self._synced = self._head

    def _rotate(self) -> None:
        _to_disk(self._file)
        self._use(self._path(self._head.n + 1))
        for path in files_of(self.folder)[: -self._files]:
            last = _last_entry(path.read_bytes())
            self._put(Event("retention", {"until": last.n, "hash": last.hash}))
            _to_disk(self._file)  # what is removed must have been stated
            path.unlink()


def record(folder: Path, run: str, event: Event) -> None:
    """Append one entry to the log in `folder`, on the disk when this returns: for commands, such as those for keys.

    Raises
    ------
    ConfigError
        It cannot be written: what it records should not be done then.
    """
    audit = AuditLog(folder, run, MonotonicClock().now_s, wait=True)
    try:
        written = audit.append(event) and audit.sync()
    finally:
        audit.close()
    if not written:
        raise ConfigError("the audit log cannot be written", where=str(folder), hint="check its owner and the disk")


def unlocked(folder: Path) -> Path:
    """Return `folder`, or ``folder-2`` and so on while another process writes a log there."""
    for number in range(1, 100):
        path = folder if number == 1 else folder.with_name(f"{folder.name}-{number}")
        try:
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
        except OSError:
            return path  # it is not there yet, or opening the log will say what is wrong
        try:
            lock_file(lock, wait=False)
        except OSError:
            continue
        finally:
            os.close(lock)
        return path
    return folder


def files_of(folder: Path) -> list[Path]:
    """Return the files of a log, the oldest first."""
    return sorted(path for path in folder.glob(f"*{SUFFIX}") if path.stem.isdecimal())


def newest_entry(folder: Path) -> tuple[str, bytes]:
    """Return name and last line of a log's newest file; empty where there is none, or it cannot be read."""
    try:
        path = files_of(folder)[-1]
        return path.name, path.read_bytes().splitlines(keepends=True)[-1]
    except (OSError, IndexError):
        return "", b""


def _last_entry(data: bytes) -> Head:
    for line in reversed(data.splitlines()):
        head = _head(line)
        if head.n:
            return head
    return Head()


def _read_head(path: Path) -> Head:
    try:
        return _head(path.read_bytes())
    except FileNotFoundError:
        return Head()


def _head(text: bytes) -> Head:
    try:
        fields = json.loads(text)
        n, digest = fields["n"], fields["hash"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return Head()
    return Head(n, digest) if type(n) is int and n > 0 and isinstance(digest, str) and len(digest) == 64 else Head()


def bounded(value: object, depth: int = 0) -> object:
    """Return `value` as JSON of bounded size: what arrives may be of any size and depth."""
    if value is None or isinstance(value, bool | int):
        return value if not isinstance(value, int) or abs(value) < 2**63 else str(value)[:LONGEST_TEXT]
    if isinstance(value, float):
        return value if math.isfinite(value) else str(value)
    if isinstance(value, str):
        return value if len(value) <= LONGEST_TEXT else value[:LONGEST_TEXT] + "…"
    if depth >= DEEPEST:
        return "…"
    if isinstance(value, Mapping):
        items = list(value.items())
        kept: dict[str, object] = {str(key)[:64]: bounded(each, depth + 1) for key, each in items[:MOST_ITEMS]}
        return kept if len(items) <= MOST_ITEMS else kept | {"…": len(items)}
    if isinstance(value, Sequence) and not isinstance(value, bytes):
        some = [bounded(each, depth + 1) for each in value[:MOST_ITEMS]]
        return some if len(value) <= MOST_ITEMS else [*some, f"… {len(value)} in all"]
    return str(value)[:LONGEST_TEXT]
