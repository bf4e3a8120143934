"""Folders and files as a cpio archive that Linux unpacks into its memory and runs ``/init`` of."""

from __future__ import annotations

import stat
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import BinaryIO, Self

_MAGIC, _BLOCK = "070701", 4


def everything(_: str) -> bool:
    """Take every file."""
    return True


class Archive:
    """An archive that is written at the end of a file; a context manager. Everything in it belongs to root."""

    def __init__(self, path: Path) -> None:
        self._file: BinaryIO = path.open("ab")
        self._number = 0
        self._there: set[str] = set()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._entry("TRAILER!!!", 0, b"")
        self._file.close()

    def tree(self, source: Path, at: str = "", wanted: Callable[[str], bool] = everything) -> None:
        """Take a folder and all in it; `wanted` is asked about each path within `source`, with ``/`` between names."""
        for path in sorted(source.rglob("*")):
            inside = path.relative_to(source).as_posix()
            if not wanted(inside):
                continue
            name = f"{at}/{inside}".strip("/")
            if path.is_symlink():
                self.link(name, str(path.readlink()))
            elif path.is_dir():
                self.folder(name)
            elif path.is_file():
                self.file(name, path.read_bytes(), executable=bool(path.stat().st_mode & 0o100))

    def folder(self, name: str) -> None:
        """Make a folder and those above it."""
        parts = name.split("/")
        for depth in range(1, len(parts) + 1):
            above = "/".join(parts[:depth])
            if above and above not in self._there:
                self._there.add(above)
                self._entry(above, stat.S_IFDIR | 0o755, b"")

    def file(self, name: str, data: bytes, *, executable: bool = False) -> None:
        """Make a file."""
        self._make_room(name)
        self._entry(name, stat.S_IFREG | (0o755 if executable else 0o644), data)

    def link(self, name: str, target: str) -> None:
        """Make a symbolic link."""
        self._make_room(name)
        self._entry(name, stat.S_IFLNK | 0o777, target.encode())

    def device(self, name: str, major: int, minor: int) -> None:
        """Make a character device."""
        self._make_room(name)
        self._entry(name, stat.S_IFCHR | 0o600, b"", (major, minor))

    def _make_room(self, name: str) -> None:
        self.folder(name.rpartition("/")[0])

    def _entry(self, name: str, mode: int, data: bytes, device: tuple[int, int] = (0, 0)) -> None:
        self._number += 1
        fields = (self._number, mode, 0, 0, 1, 0, len(data), 0, 0, *device, len(name.encode()) + 1, 0)
        head = _MAGIC + "".join(f"{each:08x}" for each in fields) + f"{name}\0"
        for piece in (head.encode(), data):
            self._file.write(piece + b"\0" * (-len(piece) % _BLOCK))
