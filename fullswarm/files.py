"""Replaces files in one step: a reader finds the old content or the new one, never a part of it."""

from __future__ import annotations

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


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
