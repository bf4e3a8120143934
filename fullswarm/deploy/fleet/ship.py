"""What robots lack of a release, packed once for all that lack the same."""

from __future__ import annotations

import asyncio
import hashlib
import shutil
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from fullswarm.deploy.fleet.untrusted import clean
from fullswarm.deploy.release import manifest
from fullswarm.deploy.release.store import gzipped_archive, plain_archive
from fullswarm.errors import MessageError

GZIP_LEVEL = 6


def missing_of(release: Path, said: bytes, robot: str) -> tuple[str, ...]:
    """Read a robot's list of what it lacks: paths of this release and nothing else of our disk.

    Raises
    ------
    MessageError
        It asks for something that is not in the release.
    """
    known = manifest.read_sums(release)
    paths = tuple(dict.fromkeys(said.decode("utf-8", "replace").splitlines()))
    for path in paths:
        if path not in known:
            hint = "`fullswarm deploy` puts our program in place of what answers there"
            raise MessageError(f"asks for '{clean(path)}', which is not in the release", where=robot, hint=hint)
    return tuple(sorted(paths))


def size_of(release: Path) -> int:
    """Bytes that a whole release takes on a disk."""
    return sum((release / each).stat().st_size for each in manifest.read_sums(release))


@dataclass(slots=True)
class Parcels:
    """Archives in a folder of their own, each made when the first robot needs it.

    Parameters
    ----------
    folder
        On this machine, for as long as the command runs.
    """

    folder: Path
    _made: dict[str, asyncio.Task[Path]] = field(default_factory=dict)

    async def of(self, release: Path, missing: tuple[str, ...], *, zstd: bool) -> Path:
        """Return an archive with these files of a release: zstd where both sides have the program, else gzip."""
        codec = "zst" if zstd and shutil.which("zstd") else "gz"
        name = hashlib.sha256("\n".join((str(release), *missing)).encode()).hexdigest()[:16]
        place = self.folder / f"{name}.tar.{codec}"
        if place.name not in self._made:
            work = asyncio.to_thread(_zstd if codec == "zst" else _gzip, release, missing, place)
            self._made[place.name] = asyncio.create_task(work)
        # Shielded: a robot that is given up must not take the archive from the others.
        return await asyncio.shield(self._made[place.name])


def _gzip(release: Path, missing: Iterable[str], place: Path) -> Path:
    with place.open("wb") as file:
        file.writelines(gzipped_archive(release, missing, GZIP_LEVEL))
    return place


def _zstd(release: Path, missing: Iterable[str], place: Path) -> Path:
    with place.open("wb") as file:
        program = subprocess.Popen(["zstd", "-q", "-T0", "-6"], stdin=subprocess.PIPE, stdout=file)  # noqa: S607
        assert program.stdin is not None  # noqa: S101
        with program, program.stdin as stdin:
            stdin.writelines(plain_archive(release, missing))
    if program.returncode:
        raise OSError(f"zstd ended with exit code {program.returncode}")
    return place
