"""The machine's clock, as a computer sees it that was suspended."""

from __future__ import annotations

import shutil
import subprocess
import sys

import pytest

ASLEEP_S = 100_000
UNSHARE = ("unshare", "--time", "--boottime", str(ASLEEP_S), "--fork")


def _can_pretend() -> bool:
    return (
        shutil.which("unshare") is not None and subprocess.run([*UNSHARE, "true"], capture_output=True).returncode == 0
    )


@pytest.mark.skipif(not _can_pretend(), reason="needs root, and a kernel with time namespaces")
def test_the_time_for_which_the_computer_was_suspended_counts() -> None:
    code = "import time; from fullswarm.clock import MonotonicClock; print(MonotonicClock().now_s() - time.monotonic())"
    done = subprocess.run([*UNSHARE, sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert float(done.stdout) == pytest.approx(ASLEEP_S, abs=60.0)
