"""The tests of the package of example behaviours, run as its author runs them: in its folder, not installed."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from fullswarm.registry import DEVELOP

FOLDER = Path(__file__).parents[2] / "examples" / "behaviours"


def test_the_examples_pass_their_own_tests() -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "tests"]
    done = subprocess.run(
        command, cwd=FOLDER, env=os.environ | {DEVELOP: str(FOLDER)}, capture_output=True, text=True, timeout=300.0
    )
    assert done.returncode == 0, done.stdout
