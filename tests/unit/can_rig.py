"""A machine and two emulated controllers in simulated time: no bus, no thread, no waiting."""

from __future__ import annotations

from collections.abc import Callable

from fullswarm.clock import SimClock
from fullswarm.drivers.base import STAND, Hazard, Lifecycle, Reading, Twist
from fullswarm.drivers.can.odrive import AxisState
from fullswarm.drivers.can.protocol import Frame
from fullswarm.drivers.can.session import Session
from fullswarm.drivers.can.settings import Settings, parse
from fullswarm.drivers.linked import CommandGate
from fullswarm.emulators.can.firmware import Base
from fullswarm.emulators.can.odrive import ODriveEmulator
from fullswarm.simulation.bodies import FreeBody, wheels_rolled

BASE_M, LIMIT_M_S = 0.3, 0.5
TICK_S = 0.005
URL = "can+{}://rig?interface=virtual&left=1&right=2&right_sign=-1&wheel_radius=0.05&base=0.3&gear=10"
OPTIONS = {"odrive": "vel_limit=50", "vesc": "pole_pairs=7"}


class Wire(list[Frame]):
    """A bus with one listener."""

    def send(self, frame: Frame) -> None:
        self.append(frame)


class Rig:
    """5 ms at a time; the controllers step every 10 ms, commands come every 20 ms."""

    def __init__(self, make: str = "odrive", *more: str, statuses: frozenset[int] | None = None) -> None:
        self.settings = parse("&".join((URL.format(make), OPTIONS[make], *more)))
        self.clock = SimClock(100.0)
        self.body = FreeBody(clock=self.clock)
        self.wire = Wire()
        self.base = Base(self.settings, self.body, self.wire)
        self.wheels = self.base.wheels
        for wheel in self.wheels:
            if not isinstance(wheel, ODriveEmulator) and statuses is not None:
                wheel.statuses = statuses
        self.open(self.settings)
        self.sent: list[tuple[float, Frame]] = []
        self.link = True
        self.unheard: set[int] = set()  # sides of wheels whose frames do not arrive
        self.twist: Twist | None = None
        self.applied = STAND
        self._step = 0

    def open(self, settings: Settings) -> None:
        """Begin a session: the driver was opened."""
        self.session = Session(settings.codecs(), BASE_M, LIMIT_M_S, settings.base.volts, self.now)
        self.gate = CommandGate(self.session)
        self.session.linked(self.now)

    @property
    def now(self) -> float:
        return self.clock.now_s()

    @property
    def odrives(self) -> list[ODriveEmulator]:
        return [wheel for wheel in self.wheels if isinstance(wheel, ODriveEmulator)]

    @property
    def reading(self) -> Reading:
        assert self.session.reading is not None
        return self.session.reading

    def state(self) -> Lifecycle:
        return self.session.state

    def hazards(self) -> Hazard:
        return self.reading.hazards

    def rolled(self) -> tuple[float, float]:
        return wheels_rolled(self.body.state(), BASE_M)

    def step(self) -> None:
        self._step += 1
        self.clock.advance_to(100.0 + self._step * TICK_S)
        if self._step % 2 == 0:
            self.base.step(self.now)
        if not self.link:
            self.wire.clear()
            return
        lost = [self.session.axes[side].codec for side in self.unheard]
        for frame in self.wire:
            if all(codec.decode(frame) is None for codec in lost):
                self.session.received(frame, self.now)
        self.wire.clear()
        if self.twist is not None and self._step % 4 == 0:
            self.applied = self.gate.command(self.twist, self.now)
        self.gate.check(self.now)
        if self._step % 4 == 0 or self.session.urgent:
            for frame in self.session.tick(self.now):
                self.sent.append((self.now, frame))
                self.base.receive(frame, self.now)

    def run(self, duration_s: float) -> None:
        for _ in range(round(duration_s / TICK_S)):
            self.step()

    def until(self, condition: Callable[[], bool], limit_s: float) -> float:
        """Run until `condition`; return how long it took."""
        start_s = self.now
        while not condition():
            assert self.now - start_s <= limit_s, f"{self.session.state} {self.session.fault}"
            self.step()
        return self.now - start_s

    def until_state(self, state: Lifecycle, limit_s: float) -> float:
        return self.until(lambda: self.session.state is state, limit_s)

    def active(self, twist: Twist | None = None) -> None:
        """Bring the robot to ACTIVE and let it drive."""
        self.until_state(Lifecycle.READY, 2.0)
        self.session.activate(self.now)
        self.until_state(Lifecycle.ACTIVE, 0.6)
        self.twist = twist
        if twist is not None:
            self.run(0.5)

    def speeds(self) -> list[float]:
        return [wheel.spin.speed_m_s for wheel in self.wheels]

    def idle(self) -> bool:
        return all(each.state is AxisState.IDLE for each in self.odrives)
