"""Root filesystems of Debian packages, for this or another processor."""

from __future__ import annotations

import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

from tests.machines.cache import cached
from tests.machines.needs import which

SUITE = "bookworm"
_OFFLINE = ("Temporary failure resolving", "Could not resolve", "Could not connect", "Unable to connect")


@dataclass(frozen=True)
class Recipe:
    """What a root filesystem is made of.

    Parameters
    ----------
    name
        For people who look into the cache.
    packages
        Debian packages; what they depend on comes along.
    variant
        mmdebstrap's: ``extract`` only unpacks, so it is quick and needs no emulation for another processor.
    hooks
        Further options of mmdebstrap.
    """

    name: str
    packages: tuple[str, ...]
    architecture: str = "amd64"
    variant: str = "extract"
    hooks: tuple[str, ...] = ()
    suite: str = SUITE


def root_filesystem(recipe: Recipe) -> Path:
    """Return the folder with the root filesystem; skip the test when Debian's packages are out of reach."""
    return cached(recipe.name, recipe, lambda path: _make(recipe, path))


def _make(recipe: Recipe, path: Path) -> None:
    program = which("mmdebstrap")
    assert program is not None
    made = subprocess.run(
        [program, f"--variant={recipe.variant}", f"--architectures={recipe.architecture}", "--format=directory",
         f"--include={','.join(recipe.packages)}", "--dpkgopt=path-exclude=/usr/share/doc/*",
         "--dpkgopt=path-exclude=/usr/share/man/*", "--dpkgopt=path-exclude=/usr/share/locale/*",
         *recipe.hooks, recipe.suite, str(path)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if made.returncode and any(each in made.stderr for each in _OFFLINE):
        pytest.skip(f"Debian's packages are out of reach: {made.stderr.strip().splitlines()[-1]}")
    assert made.returncode == 0, made.stderr[-3000:]
