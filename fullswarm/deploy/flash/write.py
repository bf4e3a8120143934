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
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from fullswarm.deploy.flash.image import CHUNK_BYTES, put_sparse, write_all
from fullswarm.errors import ConfigError, FullswarmError

_QUEUED_CHUNKS = 4
_SYNC_BYTES = 64 << 20
"""What has been written is waited for this often, so that progress is the card's and not the memory's."""

Progress = Callable[[str, str, int], None]
"""Is told: which job, what it does (`write` or `read back`), how many bytes so far."""


class CardFailed(FullswarmError):
    """A card or its reader did not take, keep or give back what was written."""


@dataclass(frozen=True, slots=True)
class Job:
    """One card or file to write; `edited` is what takes the place of the image from `edited_at` on."""

    name: str
    target: Path
    edited: Path
    edited_at: int


@dataclass(slots=True)
class Outcome:
    """How it went; times in seconds."""

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
        """Write, wait for the card, read back; what goes wrong stands in the outcome."""
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
            while not self._fed:  # the feeding thread must not wait for ever
                self._next()

    def _next(self) -> bytes | None:
        chunk = self.inbox.get()
        self._fed = chunk is None
        return chunk

    def _write(self) -> None:
        began_s, digest, synced = time.monotonic(), hashlib.sha256(), 0
        with _open(self.job.target, os.O_WRONLY) as file, self.job.edited.open("rb") as edited:
            sparse = stat.S_ISREG(os.fstat(file.number).st_mode)
            while (chunk := self._next()) is not None:
                at = self.outcome.bytes
                data = _overlay(chunk, at, edited.fileno(), self.job.edited_at)
                if sparse:
                    put_sparse(file.number, data, at)
                else:
                    write_all(file.number, data, at)
                digest.update(data)
                self._crcs.append(zlib.crc32(data))
                self.outcome.bytes = at + len(data)
                if self.outcome.bytes - synced >= _SYNC_BYTES:
                    os.fdatasync(file.number)
                    synced = self.outcome.bytes
                self.progress(self.job.name, "write", self.outcome.bytes)
            if self.stop.is_set():
                raise CardFailed("interrupted: half written", where=self.job.name, hint="flash it again")
            if sparse:
                os.truncate(file.number, self.outcome.bytes)
            os.fsync(file.number)
        self.outcome.sha256 = digest.hexdigest()
        self.outcome.write_s = time.monotonic() - began_s

    def _read_back(self) -> None:
        began_s, digest, done = time.monotonic(), hashlib.sha256(), 0
        with _open(self.job.target, os.O_RDONLY) as file:
            os.posix_fadvise(file.number, 0, 0, os.POSIX_FADV_DONTNEED)  # from the card, not from memory
            for crc in self._crcs:
                if self.stop.is_set():
                    raise CardFailed("interrupted before it was read back", where=self.job.name, hint="flash it again")
                data = os.pread(file.number, min(CHUNK_BYTES, self.outcome.bytes - done), done)
                if zlib.crc32(data) != crc:
                    what = f"gives back something else than was written, from {done / 1e6:.0f} MB on"
                    hint = "the card is worn out or smaller than it says, or the reader is bad: take another one"
                    raise CardFailed(what, where=self.job.name, hint=hint)
                digest.update(data)
                done += len(data)
                self.progress(self.job.name, "read back", done)
        if digest.hexdigest() != self.outcome.sha256:
            raise CardFailed("gives back something else than was written", where=self.job.name, hint="take another")
        self.outcome.verify_s = time.monotonic() - began_s


def write_jobs(chunks: Iterable[bytes], jobs: Sequence[Job], progress: Progress) -> list[Outcome]:
    """Write `chunks` (all but the last of :data:`CHUNK_BYTES`) to every job; a card that fails stops no other.

    Raises
    ------
    KeyboardInterrupt
        Ctrl-C: what was begun is half written, and says so in its outcome and on stderr.
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


@dataclass(slots=True)
class _open:  # noqa: N801  (reads like the built-in)
    """A file descriptor for a card or a file; a card only if it is not mounted."""

    path: Path
    flags: int
    number: int = -1

    def __enter__(self) -> _open:
        exclusive = os.O_EXCL if self.path.is_block_device() else 0
        self.number = os.open(self.path, self.flags | exclusive | os.O_CLOEXEC)
        return self

    def __exit__(self, *_: object) -> None:
        os.close(self.number)


def _overlay(chunk: bytes, at: int, edited: int, edited_at: int) -> bytes:
    """Return `chunk` of the image at `at`, with the edited part in its place."""
    end = at + len(chunk)
    begin = max(at, edited_at)
    patch = os.pread(edited, max(0, end - begin), begin - edited_at) if begin < end else b""
    if not patch:
        return chunk
    return chunk[: begin - at] + patch + chunk[begin - at + len(patch) :]


def explain(error: OSError, target: Path, at_bytes: int) -> FullswarmError:
    """Return what a kernel error means for the user who writes a card."""
    where = str(target)
    if error.errno in (errno.EACCES, errno.EPERM):
        hint = 'cards are root\'s: `sudo -E "$(command -v fullswarm)" flash …`, or join group disk'
        return ConfigError("this user may not read and write it", where=where, hint=hint)
    if error.errno == errno.EBUSY:
        return ConfigError("is in use", where=where, hint="unmount it; desktops mount cards by themselves")
    if error.errno == errno.ENOSPC:
        what = f"is full after {at_bytes / 1e6:.0f} MB"
        return CardFailed(what, where=where, hint="take a larger card, or free some space")
    if error.errno in (errno.ENOENT, errno.ENODEV, errno.ENXIO, errno.ENOMEDIUM):
        return CardFailed("is gone", where=where, hint="was the card pulled out? Put it back and flash it again")
    what = f"fails at {at_bytes / 1e6:.0f} MB: {error.strerror}"
    return CardFailed(what, where=where, hint="take another card, then another reader")
