"""The driver's session with an emulated vehicle, in memory and in simulated time."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterable
from typing import Any, ClassVar

from fullswarm.clock import SimClock
from fullswarm.drivers.base import Lifecycle, Limits, Pose, Twist
from fullswarm.drivers.guardian import StopPlan
from fullswarm.drivers.linked import CommandGate
from fullswarm.drivers.mavlink import px4
from fullswarm.drivers.mavlink.codec import StreamParser, decode, decoded_ids
from fullswarm.drivers.mavlink.protocol import Mode, StatusText
from fullswarm.drivers.mavlink.session import Session
from fullswarm.drivers.mavlink.settings import Options
from fullswarm.emulators.mavlink.firmware import Firmware
from fullswarm.emulators.mavlink.px4_firmware import Px4Firmware
from fullswarm.simulation.bodies import FreeBody

STEP_S = 0.01
LIMITS = Limits(1.0, 2.0, 1.0, 2.0)


class Bench:
    """A session on a wire that may be cut."""

    READY_S: ClassVar[float]
    HOLD: ClassVar[int]
    DRIVEN: ClassVar[int]
    rover: Firmware | Px4Firmware

    def __init__(self, clock: SimClock, body: FreeBody, session: Session) -> None:
        self.clock, self.body, self.session = clock, body, session
        self.gate = CommandGate(session)
        self.texts: list[str] = []
        self.cut = False

    @property
    def now_s(self) -> float:
        return self.clock.now_s()

    def step(self) -> None:
        raise NotImplementedError

    def pilot(self, mode: int) -> None:
        """Change the mode as a pilot does by remote control."""
        raise NotImplementedError

    @property
    def setpoint_m_s(self) -> float:
        """The speed that the newest set-point asks for."""
        raise NotImplementedError

    def hear(self, messages: Iterable[Any]) -> None:
        for message in messages:
            received = decode(message)
            if received is not None and isinstance(received.body, StatusText):
                self.texts.append(received.body.text)
            self.session.receive(message, self.now_s)

    def run(self, duration_s: float, each: Callable[[], object] | None = None) -> None:
        for _ in range(round(duration_s / STEP_S)):
            if each is not None:
                each()
            self.step()

    def until(
        self, condition: Callable[[], bool], timeout_s: float = 10.0, each: Callable[[], object] | None = None
    ) -> None:
        end_s = self.now_s + timeout_s
        while not condition():
            assert self.now_s < end_s, f"waited in vain: {self.session.state} {self.session.fault}"
            self.run(STEP_S, each)

    def drive(self, speed_m_s: float = 0.5, turn_rad_s: float = 0.0) -> Twist:
        return self.gate.command(Twist(speed_m_s, turn_rad_s), self.now_s)

    def plan(self) -> StopPlan[bytes]:
        plan = self.session.stop_plan(self.now_s)
        assert plan is not None
        return plan

    def insist(self) -> None:
        """Do what an agent does whose behaviour is on."""
        self.session.activate(self.now_s)
        self.drive()

    def ready(self) -> None:
        self.until(lambda: self.session.state is Lifecycle.READY, self.READY_S)

    def active(self) -> None:
        self.ready()
        self.session.activate(self.now_s)
        self.until(lambda: self.session.state is Lifecycle.ACTIVE)


class ArduBench(Bench):
    """With ArduPilot, over a wire that may lose frames."""

    READY_S = 60.0
    HOLD, DRIVEN = Mode.HOLD, Mode.GUIDED
    rover: Firmware

    def __init__(self, boot_s: float = 0.2, loss: float = 0.0, loop_hz: float = 50.0) -> None:
        clock = SimClock(100.0)
        body = FreeBody(clock=clock)
        self.rover = Firmware(body, boot_s=boot_s, loop_hz=loop_hz)
        self.rover.power_on(100.0)
        super().__init__(clock, body, Session(Options(1, LIMITS, "bench"), 100.0))
        self._loss, self._random = loss, random.Random(1)
        self._down, self._up = StreamParser(), StreamParser()

    def step(self) -> None:
        self.clock.advance_to(self.now_s + STEP_S)
        for frame in self.rover.tick(self.now_s):
            self.hear(self._pass(frame, self._down))
        self.gate.check(self.now_s)
        for frame in self.session.tick(self.now_s):
            for message in self._pass(frame, self._up):
                self.rover.receive(message, self.now_s)

    def pilot(self, mode: int) -> None:
        self.rover.pilot_mode(mode)

    @property
    def setpoint_m_s(self) -> float:
        return self.rover.setpoints[-1].speed_m_s

    def _pass(self, frame: bytes, parser: StreamParser) -> list[object]:
        if self.cut or self._random.random() < self._loss:
            return []
        return parser.feed(frame)


class Px4Bench(Bench):
    """With PX4, which may be deaf."""

    READY_S = 10.0
    HOLD, DRIVEN = px4.HOLD, px4.OFFBOARD
    rover: Px4Firmware

    def __init__(self, **options: Any) -> None:
        clock = SimClock(100.0)
        body = FreeBody(Pose(0.0, 0.0, 0.7), clock)
        self.rover = Px4Firmware(body)
        self.rover.power_on(100.0)
        super().__init__(clock, body, Session(Options(1, LIMITS, "bench", **options), 100.0))
        self.deaf = False
        self._down, self._up = StreamParser(decoded_ids()), StreamParser()

    def step(self) -> None:
        self.clock.advance_to(self.now_s + STEP_S)
        for frame in self.rover.tick(self.now_s):
            self.hear([] if self.cut else self._down.feed(frame))
        self.gate.check(self.now_s)
        for frame in self.session.tick(self.now_s):
            for message in [] if self.cut or self.deaf else self._up.feed(frame):
                self.rover.receive(message, self.now_s)

    def pilot(self, mode: int) -> None:
        self.rover.pilot_mode(mode)

    @property
    def setpoint_m_s(self) -> float:
        return self.rover.setpoints[-1].forward_m_s
