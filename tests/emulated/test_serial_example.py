"""The serial driver that `docs/how-to-add-a-driver.md` shows, as it stands there, by the published check."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

from fullswarm.clock import MonotonicClock
from fullswarm.drivers.base import Twist
from fullswarm.emulators.create_oi.pty_port import PtyPort
from fullswarm.simulation.bodies import FreeBody
from fullswarm.testing import Rig, check_driver

DOCUMENT = Path(__file__).parents[2] / "docs" / "how-to-add-a-driver.md"
PERIOD_S, WATCHDOG_S = 0.02, 0.5


class LineRobot:
    """A robot on a pseudo-terminal: takes ``v LINEAR ANGULAR``, tells ``o X Y HEADING LINEAR ANGULAR`` at 50 Hz."""

    def __init__(self) -> None:
        self.body = FreeBody()
        self.muted = False
        self._clock, self._port, self._lock = MonotonicClock(), PtyPort(), threading.Lock()
        self._heard, self._told_s = b"", 0.0
        self._stopping = threading.Event()
        self.replug()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        return f"line://{self._port.path}"

    def speed(self) -> Twist:
        now = self.body.state()
        return Twist(now.speed_m_s, now.turn_rad_s)

    def unplug(self) -> None:
        with self._lock:
            self._port.pull()

    def replug(self) -> None:
        with self._lock:
            self._port.plug()

    def mute(self, on: bool) -> None:
        self.muted = on

    def garbage(self, data: bytes) -> None:
        with self._lock:
            self._port.say(data)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()
        self._port.close()

    def _run(self) -> None:
        while not self._stopping.wait(PERIOD_S):
            with self._lock:
                *lines, self._heard = (self._heard + self._port.hear()).split(b"\n")
                for line in lines:
                    self._obey(line)
                if self._clock.now_s() - self._told_s > WATCHDOG_S:
                    self.body.drive(0.0, 0.0)
                if not self.muted:
                    now = self.body.state()
                    numbers = (now.x_m, now.y_m, now.heading_rad, now.speed_m_s, now.turn_rad_s)
                    self._port.say(("o " + " ".join(f"{each:.6f}" for each in numbers) + "\n").encode())

    def _obey(self, line: bytes) -> None:
        found = re.fullmatch(rb"v (-?[0-9.]+) (-?[0-9.]+)", line)
        if found:
            self.body.drive(float(found[1]), float(found[2]))
            self._told_s = self._clock.now_s()


@pytest.fixture
def robot() -> Iterator[LineRobot]:
    robot = LineRobot()
    yield robot
    robot.close()


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
