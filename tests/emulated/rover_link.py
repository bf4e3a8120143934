"""What tests of rovers behind real ports share: waiting, a free port, a driver that is ACTIVE."""

from __future__ import annotations

import socket
import threading

from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import Lifecycle
from fullswarm.drivers.mavlink.driver import MavlinkDriver
from fullswarm.earth import SITL_ORIGIN_DEG
from tests.waiting import until

CLOCK = MonotonicClock()
IN_THE_WORLD = f"origin={SITL_ORIGIN_DEG[0]},{SITL_ORIGIN_DEG[1]}"
"""Option of a driver that tells poses of the emulated world: the rover's own map begins where it was switched on."""
PAUSE = threading.Event()  # never set: waiting on it is a short pause


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


def ready(driver: MavlinkDriver) -> None:
    until(lambda: driver.state is Lifecycle.READY)


def active(driver: MavlinkDriver) -> None:
    ready(driver)
    driver.activate()
    until(lambda: driver.state is Lifecycle.ACTIVE)
