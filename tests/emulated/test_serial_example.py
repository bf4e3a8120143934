"""The serial driver that `docs/how-to-add-a-driver.md` shows, as it stands there, by the published check."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import Twist
from fullswarm.emulators.base import Emulator
from fullswarm.emulators.ports import PtyPort
from fullswarm.simulation.bodies import FreeBody
from fullswarm.testing import Rig, check_driver

DOCUMENT = Path(__file__).parents[2] / "docs" / "how-to-add-a-driver.md"
PERIOD_S, WATCHDOG_S = 0.02, 0.5


class LineFirmware:
    """Takes ``v LINEAR ANGULAR``, sends ``o X Y HEADING LINEAR ANGULAR`` at 50 Hz."""

    def __init__(self, body: FreeBody) -> None:
        self.next_due_s = 0.0
        self._body, self._rest, self._set_s = body, b"", 0.0
        self._out: list[bytes] = []

    def receive(self, data: bytes, now_s: float, _port: int) -> None:
        *lines, self._rest = (self._rest + data).split(b"\n")
        for line in lines:
            found = re.fullmatch(rb"v (-?[0-9.]+) (-?[0-9.]+)", line)
            if found:
                self._body.drive(float(found[1]), float(found[2]))
                self._set_s = now_s

    def step(self, now_s: float) -> bool:
        if now_s >= self.next_due_s:
            self.next_due_s = now_s + PERIOD_S
            if now_s - self._set_s > WATCHDOG_S:
                self._body.drive(0.0, 0.0)
            now = self._body.state()
            numbers = (now.x_m, now.y_m, now.heading_rad, now.speed_m_s, now.turn_rad_s)
            self._out.append(("o " + " ".join(f"{each:.6f}" for each in numbers) + "\n").encode())
        return False

    def take(self, _port: int) -> list[bytes]:
        out, self._out = self._out, []
        return out

    def hung_up(self, _port: int) -> None:
        self._rest = b""


class LineRobot(Emulator):
    """A robot on a pseudo terminal."""

    body: FreeBody

    def __init__(self) -> None:
        body, port = FreeBody(), PtyPort()
        super().__init__(LineFirmware(body), [port], body, MonotonicClock())
        self.url = f"line://{port.address}"

    @property
    def motors_on(self) -> bool:
        return True

    def speed(self) -> Twist:
        now = self.body.state()
        return Twist(now.speed_m_s, now.turn_rad_s)


@pytest.fixture
def robot() -> Iterator[LineRobot]:
    with LineRobot() as robot:
        yield robot


@pytest.fixture
def example() -> ModuleType:
    """Return the document's code as a module."""
    blocks = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(encoding="utf-8"), re.DOTALL)
    (code,) = [block for block in blocks if "class LineDriver" in block]
    module = ModuleType("line_driver")
    exec(compile(code, str(DOCUMENT), "exec"), vars(module))
    return module


def test_the_serial_driver_of_the_document_passes_the_published_check(robot: LineRobot, example: ModuleType) -> None:
    report = check_driver(
        Rig(
            make=lambda: example.LineDriver(robot.url),
            make_on=lambda clock: example.LineDriver(robot.url, clock),
            body_speed=robot.speed,
            unplug=robot.unplug,
            replug=robot.replug,
            mute=robot.mute,
            garbage=robot.garbage,
            fault_s=0.8,
        )
    )
    assert "unplugged" in str(report)
