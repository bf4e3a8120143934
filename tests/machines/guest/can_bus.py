"""A CAN bus of the kernel's (vcan) with an emulated base on it, driven by the CAN driver; the bus goes down once."""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable
from typing import Any

from fullswarm import registry
from fullswarm.drivers.base import Lifecycle, Twist
from fullswarm.emulators.can.emulator import EmulatedBase
from tests.machines.guest.waiting import Command, until

BODY = "left=1&right=2&right_sign=-1&wheel_radius=0.05&base=0.3"
URLS = {
    "odrive": f"can+odrive://vcan0?{BODY}&watchdog=0.5",
    "vesc": f"can+vesc://vcan0?{BODY}&gear=10&pole_pairs=7",
}
FORWARD = Twist(0.3, 0.0)


def facts() -> dict[str, Any]:
    """Return how each make of controller was driven."""
    ip("link", "add", "vcan0", "type", "vcan")
    ip("link", "set", "vcan0", "up")
    with Command("emulate", "odrive", "--url", URLS["odrive"], "--json") as emulator:
        emulator.says(lambda line: '"url"' in line, "an emulated base on vcan0")
        by_command = _drive(URLS["odrive"], lambda: emulator.says(lambda line: "+0.30 m/s" in line, "its wheels turn"))
    with EmulatedBase(URLS["vesc"]) as base:
        return {"odrive": by_command, "vesc": _drive(URLS["vesc"], lambda: f"{base.body.state().speed_m_s:+.2f} m/s")}


def _drive(url: str, moved: Callable[[], str]) -> dict[str, Any]:
    """Drive the base at `url`; then the bus goes down, and comes back with the base switched on again."""
    driver = registry.driver_class(url)(url)
    driver.open()
    try:
        ready_s = until(lambda: driver.state is Lifecycle.READY, "READY")
        driver.activate()
        until(lambda: driver.state is Lifecycle.ACTIVE, "ACTIVE")
        rolled_m = _forward(driver, 0.3)
        told = moved()
        ip("link", "set", "vcan0", "down")
        until(lambda: driver.state is Lifecycle.FAULT, "a fault when the bus is down")
        fault = driver.fault
        ip("link", "set", "vcan0", "up")
        with EmulatedBase(url):
            back_s = until(lambda: driver.state is Lifecycle.READY, "READY again when the bus is back")
    finally:
        driver.close()
    return {"ready_s": ready_s, "rolled_m": rolled_m, "moved": told, "fault": fault, "back_s": back_s}


def _forward(driver: Any, far_m: float) -> float:
    """Drive so far; return the odometry."""

    def there() -> bool:
        driver.command(FORWARD)
        time.sleep(0.01)
        reading = driver.read()
        return reading is not None and reading.odometry.x_m > far_m

    until(there, f"{far_m} m of odometry")
    return float(driver.read().odometry.x_m)


def ip(*arguments: str) -> None:
    """Run iproute2."""
    subprocess.run(["ip", *arguments], check=True)
