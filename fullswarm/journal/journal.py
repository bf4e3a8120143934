"""The journal of one process: every input of its nodes and every output, in order.

A node is deterministic between its ports: the same inputs in the same order give the same outputs. So whatever comes in
through a port (a message, a timer, the time, a reading, an answer of a driver or a disk) is noted when it comes in, and
whatever goes out beside it. `feed.py` runs the same nodes on it again.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Generator, Iterator
from enum import IntEnum
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import structlog

log = structlog.get_logger()

FORMAT = 1
SUFFIX = ".journal"
FILE_BYTES = 8_000_000
"""From this size on a process begins its next file, so that what has been read can be removed."""
MOST_FILES = 8
"""Unread files of one process at most, as there are when no recorder runs; its journal ends then."""
HEADER = struct.Struct("<II")
"""Before each block of a file: length and CRC-32 of the compressed bytes that follow."""
LARGEST_BLOCK = 256 * 2**20
_ARRAY = 1


class Kind(IntEnum):
    """The first element of an item; a bare float is an answer of the clock."""

    TIMER = 0  # name: a timer fired
    MESSAGE = 1  # subscription, bytes, sender or None: a message was delivered
    CALL = 2  # name: the process itself called its nodes, e.g. to build them
    PUBLISH = 3  # key, bytes, sender
    ANSWER = 4  # port, value: what a call of a driver, a disk or the loop returned
    READING = 5  # see `readings.py`
    COMMAND = 6  # set-points, active flags, what was applied
    ASK = 7  # port, arguments: a call that changes something outside
    RAISED = 8  # type, text: the handler ended with an exception
    LAYOUT = 9  # the arrays of the readings that follow


CAUSES = (Kind.TIMER, Kind.MESSAGE, Kind.CALL)
"""Items that begin an event; those up to the next one belong to it."""


def _pack(value: object) -> object:
    if isinstance(value, np.ndarray):
        head = msgspec.msgpack.encode((value.dtype.str, value.shape))
        return msgspec.msgpack.Ext(_ARRAY, struct.pack("<I", len(head)) + head + value.tobytes())
    raise NotImplementedError(f"a journal cannot hold a {type(value).__name__}")


def _unpack(code: int, data: memoryview) -> object:
    if code != _ARRAY:
        raise ValueError(f"unknown extension {code}")
    (size,) = struct.unpack_from("<I", data)
    kind, shape = msgspec.msgpack.decode(data[4 : 4 + size], type=tuple[str, tuple[int, ...]])
    dtype = np.dtype(kind)
    if dtype.hasobject:
        raise ValueError("an array of objects")
    return np.frombuffer(data[4 + size :], dtype).reshape(shape).copy()  # to be written to, as the one that was packed


_encoder = msgspec.msgpack.Encoder(enc_hook=_pack)
_decoder = msgspec.msgpack.Decoder(ext_hook=_unpack)


class Journal:
    """Collects the items of one process until they are taken.

    Handlers of a process run one at a time (:class:`fullswarm.runtime.Mailbox`), so items need no lock. Calls outside
    of an event, e.g. by another node of the process that has no journal, are not noted.

    Parameters
    ----------
    head : what the nodes were built of; the first item
    """

    def __init__(self, head: dict[str, object]) -> None:
        self.items: list[Any] = [{"format": FORMAT, **head}]
        self.inside = False
        self._number = 0

    def run(self, cause: tuple[object, ...], call: Callable[[], None]) -> None:
        """Run a handler as an event with this cause; one that is called by a handler belongs to that one's event."""
        if self.inside:
            call()
            return
        self.items.append(cause)
        self.inside = True
        try:
            call()
        except BaseException as error:  # any kind: it ends the process, and a journal is to show why
            self.items.append((Kind.RAISED, type(error).__name__, str(error)))
            raise
        finally:
            self.inside = False

    def note(self, item: object) -> None:
        """Add an item to the present event."""
        if self.inside:
            self.items.append(item)

    def take(self) -> bytes:
        """Return a block with the items since the last call, empty when there are none."""
        if not self.items:
            return b""
        block = _encoder.encode((self._number, self.items))
        self.items.clear()
        self._number += 1
        return block


