"""Simulates the disk of a computer on real files: it can be full, slow, and torn by a power cut."""

from __future__ import annotations

import errno
import os
import random
from collections.abc import Callable, Mapping
from pathlib import Path

from fullswarm.errors import ConfigError
from fullswarm.files import MachineDisk
from fullswarm.messages import ParamEntry
from fullswarm.store import Store, Stored

UNWRITTEN_S = 5.0
"""A power cut loses at most what a database has committed in so many seconds before it."""


class RehearsedDisk:
    """The disk of one computer; implements :class:`~fullswarm.files.Disk`.

    Parameters
    ----------
    folder : of its files
    stall : called with the seconds that a write takes on a slow disk

    Attributes
    ----------
    full : writes fail with ENOSPC
    slow_s : each write takes so long
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.full, self.slow_s = folder, False, 0.0
        self.stall: Callable[[float], None] = lambda _: None
        self._machine = MachineDisk()
        folder.mkdir(parents=True, exist_ok=True)

    def before_write(self) -> None:
        """Raise what a full disk raises; take the time that a slow one takes."""
        if self.slow_s:
            self.stall(self.slow_s)
        if self.full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def read(self, file: Path) -> bytes:
        """Return the content of `file`."""
        return self._machine.read(file)

    def exists(self, file: Path) -> bool:
        """Tell whether `file` is there."""
        return self._machine.exists(file)

    def write(self, file: Path, content: bytes) -> None:
        """Write `file`; a full disk leaves an empty one, as the system does."""
        try:
            self.before_write()
        except OSError:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(b"")
            raise
        self._machine.write(file, content)

    def replace(self, file: Path, content: bytes) -> None:
        """Replace `file`."""
        self.before_write()
        self._machine.replace(file, content)

    def remove(self, file: Path) -> None:
        """Remove `file` if it is there; a full disk can do that."""
        self._machine.remove(file)

    def tear(self, chance: random.Random) -> None:
        """Cut each small file at any byte, as a power cut in the middle of a write does."""
        for file in sorted(self.folder.rglob("*")):
            if file.suffix in (".estop", ".stop"):
                content = file.read_bytes()
                file.write_bytes(content[: chance.randrange(len(content) + 1)])


class RehearsedStore(Store):
    """A database on a :class:`RehearsedDisk`.

    Parameters
    ----------
    true_s : the simulated time
    """

    def __init__(self, disk: RehearsedDisk, wall_s: Callable[[], float], true_s: Callable[[], float]) -> None:
        self._disk, self._true_s = disk, true_s
        self.file = disk.folder / "core.db"
        self._sizes: list[tuple[float, int]] = [(true_s(), 0)]
        super().__init__(self.file, wall_s)

    @property
    def _log(self) -> Path:
        return self.file.with_name(f"{self.file.name}-wal")

    def set_many(self, values: Mapping[str, Stored], author: str) -> tuple[ParamEntry, ...]:
        """Write, unless the disk is full; see :meth:`~fullswarm.store.Store.set_many`."""
        try:
            self._disk.before_write()
        except OSError as error:
            raise ConfigError(
                "the local database fails: database or disk is full", where=str(self.file),
                hint="check that the folder exists, is writable and has room",
            ) from error  # fmt: skip
        entries = super().set_many(values, author)
        self._sizes.append((self._true_s(), self._log.stat().st_size))
        return entries

    def die(self) -> None:
        """Leave the file as the end of the process leaves it: all commits are in it."""
        self._unsaved.clear()
        self.close()

    def lose_power(self, chance: random.Random) -> None:
        """Leave the file as a power cut leaves it: the newest commits may be lost, the last one in the middle."""
        content, log = self.file.read_bytes(), self._log.read_bytes() if self._log.exists() else b""
        since_s = self._true_s() - UNWRITTEN_S
        safe = max((size for at_s, size in self._sizes if at_s <= since_s), default=0)
        self.die()
        for each in (self._log, self.file.with_name(f"{self.file.name}-shm")):
            each.unlink(missing_ok=True)
        self.file.write_bytes(content)
        if log:
            self._log.write_bytes(log[: chance.randint(min(safe, len(log)), len(log))])
