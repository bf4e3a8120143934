"""A Create on a USB cable: the kernel's USB host and a serial gadget in one, our emulator behind the gadget.

The driver opens the name that our udev rule gives the port; the cable is pulled and put back once.
"""

from __future__ import annotations

import contextlib
import os
import select
import termios
import threading
import tty
from pathlib import Path
from typing import Any, Self

from fullswarm import registry
from fullswarm.drivers.base import STAND, Lifecycle, Twist
from fullswarm.emulators.create_oi.emulator import CreateEmulator
from tests.machines.guest.waiting import until

NAMES, ROBOT_SIDE = Path("/dev/fullswarm"), Path("/dev/ttyGS0")


def facts() -> dict[str, Any]:
    """Return how the robot was driven over its cable."""
    until(ROBOT_SIDE.exists, "the gadget's own end")
    port = _named_port()
    mode = port.stat().st_mode & 0o777
    with CreateEmulator() as robot, _Bridge(robot.port, ROBOT_SIDE):
        url = f"create://{port}?guardian=1"
        driver = registry.driver_class(url)(url)
        driver.open()
        try:
            ready_s = until(lambda: driver.state is Lifecycle.READY, "READY")
            driver.activate()
            until(lambda: driver.state is Lifecycle.ACTIVE, "ACTIVE")
            until(lambda: driver.command(Twist(0.2, 0.0)) != STAND and robot.body.state().x_m > 0.2, "20 cm forward")
            speed_m_s, odometry_m = robot.body.state().speed_m_s, driver.read().odometry.x_m
            target = port.resolve()
            cable = (Path("/sys/class/tty") / target.name / "device").resolve().parent / "authorized"
            cable.write_text("0")  # the kernel lets go of the device, as if it were pulled out
            until(lambda: driver.state is Lifecycle.FAULT, "a fault when the cable is pulled")
            fault = driver.fault
            cable.write_text("1")
            back_s = until(lambda: driver.state is Lifecycle.READY, "READY again when the cable is back")
            until(lambda: robot.body.state().speed_m_s == 0.0, "the first words after that stop the robot")
        finally:
            driver.close()
    return {
        "port": str(port), "target": str(target), "mode": oct(mode), "ready_s": ready_s,
        "speed_m_s": speed_m_s, "odometry_m": odometry_m, "fault": fault, "back_s": back_s,
    }  # fmt: skip


def _named_port() -> Path:
    until(lambda: any(NAMES.glob("*")), "our udev rule names the port")
    return next(NAMES.glob("*"))


class _Bridge:
    """Carries bytes between the emulator's port and the gadget's end of the cable; a context manager."""

    def __init__(self, robot: str, gadget: Path) -> None:
        self._robot, self._gadget_path = _opened(robot), str(gadget)
        self._gadget = _opened(self._gadget_path)
        settings = termios.tcgetattr(self._robot)
        settings[4] = settings[5] = termios.B115200  # the emulator hears noise at another rate than the Create's
        termios.tcsetattr(self._robot, termios.TCSANOW, settings)
        self._wake_r, self._wake_w = os.pipe()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        os.write(self._wake_w, b"\0")
        self._thread.join()
        for each in (self._robot, self._gadget, self._wake_r, self._wake_w):
            os.close(each)

    def _run(self) -> None:
        while True:
            ready, _, _ = select.select([self._robot, self._gadget, self._wake_r], [], [])
            if self._wake_r in ready:
                return
            if self._robot in ready:
                said = os.read(self._robot, 4096)
                with contextlib.suppress(OSError):  # a cable that is pulled loses bytes
                    os.write(self._gadget, said)
            if self._gadget in ready:
                os.write(self._robot, self._told())

    def _told(self) -> bytes:
        """Return what the driver has said; the kernel hangs up this end when the cable is pulled."""
        with contextlib.suppress(OSError):
            if told := os.read(self._gadget, 4096):
                return told
        os.close(self._gadget)
        self._gadget = _opened(self._gadget_path)
        return b""


def _opened(path: str) -> int:
    """Open a port for bytes as they are."""
    end = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    tty.setraw(end)
    return end
