"""The Create's session against its firmware, in simulated time over a perfect wire; no port, no thread."""

from __future__ import annotations

from collections.abc import Callable

from fullswarm.clock import SimClock
from fullswarm.drivers.base import Lifecycle, Reading, Twist
from fullswarm.drivers.create_oi import protocol
from fullswarm.drivers.create_oi.protocol import CREATE2, Generation, Mode
from fullswarm.drivers.create_oi.session import Session
from fullswarm.drivers.create_oi.settings import Settings
from fullswarm.drivers.linked import CommandGate
from fullswarm.emulators.create_oi.firmware import Firmware, Quirks
from fullswarm.simulation.bodies import BodyState, FreeBody

GO = Twist(0.3, 0.5)


class Bench:
    """A session and a firmware that talk over a perfect wire, 5 ms by 5 ms."""

    def __init__(
        self,
        generation: Generation = CREATE2,
        *,
        quirks: Quirks | None = None,
        encoders: tuple[int, int] = (0, 0),
        mode_offset: int = 0,
        baud: int | None = None,
        brc: bool = False,
        speed_step_mm_s: float = 0.0,
    ) -> None:
        self.clock = SimClock()
        self.body = FreeBody(clock=self.clock)
        self.robot = Firmware(generation, self.body, quirks=quirks, encoders=encoders)
        settings = Settings("bench", generation, baud or generation.baud, mode_offset, speed_step_mm_s)
        self.pulses: list[bool] = []
        self.session = Session(settings, brc=self.brc if brc else None)
        self.ear = protocol.CommandParser(generation)
        self.wire = bytearray()
        self.carry: Callable[[bytes], None] = self.wire.extend  # puts what the session sends on the wire
        self.sent = bytearray()
        self.cut = False  # the robot is not heard
        self.pulled = False  # nor does it hear: the cable is out
        self.gate = CommandGate(self.session)
        self.session.linked(0.0)

    def brc(self, low: bool) -> None:
        self.pulses.append(low)
        if low:
            self.robot.brc(self.clock.now_s())

    @property
    def wheels(self) -> tuple[float, float]:
        """Left and right wheel as the body moves, m/s."""
        state, half = self.body.state(), self.robot.generation.wheel_base_m / 2.0
        left, right = state.speed_m_s - half * state.turn_rad_s, state.speed_m_s + half * state.turn_rad_s
        return round(left, 9), round(right, 9)

    def run(self, duration_s: float, twist: Twist | None = None, step_s: float = 0.005) -> None:
        for _ in range(round(duration_s / step_s)):
            self.clock.advance_to(self.clock.now_s() + step_s)
            now_s = self.clock.now_s()
            if twist is not None:
                self.gate.command(twist, now_s)
            self._flush()
            told = bytes(self.wire)
            self.wire.clear()
            self.sent += told
            said = self.robot.receive(b"" if self.pulled else told, now_s) + self.robot.step(now_s)
            if said and not (self.cut or self.pulled):
                self.session.received(said, now_s)
            self.gate.check(now_s)
            for chunk in self.session.tick(now_s):
                self.carry(chunk)

    def _flush(self) -> None:
        """Put on the wire what the agent's calls have queued, without doing what is due."""
        queued, self.session._out = self.session._out, []
        for chunk in queued:
            self.carry(chunk)

    def dock(self) -> None:
        now_s = self.clock.now_s()
        self.gate.command(Twist(), now_s)
        self.session.dock(now_s)
        self._flush()

    def trouble(self) -> str:
        return self.session.trouble(self.clock.now_s()).text

    def activate(self) -> None:
        self.session.activate(self.clock.now_s())
        self.run(0.1)

    def active(self) -> Bench:
        self.run(0.2)
        self.activate()
        assert self.at(Lifecycle.ACTIVE)
        return self

    def at(self, state: Lifecycle) -> bool:
        return self.session.state is state

    def robot_in(self, mode: Mode) -> bool:
        return self.robot.mode is mode

    @property
    def reading(self) -> Reading:
        assert self.session.reading is not None
        return self.session.reading


class Held:
    """A body that somebody holds."""

    def drive(self, speed_m_s: float, turn_rad_s: float) -> None:
        pass

    def state(self) -> BodyState:
        return BodyState()
