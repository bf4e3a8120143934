"""Runs uv, the resolver and installer: for another machine than this one, and never from sources."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from fullswarm.errors import ConfigError, MissingExtra, Unreachable

_HERE = Path(sys.executable).parent
_OFFLINE = ("failed to fetch", "error sending request", "could not connect", "dns error", "network connectivity")


def run(folder: Path, *arguments: str | Path, why: str) -> str:
    """Run uv in `folder` and return its stdout; `why` says in an error what was wanted of it.

    Raises
    ------
    MissingExtra
        uv is not installed.
    Unreachable
        The package index does not answer.
    ConfigError
        uv says no, for instance because a package has no wheel for the target.
    """
    tool = shutil.which("uv", path=f"{_HERE}{os.pathsep}{os.environ.get('PATH', '')}")
    if tool is None:
        raise MissingExtra(f"cannot {why}: uv is not installed", hint="pip install 'fullswarm[deploy]'")
    settings = {**os.environ, "UV_PYTHON_DOWNLOADS": "never", "UV_NO_PROGRESS": "1", "NO_COLOR": "1"}
    done = subprocess.run(  # noqa: S603  (uv itself; no shell)
        [tool, *map(str, arguments)], cwd=folder, env=settings, capture_output=True, text=True, check=False
    )
    if done.returncode == 0:
        return done.stdout
    words = " ".join(done.stderr.split()).removeprefix("error: ") or f"uv ended with {done.returncode}"
    if any(each in words.lower() for each in _OFFLINE):
        hint = "connect, or give a folder of wheels: --wheels DIR"
        raise Unreachable(f"cannot {why}: no package index answers: {words}", hint=hint)
    raise ConfigError(f"cannot {why}: {words}")
