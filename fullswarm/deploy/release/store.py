"""The releases of a base station side by side; what did not change between two is on the disk once."""

from __future__ import annotations

import filecmp
import os
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

import platformdirs

from fullswarm.deploy.release import manifest, sums
from fullswarm.deploy.release.manifest import Manifest
from fullswarm.errors import ConfigError, did_you_mean

ENVIRONMENT = "FULLSWARM_RELEASES"
"""Names another folder for the releases."""


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
        """Return the ids of all releases, the one that was made last at the end."""
        if not self.folder.is_dir():
            return []
        there = [
            each for each in self.folder.iterdir() if manifest.is_id(each.name) and (each / sums.SIGNATURE).exists()
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
        if (path / manifest.FILE).is_file():
            return path.resolve()
        if release in (ids := self.ids()):
            return self.folder / release
        hint = did_you_mean(release, ids) if ids else "make one: fullswarm bundle --target rpi-arm64"
        raise ConfigError(f"there is no release '{release}'", where=str(self.folder), hint=hint)

    def latest(self, target: str | None = None, python: str | None = None) -> Path | None:
        """Return the release that was made last, of a target and a Python if they are named."""
        for name in reversed(self.ids()):
            made_for = Manifest.read(self.folder / name).target
            if target in (None, made_for.name) and python in (None, made_for.python):
                return self.folder / name
        return None

    def add(self, fresh: Path) -> Path:
        """Move a release into the store, hard-linked to the latest one of its target where they agree.

        `fresh` must be a signed release on the same file system; it is gone afterwards.
        """
        facts = Manifest.read(fresh)
        place = self.folder / facts.id
        before = self.latest(facts.target.name, facts.target.python)
        if before is not None:
            _share(fresh, before)
        newest = max((each.stat().st_mtime_ns for each in self._made()), default=0)
        if place.exists():
            shutil.rmtree(place)  # the same content by its name, unless it was modified: ours is intact
        fresh.replace(place)
        now = max(time.time_ns(), newest + 1)  # whatever the clock did, this one is the latest
        os.utime(place, ns=(now, now))
        return place

    def _made(self) -> list[Path]:
        return [self.folder / each for each in self.ids()]


def _share(fresh: Path, before: Path) -> None:
    """Replace files of `fresh` by hard links to the same ones of `before`."""
    old = sums.read(before)
    for path, digest in sums.read(fresh).items():
        mine, theirs = fresh / path, before / path
        # Compared byte by byte: a file that was damaged since must not get into the next release.
        if old.get(path) == digest and theirs.is_file() and filecmp.cmp(mine, theirs, shallow=False):
            linked = mine.with_name(f"{mine.name}.linked")
            os.link(theirs, linked)
            linked.replace(mine)
