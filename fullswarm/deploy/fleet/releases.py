"""Decides which release a robot gets: which one of the store fits, what the robot lacks of it, what it should run."""

from __future__ import annotations

import asyncio
import hashlib
import json
import shutil
import subprocess
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import platformdirs

from fullswarm import output
from fullswarm.bus.endpoint import is_secured
from fullswarm.deploy.fleet.remote import clean
from fullswarm.deploy.release import manifest
from fullswarm.deploy.release.manifest import Manifest
from fullswarm.deploy.release.packages import ONBOARD
from fullswarm.deploy.release.store import gzipped_archive, plain_archive
from fullswarm.drivers.make import make_of
from fullswarm.drivers.ranges import extra_of
from fullswarm.errors import ConfigError, MessageError
from fullswarm.files import replace_file
from fullswarm.portability import lock as lock_file

if TYPE_CHECKING:
    from fullswarm.config import RobotConfig, SwarmConfig
    from fullswarm.deploy.fleet.facts import Facts
    from fullswarm.deploy.release.store import Store

TARGET_OF = {"aarch64": "rpi-arm64", "x86_64": "x86_64"}
GZIP_LEVEL = 6


def extras_needed(robot: RobotConfig, config: SwarmConfig) -> frozenset[str]:
    """Return the extras that a release must have for the robot's agent to start, and to renew its certificate."""
    needed = {"keys"} if is_secured(config.hub.endpoint) else set()
    always = frozenset(needed | ({extra_of(robot.ranges)} & ONBOARD.keys()))
    try:
        return always | frozenset({make_of(robot.url).extra} & ONBOARD.keys())
    except ConfigError:
        return always  # its package is on board only: brought by `bundle --package`


def choose_release(
    store: Store,
    named: str | None,
    facts: Facts,
    robot: str,
    target: str | None = None,
    extras: frozenset[str] = frozenset(),
) -> Path:
    """Return the folder of the release that was named, or of the newest one that fits, with the extras it needs.

    Raises
    ------
    ConfigError
        There is none, or the named one does not fit; the hint is the command that makes one.
    """
    if named is not None:
        folder = store.get(named)
        reason = misfit(Manifest.read(folder), facts, extras)
        if reason:
            raise ConfigError(f"release {folder.name} {reason}", where=robot, hint=_how_to_make(facts, extras))
        return folder
    for name in reversed(store.ids()):
        folder = store.get(name)
        manifest = Manifest.read(folder)
        if target in (None, manifest.target.name) and not misfit(manifest, facts, extras):
            return folder
    parts = [facts.arch, f"python {python_of(facts) or 'none'}", f"glibc {facts.glibc or '?'}"]
    parts += [f"with {','.join(sorted(extras))}"] if extras else []
    raise ConfigError(f"no release fits it ({', '.join(parts)})", where=robot, hint=_how_to_make(facts, extras))


def misfit(manifest: Manifest, facts: Facts, extras: frozenset[str] = frozenset()) -> str:
    """Return why a robot cannot run a release; empty when it can."""
    wanted = manifest.target
    if facts.arch != wanted.arch:
        return f"is for {wanted.arch}, this computer is {facts.arch or 'unknown'}"
    if wanted.python not in (python_of(facts), *facts.pythons):
        return f"is for Python {wanted.python}, here is {python_of(facts) or 'none'}"
    if facts.glibc and _numbers(facts.glibc) < _numbers(wanted.glibc):
        return f"needs glibc {wanted.glibc}, here is {facts.glibc}"
    if lacking := extras - set(manifest.extras):
        return f"lacks what its agent needs: {', '.join(sorted(lacking))}"
    return ""


def python_of(facts: Facts) -> str:
    """Return ``3.11`` without what follows."""
    return ".".join(facts.python.split(".")[:2])


def _how_to_make(facts: Facts, extras: frozenset[str]) -> str:
    if facts.arch not in TARGET_OF:
        return "releases are made for 64-bit ARM and x86: install a 64-bit system there"
    python = f" --python {python_of(facts)}" if python_of(facts) else ""
    return f"make one: fullswarm bundle --target {TARGET_OF[facts.arch]}{python}{with_option(extras)}"


def with_option(extras: frozenset[str]) -> str:
    """Return the option that adds extras, with a space before it; empty for none."""
    return f" --with {','.join(sorted(extras))}" if extras else ""


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split(".") if part.isdecimal())


# ---------------------------------------------------------------- what robots lack
def missing_of(release: Path, answer: bytes, robot: str) -> tuple[str, ...]:
    """Read a robot's list of missing files: paths of this release and nothing else of our disk.

    Raises
    ------
    MessageError
        It names a file that is not in the release.
    """
    known = manifest.read_sums(release)
    paths = tuple(dict.fromkeys(answer.decode("utf-8", "replace").splitlines()))
    for path in paths:
        if path not in known:
            hint = "`fullswarm deploy` installs our program in place of the one that answers"
            raise MessageError(f"requests '{clean(path)}', which is not in the release", where=robot, hint=hint)
    return tuple(sorted(paths))


def size_of(release: Path) -> int:
    """Return the bytes that a complete release takes on a disk."""
    return sum((release / each).stat().st_size for each in manifest.read_sums(release))


@dataclass(slots=True)
class Archives:
    """Archives of what robots lack, each made once, when the first robot needs it.

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
        # Shielded: cancelling one robot must not cancel the archive of the others.
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


# ---------------------------------------------------------------- what robots should run
@dataclass(frozen=True, slots=True)
class Desired:
    """One file per swarm: ``{robot: release}``."""

    file: Path

    @classmethod
    def of(cls, swarm: str) -> Desired:
        """Return the file of a swarm, in this user's state folder."""
        return cls(platformdirs.user_state_path("fullswarm") / "desired" / f"{swarm}.json")

    def read(self) -> dict[str, str]:
        """Return the desired releases; of a file that cannot be read, none."""
        try:
            raw = json.loads(self.file.read_text("utf-8"))
        except (OSError, ValueError):
            return {}
        if not isinstance(raw, dict):
            return {}
        return {robot: each for robot, each in raw.items() if isinstance(each, str) and manifest.is_id(each)}

    def want(self, releases: Mapping[str, str]) -> None:
        """Store the releases of some robots; those of the others stay.

        When the file cannot be written it only warns, because the results of the robots are still to be printed.
        """
        try:
            self.file.parent.mkdir(parents=True, exist_ok=True)
            with self.file.with_suffix(".lock").open("a") as lock:
                lock_file(lock.fileno(), wait=True)  # another terminal may update other robots
                replace_file(self.file, json.dumps({**self.read(), **releases}, indent=1, sort_keys=True) + "\n")
        except OSError as error:
            output.progress(f"warning: {self.file}: cannot store what robots should run: {error.strerror}")
