"""Which release of the store fits a robot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from fullswarm.deploy.release.manifest import Manifest
from fullswarm.errors import ConfigError

if TYPE_CHECKING:
    from fullswarm.deploy.fleet.facts import Facts
    from fullswarm.deploy.release.store import Store

TARGET_OF = {"aarch64": "rpi-arm64", "x86_64": "x86_64"}


def choose(store: Store, named: str | None, facts: Facts, robot: str, target: str | None = None) -> Path:
    """Return the folder of the release that was named, or of the newest one that fits.

    Raises
    ------
    ConfigError
        There is none, or the one that was named does not fit; says which command makes one.
    """
    if named is not None:
        folder = store.get(named)
        reason = misfit(Manifest.read(folder), facts)
        if reason:
            raise ConfigError(f"release {folder.name} {reason}", where=robot, hint=_make(facts))
        return folder
    for name in reversed(store.ids()):
        folder = store.get(name)
        manifest = Manifest.read(folder)
        if target in (None, manifest.target.name) and not misfit(manifest, facts):
            return folder
    what = f"no release fits it ({facts.arch}, python {python_of(facts) or 'none'}, glibc {facts.glibc or '?'})"
    raise ConfigError(what, where=robot, hint=_make(facts))


def misfit(manifest: Manifest, facts: Facts) -> str:
    """Say why a robot cannot run a release; empty when it can."""
    wanted = manifest.target
    if facts.arch != wanted.arch:
        return f"is for {wanted.arch}, this computer is {facts.arch or 'silent about it'}"
    if wanted.python not in (python_of(facts), *facts.pythons):
        return f"is for Python {wanted.python}, here is {python_of(facts) or 'none'}"
    if facts.glibc and _numbers(facts.glibc) < _numbers(wanted.glibc):
        return f"needs glibc {wanted.glibc}, here is {facts.glibc}"
    return ""


def python_of(facts: Facts) -> str:
    """``3.11``, whatever follows."""
    return ".".join(facts.python.split(".")[:2])


def _make(facts: Facts) -> str:
    if facts.arch not in TARGET_OF:
        return "releases are made for 64-bit ARM and x86: install a 64-bit system there"
    python = f" --python {python_of(facts)}" if python_of(facts) else ""
    return f"make one: fullswarm bundle --target {TARGET_OF[facts.arch]}{python}"


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split(".") if part.isdecimal())
