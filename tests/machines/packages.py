"""Python packages for a guest's own Python, unpacked: nothing is installed inside a guest."""

from __future__ import annotations

import subprocess
import sys
import sysconfig
import tomllib
from pathlib import Path

import pytest

from tests.machines.cache import cached

REPOSITORY = Path(__file__).parents[2]


def requirements(*extras: str) -> tuple[str, ...]:
    """Return what fullswarm needs on board, and with these extras."""
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *(one for extra in extras for one in project["optional-dependencies"][extra])]
    return tuple(sorted(wanted))


def site_packages(platform: str, *extras: str, python: str = "3.11") -> Path:
    """Return a folder with those packages for another Python; skip the test when they are out of reach.

    Parameters
    ----------
    platform
        As uv names it, say ``x86_64-manylinux_2_28``.
    """
    wanted = requirements(*extras)
    return cached(
        f"site-{platform}-{python}", (wanted, platform, python), lambda path: _make(path, platform, python, wanted)
    )


def _make(path: Path, platform: str, python: str, wanted: tuple[str, ...]) -> None:
    program = Path(sysconfig.get_path("scripts")) / "uv"
    if not program.exists():
        pytest.skip("needs uv: pip install 'fullswarm[deploy]'")
    made = subprocess.run(
        [str(program), "pip", "install", "--quiet", "--python", sys.executable, "--target", str(path),
         "--python-version", python, "--python-platform", platform, "--only-binary", ":all:", *wanted],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if made.returncode and ("Failed to fetch" in made.stderr or "error sending request" in made.stderr):
        pytest.skip(f"Python packages are out of reach: {made.stderr.strip().splitlines()[-1]}")
    assert made.returncode == 0, made.stderr[-3000:]
