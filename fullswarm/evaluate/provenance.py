"""Records where a trial's figures come from: commit, versions, machine."""

from __future__ import annotations

import hashlib
import os
import platform
import shutil
import socket
import subprocess
from datetime import UTC, datetime
from functools import cache
from importlib import metadata
from pathlib import Path

import msgspec

import fullswarm
from fullswarm.clock import wall_time_s

PACKAGES = ("msgspec", "numba", "numpy", "osqp", "pybullet", "pydantic", "scipy", "shapely")
"""What computes figures."""
GIT_S = 10.0


def provenance(started_s: float | None, wall_s: float, attempts: int, launch_file: str, runner: str) -> Provenance:
    """Return the origin of a trial that this process has run.

    Parameters
    ----------
    started_s : wall clock, seconds since 1970; None: `wall_s` ago
    launch_file : the text of ``trial.toml``
    """
    if started_s is None:
        started_s = wall_time_s() - wall_s
    return Provenance(
        started=datetime.fromtimestamp(started_s, UTC).isoformat(timespec="milliseconds"),
        wall_s=round(wall_s, 3),
        attempts=attempts,
        host=socket.gethostname(),
        machine=machine(),
        python=platform.python_version(),
        fullswarm=fullswarm.__version__,
        git=commit(),
        packages=versions(),
        configuration=hashlib.sha256(launch_file.encode()).hexdigest(),
        runner=runner,
    )


@cache
def versions() -> dict[str, str]:
    """Return the versions of the packages that are installed."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


@cache
def machine() -> str:
    """Return processor and system."""
    return f"{_processor()} x {os.cpu_count()}, {platform.platform()}"


@cache
def commit() -> str:
    """Return the commit of the package's work tree, with ``+changes`` when it differs; empty outside of one."""
    folder = Path(fullswarm.__file__).parent
    revision = _git(folder, "rev-parse", "HEAD")
    # A package within another project's repository (an environment in a project's folder) is not of that commit.
    if not revision or not _git(folder, "ls-files", "--", "__init__.py"):
        return ""
    return revision + ("+changes" if _git(folder, "status", "--porcelain", "--", ".") else "")


def _git(folder: Path, *words: str) -> str:
    git = shutil.which("git")
    if git is None:
        return ""
    try:
        done = subprocess.run(  # noqa: S603  (git itself, and words of ours)
            [git, "-C", str(folder), *words], capture_output=True, text=True, timeout=GIT_S, check=False
        )
    except (OSError, subprocess.SubprocessError):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text("utf-8").splitlines()
    except OSError:
        lines = []
    names = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or platform.machine()


class Provenance(msgspec.Struct, frozen=True, kw_only=True):
    """``provenance.json``: nothing in it may change a figure."""

    started: str = ""  # ISO 8601, UTC
    wall_s: float = 0.0
    attempts: int = 1
    host: str = ""
    machine: str = ""  # processor and system
    python: str = ""
    fullswarm: str = ""
    git: str = ""  # commit, with "+changes" when the work tree had any; empty outside a repository
    packages: dict[str, str] = {}  # name → version of what computes figures
    configuration: str = ""  # sha256 of trial.toml
    runner: str = "pool"  # pool, dask, live, fleet
    evidence: str = ""  # sha256 of the arrays of evidence.npz
