"""A small run of the chaos benchmark: real processes are killed, paused and cut off while operators ask."""

from __future__ import annotations

import subprocess
import sys

import pytest

pytestmark = pytest.mark.slow


def test_under_faults_what_is_asked_happens_once_and_in_order_and_nothing_else_does() -> None:
    command = [sys.executable, "-m", "benchmarks.chaos", "--robots", "4", "--seconds", "45", "--every", "3"]
    result = subprocess.run(command, capture_output=True, text=True, timeout=240.0, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
