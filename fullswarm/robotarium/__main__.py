"""Runs a script of the Robotarium that stays as it is: ``python -m fullswarm.robotarium script.py [its arguments]``."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path

from fullswarm.errors import ConfigError
from fullswarm.output import run_guarded


def _prepare() -> int:
    if len(sys.argv) < 2 or not Path(sys.argv[1]).is_file():
        what = f"no such file: {sys.argv[1]}" if len(sys.argv) > 1 else "no script is given"
        raise ConfigError(what, where="fullswarm.robotarium", hint="python -m fullswarm.robotarium script.py")
    import fullswarm.robotarium.as_rps  # noqa: F401

    del sys.argv[0]
    sys.path.insert(0, str(Path(sys.argv[0]).resolve().parent))  # as Python does for a script
    return 0


if __name__ == "__main__":
    if code := run_guarded(_prepare):
        sys.exit(code)
    # An error of the script shows the script's own lines.
    runpy.run_path(sys.argv[0], run_name="__main__")
