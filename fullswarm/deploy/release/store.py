"""Keeps the releases of a base station side by side, and packs parts of one as a tar stream.

What did not change between two releases is on the disk once. A tar stream has the same bytes each time; it goes over
the network and onto a card.
"""

from __future__ import annotations

import filecmp
import os
import shutil
import tarfile
import time
import zlib
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import platformdirs

from fullswarm.deploy.release import manifest
from fullswarm.deploy.release.manifest import Manifest
from fullswarm.errors import ConfigError, did_you_mean

ENVIRONMENT = "FULLSWARM_RELEASES"
"""Names another folder for the releases."""
HEAD = (manifest.MANIFEST, manifest.SUMS, manifest.SIGNATURE, manifest.STATEMENT)
"""The files by which a robot verifies a release before it accepts any other."""
_GZIP = 31  # window bits that make zlib write a gzip header, without a name or a time
_BLOCK = 1 << 16


@dataclass(frozen=True, slots=True)
class Store:
    """A folder with one folder per release, named by its id."""

    folder: Path

    @classmethod
    def default(cls) -> Store:
        """Return the store of this user, or the one that ``FULLSWARM_RELEASES`` names."""
        named = os.environ.get(ENVIRONMENT)
        return cls(Path(named) if named else platformdirs.user_data_path("fullswarm") / "releases")

    def ids(self) -> list[str]:
        """Return the ids of all releases, the latest one last."""
        if not self.folder.is_dir():
            return []
        there = [
            each for each in self.folder.iterdir() if manifest.is_id(each.name) and (each / manifest.SIGNATURE).exists()
        ]
        return [each.name for each in sorted(there, key=lambda each: (each.stat().st_mtime_ns, each.name))]

    def get(self, release: str) -> Path:
        """Return the folder of a release by its id, or by the folder itself.

        Raises
        ------
        ConfigError
            There is none.
        """
        path = Path(release)
        if (path / manifest.MANIFEST).is_file():
            return path.resolve()
        if release in (ids := self.ids()):
            return self.folder / release
        hint = did_you_mean(release, ids) if ids else "make one: fullswarm bundle --target rpi-arm64"
        raise ConfigError(f"there is no release '{release}'", where=str(self.folder), hint=hint)

    def latest(self, target: str | None = None, python: str | None = None) -> Path | None:
        """Return the latest release, of a target and a Python if they are named."""
        for name in reversed(self.ids()):
            made_for = Manifest.read(self.folder / name).target
            if target in (None, made_for.name) and python in (None, made_for.python):
                return self.folder / name
        return None

    def add(self, fresh: Path) -> Path:
        """Move a release into the store, hard-linked to the latest one of its target where they agree.

        `fresh` must be a signed release on the same file system; it is moved away.
        """
        facts = Manifest.read(fresh)
        place = self.folder / facts.id
        before = self.latest(facts.target.name, facts.target.python)
        if before is not None:
            _share(fresh, before)
        newest = max((each.stat().st_mtime_ns for each in self._made()), default=0)
        if place.exists():
            shutil.rmtree(place)  # of the same content, unless it was modified since
        fresh.replace(place)
        now = max(time.time_ns(), newest + 1)  # the latest one, even if the clock was set back
        os.utime(place, ns=(now, now))
        return place

    def _made(self) -> list[Path]:
        return [self.folder / each for each in self.ids()]


def _share(fresh: Path, before: Path) -> None:
    """Replace files of `fresh` by hard links to the same ones of `before`."""
    old = manifest.read_sums(before)
    for path, digest in manifest.read_sums(fresh).items():
        mine, theirs = fresh / path, before / path
        # Compared byte by byte: a file that was damaged since must not be linked into the next release.
        if old.get(path) == digest and theirs.is_file() and filecmp.cmp(mine, theirs, shallow=False):
            linked = mine.with_name(f"{mine.name}.linked")
            os.link(theirs, linked)
            linked.replace(mine)


# ---------------------------------------------------------------- archives
def head_archive(folder: Path) -> bytes:
    """Return the tar of the files that describe a release, for ``fullswarm-robot want``."""
    return b"".join(plain_archive(folder, HEAD))


def roots_archive(documents: Sequence[str], first: int) -> bytes:
    """Return the tar of versions of the root metadata from `first` on, for ``fullswarm-robot trust``."""
    blocks = []
    for number, document in enumerate(documents, first):
        data = document.encode("ascii")
        blocks += [_header(f"{number}.root", len(data), runs=False), data, bytes(-len(data) % tarfile.BLOCKSIZE)]
    return b"".join((*blocks, bytes(2 * tarfile.BLOCKSIZE)))


def gzipped_archive(folder: Path, paths: Iterable[str], level: int = 6) -> Iterator[bytes]:
    """Yield the gzipped tar of some files of a release, for ``fullswarm-robot receive``."""
    squeezed = zlib.compressobj(level, wbits=_GZIP)
    for block in plain_archive(folder, paths):
        if part := squeezed.compress(block):
            yield part
    yield squeezed.flush()


def plain_archive(folder: Path, paths: Iterable[str]) -> Iterator[bytes]:
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
