"""Makes a release: wheels for the target, fullswarm, the robot's files; then sums, a name, a signature, the store."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

from fullswarm import __version__
from fullswarm.deploy.release import manifest
from fullswarm.deploy.release.contents import copy_app, copy_robot_files, trim
from fullswarm.deploy.release.keys import Keys, sign_release
from fullswarm.deploy.release.manifest import Manifest, Target
from fullswarm.deploy.release.packages import (
    Wanted,
    check_extras,
    find_outside,
    install_outside,
    install_packages,
    resolve,
)
from fullswarm.deploy.release.store import Store
from fullswarm.errors import ConfigError

Say = Callable[[str], None]


@dataclass(frozen=True, slots=True)
class BundleRequest:
    """The options of `fullswarm bundle`.

    Attributes
    ----------
    packages
        Outside behaviours and drivers: wheels, or folders with a ``pyproject.toml``.
    upgrade
        Use the newest versions; else those of the latest release for the target stay wherever they fit, so that an
        update carries only what changed.
    wheels
        A folder with all wheels, instead of a package index.
    """

    target: Target
    extras: tuple[str, ...] = ()
    packages: tuple[Path, ...] = ()
    upgrade: bool = False
    wheels: Path | None = None


def plan(request: BundleRequest, store: Store) -> Mapping[str, str]:
    """Return ``{package: version}`` of what a release would hold, without making it.

    Raises
    ------
    FullswarmError
        As :func:`make`.
    """
    with tempfile.TemporaryDirectory() as work:
        return _planned(request, store, Path(work))[1]


def make(request: BundleRequest, store: Store, keys: Keys, say: Say = lambda _: None) -> Path:
    """Make a release, or the same one again; return its folder in the store. `say` gets a line for each step.

    Raises
    ------
    ConfigError
        The request cannot be met: an unknown extra, a package without a wheel for the target, versions too old.
    Unreachable
        No package index answers, and no folder of wheels is given.
    MissingExtra
        uv is not installed.
    """
    keys.signing_key()  # before the work: without a key it would be for nothing
    with tempfile.TemporaryDirectory() as scratch, staging(store) as fresh:
        work = Path(scratch)
        say(f"finding packages for {request.target.name}, Python {request.target.python} ...")
        wanted, packages = _planned(request, store, work)
        say(f"getting {len(packages)} packages ...")
        lib, app = fresh / "lib", fresh / "app"
        install_packages(wanted, packages, work, lib)
        install_outside(wanted, work, app)
        trim(lib)
        trim(app, whole=True)
        copy_app(app / "fullswarm")
        copy_robot_files(fresh / "robot")
        say("signing ...")
        outsiders = {each.name: each.version for each in wanted.outside}
        everything = MappingProxyType(dict(sorted({**packages, **outsiders}.items())))
        return seal(fresh, Manifest("", __version__, request.target, wanted.extras, everything), store, keys)


def _planned(request: BundleRequest, store: Store, work: Path) -> tuple[Wanted, dict[str, str]]:
    extras = tuple(sorted(set(request.extras)))
    check_extras(extras)
    if request.wheels is not None and not request.wheels.is_dir():
        raise ConfigError("no such folder", where=f"--wheels {request.wheels}")
    depot = None if request.wheels is None else request.wheels.absolute()
    outsiders = tuple(find_outside(each, work, depot) for each in request.packages)
    before = None if request.upgrade else store.latest(request.target.name, request.target.python)
    versions = {} if before is None else Manifest.read(before).packages
    wanted = Wanted(request.target, extras, outsiders, versions, depot)
    return wanted, resolve(wanted, work)


@contextmanager
def staging(store: Store) -> Iterator[Path]:
    """Yield an empty folder to build a release in, on the store's own file system; remove it at the end.

    Raises
    ------
    ConfigError
        The store cannot be written.
    """
    try:
        store.folder.mkdir(parents=True, exist_ok=True)
        scratch = Path(tempfile.mkdtemp(prefix=".making-", dir=store.folder))
    except OSError as error:
        hint = "name another folder: --out DIR"
        raise ConfigError(
            f"no release can be made here: {error.strerror}", where=str(store.folder), hint=hint
        ) from error
    try:
        fresh = scratch / "release"
        fresh.mkdir(mode=0o755)
        yield fresh
    finally:
        shutil.rmtree(scratch)


def seal(folder: Path, facts: Manifest, store: Store, keys: Keys) -> Path:
    """Add id, checksums and signature to `folder`, and move it into the store; return its path there."""
    _same_modes(folder)
    named = replace(facts, id=manifest.id_for(facts, manifest.sums_of(folder, without=(manifest.MANIFEST,))))
    (folder / manifest.MANIFEST).write_text(named.to_json(), "utf-8")
    (folder / manifest.SUMS).write_text(manifest.sums_of(folder), "utf-8")
    sign_release(folder, keys)
    return store.add(folder)


def _same_modes(folder: Path) -> None:
    """Set the same modes as on any other machine: 0755 for folders and what may run, 0644 for all else."""
    for path in folder.rglob("*"):
        path.chmod(0o755 if path.is_dir() or path.stat().st_mode & 0o100 else 0o644)
