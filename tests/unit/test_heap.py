"""Memory that a process has freed is returned to the system, and what it was built from is not collected again."""

from __future__ import annotations

import ctypes
import gc
import platform
import subprocess
import sys

import pytest

BURST = """
import gc
from pathlib import Path
from fullswarm.clock import SimClock
from fullswarm.heap import RETURN_S, settle
from fullswarm.runtime import Runtime

def resident_mb():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024.0 for line in lines if line.startswith("VmRSS"))

runtime = Runtime(SimClock())
settle(runtime)
before = resident_mb()
messages = [bytes([1]) * 20_000 for _ in range(3000)]
last = messages[-1]
del messages
kept = resident_mb()
runtime.run(RETURN_S - 1.0)
early = resident_mb()
runtime.run(2.0)
print(before, kept, early, resident_mb(), gc.get_freeze_count())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library returns memory in its own way")
def test_memory_of_a_burst_is_returned_although_its_last_block_is_in_use() -> None:
    done = subprocess.run([sys.executable, "-c", BURST], capture_output=True, text=True, check=True, timeout=60)
    before, kept, early, later, frozen = map(float, done.stdout.split())
    assert min(kept, early) > before + 40.0
    assert later < before + 10.0
    assert frozen > 1000


def test_a_system_without_that_call_is_served_as_well(monkeypatch: pytest.MonkeyPatch) -> None:
    from fullswarm import heap
    from fullswarm.clock import SimClock
    from fullswarm.runtime import Runtime

    monkeypatch.setattr(ctypes, "CDLL", lambda _: object())
    monkeypatch.setattr(gc, "freeze", lambda: None)  # of the tests' own process
    runtime = Runtime(SimClock())
    heap.settle(runtime)
    runtime.run(2 * heap.RETURN_S)