def read_block(data: bytes) -> tuple[int, list[Any]]:
    """Return number and items of a compressed block.

    Raises
    ------
    ValueError
        It is none.
    """
    try:
        reader = zlib.decompressobj()
        block = reader.decompress(data, LARGEST_BLOCK)
        if not reader.eof:
            raise ValueError("a block of a journal is cut off, or too long")
        number, items = _decoder.decode(block)
    except (zlib.error, msgspec.DecodeError, TypeError, OverflowError, struct.error) as error:
        raise ValueError(f"no block of a journal: {error}") from None
    if not isinstance(number, int) or not isinstance(items, list):
        raise ValueError("no block of a journal")
    return number, items


def compressed(block: bytes) -> bytes:
    """Return a block as files hold it; `read_block` takes it so."""
    return zlib.compress(block, 1)


class JournalFile:
    """Writes the blocks of a process into files ``<process>.<n>.journal`` of a folder.

    A disk that fails ends the journal, never the process: that is said once.
    """

    def __init__(self, folder: Path, process: str, journal: Journal) -> None:
        self._folder, self._process, self._journal = folder, process, journal
        self._number, self._size, self._file = 0, 0, -1
        self._open = True
        self._attempt(self._begin)

    def flush(self) -> None:
        """Write what was noted since the last call."""
        block = self._journal.take()
        if block and self._open:
            data = compressed(block)
            self._attempt(lambda: self._write(HEADER.pack(len(data), zlib.crc32(data)) + data))

    def close(self) -> None:
        """Write the rest. Closing twice is fine."""
        self.flush()
        self._end()

    def _write(self, data: bytes) -> None:
        if self._size and self._size + len(data) > FILE_BYTES:
            self._begin()
        os.write(self._file, data)
        self._size += len(data)

    def _begin(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
        if len(list(self._folder.glob(f"{self._process}.*{SUFFIX}"))) >= MOST_FILES:
            raise OSError(f"{MOST_FILES} files of it wait to be read")
        self._number += 1
        path = self._folder / f"{self._process}.{self._number:06d}{SUFFIX}"
        self._file = os.open(
            path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_APPEND | getattr(os, "O_BINARY", 0), 0o600
        )
        self._size = 0

    def _attempt(self, act: Callable[[], None]) -> None:
        try:
            act()
        except OSError as error:
            self._end()
            log.warning("the journal ends here", where=str(self._folder), reason=error.strerror or str(error))

    def _end(self) -> None:
        self._open = False
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


class JournalTail:
    """Reads the blocks that processes write into a folder, and removes files that are read to their end."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._read: dict[Path, int] = {}

    def read(self, most_bytes: int) -> Iterator[tuple[str, bytes]]:
        """Yield process and compressed block of those that are new, up to about so many bytes of each file."""
        files = sorted(self._folder.glob(f"*{SUFFIX}"))
        newest = {_process_of(path): path for path in files}
        for path in files:
            whole = yield from self._read_file(path, most_bytes)
            if whole and newest[_process_of(path)] != path:  # its process writes the next one
                self._read.pop(path, None)
                path.unlink(missing_ok=True)

    def _read_file(self, path: Path, most_bytes: int) -> Generator[tuple[str, bytes], None, bool]:
        start = self._read.get(path, 0)
        try:
            with path.open("rb") as file:
                size = os.fstat(file.fileno()).st_size
                while start + HEADER.size <= size and most_bytes > 0:
                    file.seek(start)
                    length, crc = HEADER.unpack(file.read(HEADER.size))
                    if length > LARGEST_BLOCK or start + HEADER.size + length > size:
                        break
                    data = file.read(length)
                    if zlib.crc32(data) != crc:
                        break
                    start += HEADER.size + length
                    most_bytes -= length
                    self._read[path] = start
                    yield _process_of(path), data
        except OSError:
            return False
        return start >= size


def _process_of(path: Path) -> str:
    return path.name.rsplit(".", 2)[0]
