"""Writes an image once decompressed to many cards at a time, each with its own boot partition, and reads them back."""

from __future__ import annotations

import errno
import hashlib
import os
import queue
import stat
import threading
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from fullswarm.deploy.flash.image import CHUNK_BYTES, put_sparse, write_all
from fullswarm.errors import ConfigError, FullswarmError

_QUEUED_CHUNKS = 4
_SYNC_BYTES = 64 << 20
"""Data is synchronised this often, so that the progress is that of the card, not of the page cache."""

Progress = Callable[[str, str, int], None]
"""Called with the job, its phase (`write` or `read back`) and the bytes so far."""


class CardFailed(FullswarmError):
    """A card or its reader did not store what was written."""


@dataclass(frozen=True, slots=True)
class Job:
    """One card or file to write; `edited` replaces the image from `edited_at` on."""

    name: str
    target: Path
    edited: Path
    edited_at: int


@dataclass(slots=True)
class Outcome:
    """The outcome of a job; times in seconds."""

    name: str
    bytes: int = 0
    sha256: str = ""
    write_s: float = 0.0
    verify_s: float = 0.0
    error: FullswarmError | None = None


@dataclass(slots=True)
class _Writer:
    """Runs one job in a thread of its own, fed with chunks in order."""

    job: Job
    progress: Progress
    stop: threading.Event
    outcome: Outcome
    inbox: queue.Queue[bytes | None] = field(default_factory=lambda: queue.Queue(_QUEUED_CHUNKS))
    _crcs: list[int] = field(default_factory=list)
    _fed: bool = False

    def run(self) -> None:
        """Write, wait for the card, read back; errors are in the outcome."""
        try:
            self._write()
            self._read_back()
        except FullswarmError as error:
            self.outcome.error = error
        except OSError as error:
            self.outcome.error = explain(error, self.job.target, self.outcome.bytes)
        except Exception as error:
            self.outcome.error = CardFailed(
                f"{type(error).__name__}: {error} (a bug in fullswarm)", where=self.job.name
            )
        finally:
            while not self._fed:  # or the feeding thread would wait for ever
                self._next()

    def _next(self) -> bytes | None:
        chunk = self.inbox.get()
        self._fed = chunk is None
        return chunk

    def _write(self) -> None:
        began_s, digest, synced = time.monotonic(), hashlib.sha256(), 0
        with _open(self.job.target, os.O_WRONLY) as file, self.job.edited.open("rb") as edited:
            sparse = stat.S_ISREG(os.fstat(file).st_mode)
            while (chunk := self._next()) is not None:
                at = self.outcome.bytes
                data = _overlay(chunk, at, edited.fileno(), self.job.edited_at)
                if sparse:
                    put_sparse(file, data, at)
                else:
                    write_all(file, data, at)
                digest.update(data)
                self._crcs.append(zlib.crc32(data))
                self.outcome.bytes = at + len(data)
                if self.outcome.bytes - synced >= _SYNC_BYTES:
                    os.fdatasync(file)
                    synced = self.outcome.bytes
                self.progress(self.job.name, "write", self.outcome.bytes)
            if self.stop.is_set():
                raise CardFailed("interrupted: half written", where=self.job.name, hint="flash it again")
            if sparse:
                os.truncate(file, self.outcome.bytes)
            os.fsync(file)
        self.outcome.sha256 = digest.hexdigest()
        self.outcome.write_s = time.monotonic() - began_s

    def _read_back(self) -> None:
        began_s, digest, done = time.monotonic(), hashlib.sha256(), 0
        with _open(self.job.target, os.O_RDONLY) as file:
            os.posix_fadvise(file, 0, 0, os.POSIX_FADV_DONTNEED)  # from the card, not from memory
            for crc in self._crcs:
                if self.stop.is_set():
                    raise CardFailed("interrupted before it was read back", where=self.job.name, hint="flash it again")
                data = os.pread(file, min(CHUNK_BYTES, self.outcome.bytes - done), done)
                if zlib.crc32(data) != crc:
                    what = f"reads back different from what was written, from {done / 1e6:.0f} MB on"
                    hint = "the card is worn out or smaller than labelled, or the reader is faulty: use another one"
                    raise CardFailed(what, where=self.job.name, hint=hint)
                digest.update(data)
                done += len(data)
                self.progress(self.job.name, "read back", done)
        if digest.hexdigest() != self.outcome.sha256:
            raise CardFailed("reads back different from what was written", where=self.job.name, hint="use another one")
        self.outcome.verify_s = time.monotonic() - began_s


def write_jobs(chunks: Iterable[bytes], jobs: Sequence[Job], progress: Progress) -> list[Outcome]:
    """Write `chunks` (all but the last of :data:`CHUNK_BYTES`) to every job; a card that fails stops no other.

    Raises
    ------
    KeyboardInterrupt
        Ctrl-C: cards in progress are half written, as their outcome and stderr report.
    """
    stop = threading.Event()
    writers = [_Writer(job, progress, stop, Outcome(job.name)) for job in jobs]
    threads = [threading.Thread(target=each.run, name=f"write {each.job.name}") for each in writers]
    for thread in threads:
        thread.start()
    try:
        for chunk in chunks:
            for each in writers:
                each.inbox.put(chunk)
            if all(each.outcome.error for each in writers):
                break
        _finish(writers, threads)
    except BaseException:
        stop.set()
        _finish(writers, threads)
        raise
    return [each.outcome for each in writers]


def _finish(writers: Sequence[_Writer], threads: Sequence[threading.Thread]) -> None:
    for each in writers:
        each.inbox.put(None)
    for thread in threads:
        thread.join()


@contextmanager
def _open(path: Path, flags: int) -> Iterator[int]:
    """Open a card or a file; a card only if it is not mounted."""
    exclusive = os.O_EXCL if path.is_block_device() else 0
    number = os.open(path, flags | exclusive | os.O_CLOEXEC)
    try:
        yield number
    finally:
        os.close(number)


def _overlay(chunk: bytes, at: int, edited: int, edited_at: int) -> bytes:
    """Return `chunk` of the image at `at`, with the edited part in its place."""
    end = at + len(chunk)
    begin = max(at, edited_at)
    patch = os.pread(edited, max(0, end - begin), begin - edited_at) if begin < end else b""
    if not patch:
        return chunk
    return chunk[: begin - at] + patch + chunk[begin - at + len(patch) :]


def explain(error: OSError, target: Path, at_bytes: int) -> FullswarmError:
    """Return the error that explains an OSError to the user who writes a card."""
    where = str(target)
    if error.errno in (errno.EACCES, errno.EPERM):
        hint = 'cards are root\'s: `sudo -E "$(command -v fullswarm)" flash …`, or join group disk'
        return ConfigError("permission denied", where=where, hint=hint)
    if error.errno == errno.EBUSY:
        return ConfigError("is in use", where=where, hint="unmount it; desktops mount cards by themselves")
    if error.errno == errno.ENOSPC:
        what = f"is full after {at_bytes / 1e6:.0f} MB"
        return CardFailed(what, where=where, hint="use a larger card, or free some space")
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.ENOMEDIUM):
        return CardFailed("is gone", where=where, hint="was the card removed? insert it and flash it again")
    what = f"fails at {at_bytes / 1e6:.0f} MB: {error.strerror}"
    return CardFailed(what, where=where, hint="use another card, then another reader")
