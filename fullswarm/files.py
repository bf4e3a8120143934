"""Writes files safely: a reader finds the old content or the new one; and a disk behind an interface, for faults."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Protocol


@contextmanager
def replacing(path: Path, mode: int = 0o666) -> Iterator[Path]:
    """Yield a new file beside `path` with the same ending, to write to; at the end it takes the place of `path`.

    It is created with `mode`, less the umask, and removed if anything fails.
    """
    part = path.with_name(f".{path.stem}-{socket.gethostname()}-{os.getpid()}{path.suffix}")
    try:
        part.touch(mode)  # what cannot be written is known before the work is done
        yield part
        part.replace(path)
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


def replace_file(path: Path, content: str | bytes, *, mode: int = 0o666, sync: bool = False) -> None:
    """Replace what `path` holds, text as UTF-8; `sync` waits for the disk, which a control loop must not do.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    with replacing(path, mode) as part, part.open("wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        if sync:
            file.flush()
            os.fsync(file.fileno())


class Disk(Protocol):
    """What a node may do with files. Any method may raise ``OSError``: a disk may be full or gone."""

    def read(self, file: Path) -> bytes:
        """Return the content of `file`."""
        ...

    def exists(self, file: Path) -> bool:
        """Tell whether `file` is there."""
        ...

    def write(self, file: Path, content: bytes) -> None:
        """Write `file` in its folder, made when missing, and wait until both are on the disk."""
        ...

    def replace(self, file: Path, content: bytes) -> None:
        """Replace `file` in its folder, made when missing, without waiting for the disk."""
        ...

    def remove(self, file: Path) -> None:
        """Remove `file` if it is there, and wait for the disk."""
        ...


class MachineDisk:
    """The disk of this computer."""

    def read(self, file: Path) -> bytes:
        """Return the content of `file`."""
        return file.read_bytes()

    def exists(self, file: Path) -> bool:
        """Tell whether `file` is there."""
        try:
            file.stat()
        except (FileNotFoundError, NotADirectoryError):
            return False
        return True

    def write(self, file: Path, content: bytes) -> None:
        """Write `file`, and wait until it and its name are on the disk."""
        file.parent.mkdir(parents=True, exist_ok=True)
        with file.open("wb") as opened:
            opened.write(content)
            opened.flush()
            os.fsync(opened.fileno())
        self._sync(file.parent)

    def replace(self, file: Path, content: bytes) -> None:
        """Replace `file` by way of a file beside it that ends in ``.part``."""
        file.parent.mkdir(parents=True, exist_ok=True)
        part = file.with_suffix(".part")
        part.write_bytes(content)
        part.replace(file)

    def remove(self, file: Path) -> None:
        """Remove `file` if it is there."""
        with suppress(FileNotFoundError, NotADirectoryError):
            file.unlink()
            self._sync(file.parent)

    def _sync(self, folder: Path) -> None:
        """Have the names in a folder on the disk too; Windows opens no folder and writes them with the file."""
        if os.name != "posix":
            return
        opened = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(opened)
        finally:
            os.close(opened)


MACHINE_DISK = MachineDisk()
