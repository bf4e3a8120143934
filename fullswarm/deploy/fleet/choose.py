"""Which release of the store fits a robot."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from fullswarm.deploy.release.manifest import Manifest
from fullswarm.deploy.release.packages import ONBOARD
from fullswarm.drivers.make import make_of
from fullswarm.errors import ConfigError

if TYPE_CHECKING:
    from fullswarm.config import RobotConfig, SwarmConfig
    from fullswarm.deploy.fleet.facts import Facts
    from fullswarm.deploy.release.store import Store

TARGET_OF = {"aarch64": "rpi-arm64", "x86_64": "x86_64"}


def needs(robot: RobotConfig, config: SwarmConfig) -> frozenset[str]:
    """Return the extras that a release must have, or the robot's agent would not start."""
    try:
        driver = {make_of(robot.url).extra} & ONBOARD.keys()
    except ConfigError:
        driver = set()  # its package is on board only: brought by `bundle --package`
    fuses = {"estimation"} if config.agent.estimator == "ekf" else set()
    return frozenset(driver | fuses)


def choose(
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
        There is none, or the one that was named does not fit; says which command makes one.
    """
    if named is not None:
        folder = store.get(named)
        reason = misfit(Manifest.read(folder), facts, extras)
        if reason:
            raise ConfigError(f"release {folder.name} {reason}", where=robot, hint=_make(facts, extras))
        return folder
    for name in reversed(store.ids()):
        folder = store.get(name)
        manifest = Manifest.read(folder)
        if target in (None, manifest.target.name) and not misfit(manifest, facts, extras):
            return folder
    parts = [facts.arch, f"python {python_of(facts) or 'none'}", f"glibc {facts.glibc or '?'}"]
    parts += [f"with {','.join(sorted(extras))}"] if extras else []
    raise ConfigError(f"no release fits it ({', '.join(parts)})", where=robot, hint=_make(facts, extras))


def misfit(manifest: Manifest, facts: Facts, extras: frozenset[str] = frozenset()) -> str:
    """Say why a robot cannot run a release; empty when it can."""
    wanted = manifest.target
    if facts.arch != wanted.arch:
        return f"is for {wanted.arch}, this computer is {facts.arch or 'silent about it'}"
    if wanted.python not in (python_of(facts), *facts.pythons):
        return f"is for Python {wanted.python}, here is {python_of(facts) or 'none'}"
    if facts.glibc and _numbers(facts.glibc) < _numbers(wanted.glibc):
        return f"needs glibc {wanted.glibc}, here is {facts.glibc}"
    if lacking := extras - set(manifest.extras):
        return f"was made without what its agent needs: {', '.join(sorted(lacking))}"
    return ""


def python_of(facts: Facts) -> str:
    """``3.11``, whatever follows."""
    return ".".join(facts.python.split(".")[:2])


def _make(facts: Facts, extras: frozenset[str]) -> str:
    if facts.arch not in TARGET_OF:
        return "releases are made for 64-bit ARM and x86: install a 64-bit system there"
    python = f" --python {python_of(facts)}" if python_of(facts) else ""
    return f"make one: fullswarm bundle --target {TARGET_OF[facts.arch]}{python}{with_(extras)}"


def with_(extras: frozenset[str]) -> str:
    """Return the option that asks for extras, with a space before it; empty for none."""
    return f" --with {','.join(sorted(extras))}" if extras else ""


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(int(part) for part in version.split(".") if part.isdecimal())
