"""Drives a robot straight on until it is killed: ``python -m fullswarm.testing.drives_on module:Class URL SPEED``.

When its clock shows a gap (it was paused) it sends nothing more: the driver has to detect that by itself.
"""

from __future__ import annotations

import importlib
import math
import signal
import sys
import threading
from typing import Any

from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import Driver, Lifecycle, Twist

PERIOD_S, GAP_S, AGAIN_S = 0.02, 0.5, 1.0


def main(target: str, url: str, speed_m_s: float) -> None:
    """Open, activate, command at 50 Hz; close at SIGTERM."""
    module, _, name = target.partition(":")
    kind: Any = importlib.import_module(module)
    for each in name.split("."):
        kind = getattr(kind, each)
    driver: Driver = kind(url)
    ended = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: ended.set())
    try:
        driver.open()
        _drive(driver, Twist(speed_m_s, 0.0), ended)
    finally:
        driver.close()


def _drive(driver: Driver, twist: Twist, ended: threading.Event) -> None:
    clock, drove = MonotonicClock(), False
    last_s, asked_s = clock.now_s(), -math.inf
    while not ended.wait(PERIOD_S):
        now_s = clock.now_s()
        if drove and now_s - last_s > GAP_S:
            ended.wait()
            return
        last_s = now_s
        drove = drove or driver.state is Lifecycle.ACTIVE
        if driver.state is Lifecycle.READY and now_s - asked_s > AGAIN_S:
            asked_s = now_s
            driver.activate()
        driver.command(twist)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2], float(sys.argv[3]))
