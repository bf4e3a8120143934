"""Parts of a release as a tar stream, the same bytes each time: what goes over the air and onto a card."""

from __future__ import annotations

import os
import tarfile
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path

from fullswarm.deploy.release import manifest, sums

HEAD = (manifest.FILE, sums.FILE, sums.SIGNATURE)
"""The files by which a robot judges a release before it takes any other."""
_GZIP = 31  # window bits that make zlib write a gzip header, without a name or a time
_BLOCK = 1 << 16


def head(folder: Path) -> bytes:
    """Return the tar of the three files that say what a release is, for ``fullswarm-robot want``."""
    return b"".join(plain(folder, HEAD))


def gzipped(folder: Path, paths: Iterable[str], level: int = 6) -> Iterator[bytes]:
    """Yield the gzipped tar of some files of a release, for ``fullswarm-robot receive``."""
    squeezed = zlib.compressobj(level, wbits=_GZIP)
    for block in plain(folder, paths):
        if part := squeezed.compress(block):
            yield part
    yield squeezed.flush()


def plain(folder: Path, paths: Iterable[str]) -> Iterator[bytes]:
    """Yield the tar of some files of a release in blocks; its entries have no times and no owners."""
    for path in paths:
        with (folder / path).open("rb") as file:
            facts = os.fstat(file.fileno())
            size = facts.st_size
            yield _header(path, size, runs=bool(facts.st_mode & 0o100))
            while block := file.read(_BLOCK):
                yield block
        yield bytes(-size % tarfile.BLOCKSIZE)
    yield bytes(2 * tarfile.BLOCKSIZE)


def _header(path: str, size: int, *, runs: bool) -> bytes:
    entry = tarfile.TarInfo(path)
    entry.size, entry.mode = size, 0o755 if runs else 0o644
    return entry.tobuf(tarfile.GNU_FORMAT)
