"""Raw messages to the emulated firmware on a simulated clock, without our driver: what any client would see."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import Any

from fullswarm.clock import SimClock
from fullswarm.drivers.mavlink.codec import StreamParser, dialect
from fullswarm.drivers.mavlink.protocol import Mode
from fullswarm.emulators.mavlink.firmware import LOOP_S, Firmware
from fullswarm.simulation.bodies import BodyState, FreeBody

STATION, COMPANION, STRANGER = (255, 190), (1, 191), (42, 1)
VELOCITY_TURN, BODY_NED = 0x5C7, 8


class Wire:
    """A rover that has booted, and what it has said on each of its ports."""

    def __init__(self, boot_s: float = 0.05, ports: int = 2, settle_s: float = 0.5, **options: Any) -> None:
        self.clock = SimClock(100.0)
        self.body = FreeBody(clock=self.clock)
        self.rover = Firmware(self.body, boot_s=boot_s, ports=ports, **options)
        self.ports = ports
        self.heard: list[tuple[float, int, Any]] = []  # when, on which port, what
        self.frames: list[tuple[int, bytes]] = []
        self._sources: dict[tuple[int, int], Any] = {}
        self._up, self._down = StreamParser(), [StreamParser() for _ in range(ports)]
        self.began_s = self.now_s
        self.rover.power_on(self.now_s)
        self.run(settle_s)

    @property
    def now_s(self) -> float:
        return self.clock.now_s()

    # ------------------------------------------------------------ time
    def step(self) -> None:
        self.clock.advance_to(self.now_s + LOOP_S)
        self._hear(self.rover.tick(self.now_s))

    def _hear(self, first: list[bytes]) -> None:
        for port in range(self.ports):
            for frame in first if port == 0 else self.rover.channels[port].take():
                self.frames.append((port, frame))
                self.heard += [(self.now_s, port, message) for message in self._down[port].feed(frame)]

    def run(self, duration_s: float, each: Callable[[], object] | None = None, every_s: float = 0.1) -> None:
        """Go on, calling `each` at a rate."""
        end_s, due_s = self.now_s + duration_s - 1e-9, self.now_s
        while self.now_s < end_s:
            if each is not None and self.now_s >= due_s - 1e-9:
                due_s += every_s
                each()
            self.step()

    def until(self, condition: Callable[[], bool], timeout_s: float = 20.0) -> float:
        """Go on until something holds; return how long that took."""
        start_s = self.now_s
        while not condition():
            assert self.now_s < start_s + timeout_s, "waited in vain"
            self.step()
        return self.now_s - start_s

    # ------------------------------------------------------------ to the rover
    def pack(self, message: Any, source: tuple[int, int] = STATION) -> bytes:
        sender = self._sources.setdefault(source, dialect().MAVLink(None, *source))
        frame: bytes = message.pack(sender)
        sender.seq = (sender.seq + 1) % 256
        return frame

    def feed(self, frame: bytes, port: int = 0) -> None:
        for message in self._up.feed(frame):
            self.rover.receive(message, self.now_s, port)

    def send(self, name: str, *values: Any, source: tuple[int, int] = STATION, port: int = 0) -> None:
        message = getattr(dialect(), f"MAVLink_{name.lower()}_message")(*values)
        self.feed(self.pack(message, source), port)

    def command(
        self, command: int, *values: float, target: tuple[int, int] = (1, 1), source: tuple[int, int] = STATION,
        port: int = 0,
    ) -> int | None:  # fmt: skip
        """Send COMMAND_LONG; return the result, None: silence."""
        return self._ack(command, port, "COMMAND_LONG", *target, command, 0, *_padded(values, 7), source=source)

    def command_int(self, command: int, *values: float, latitude: int = 0, longitude: int = 0) -> int | None:
        four = _padded(values, 4)
        return self._ack(command, 0, "COMMAND_INT", 1, 1, 6, command, 0, 0, *four, latitude, longitude, 0.0)

    def _ack(self, command: int, port: int, name: str, *values: Any, source: tuple[int, int] = STATION) -> int | None:
        before = len(self.heard)
        self.send(name, *values, source=source, port=port)
        self.run(2 * LOOP_S)
        acks = [(at, m) for _, at, m in self.heard[before:] if m.get_type() == "COMMAND_ACK"]
        assert all(at == port and m.command == command for at, m in acks)
        assert all((m.target_system, m.target_component) == source for _, m in acks)
        return acks[0][1].result if acks else None

    def drive(
        self, vx: float = 0.0, yaw_rate: float = 0.0, *, vy: float = 0.0, vz: float = 0.0, mask: int = VELOCITY_TURN,
        frame: int = BODY_NED, yaw: float = 0.0, x: float = 0.0, y: float = 0.0, target: tuple[int, int] = (1, 1),
        source: tuple[int, int] = STATION, port: int = 0,
    ) -> None:  # fmt: skip
        """Send SET_POSITION_TARGET_LOCAL_NED (yaw rate clockwise positive)."""
        self.send(
            "SET_POSITION_TARGET_LOCAL_NED", 0, *target, frame, mask, x, y, 0.0, vx, vy, vz, 0.0, 0.0, 0.0, yaw,
            yaw_rate, source=source, port=port,
        )  # fmt: skip

    def guided(self) -> Wire:
        """Enter GUIDED and arm."""
        assert self.command(176, 1, Mode.GUIDED) == 0
        assert self.command(400, 1) == 0
        return self

    def moving(self, speed: float) -> Wire:
        """Drive until the speed has settled."""
        self.guided().run(2.0 + 1.5 * speed, lambda: self.drive(speed))
        return self

    # ------------------------------------------------------------ what came of it
    @property
    def state(self) -> BodyState:
        return self.body.state()

    @property
    def texts(self) -> list[str]:
        return [m.text for _, port, m in self.heard if m.get_type() == "STATUSTEXT" and port == 0]

    def text_s(self, text: str) -> float:
        """Return when a text came."""
        return next(at_s for at_s, _, m in self.heard if m.get_type() == "STATUSTEXT" and m.text.startswith(text))

    def of(self, kind: str, port: int = 0) -> list[Any]:
        return [m for _, at, m in self.heard if at == port and m.get_type() == kind]

    def count(self, duration_s: float, port: int = 0) -> Counter[str]:
        """Go on and count what is sent."""
        before = len(self.heard)
        self.run(duration_s)
        return Counter(m.get_type() for _, at, m in self.heard[before:] if at == port)

    def stopping(self, each: Callable[[], object] | None = None, limit_m_s: float = 0.05) -> tuple[float, float]:
        """Go on until the rover stands; return the time and the way that took."""
        start_s, rolled = self.now_s, self.state.rolled_m
        while abs(self.state.speed_m_s) >= limit_m_s:
            assert self.now_s < start_s + 15.0
            self.run(0.1 if each else LOOP_S, each)
        return self.now_s - start_s, self.state.rolled_m - rolled


def _padded(values: tuple[float, ...], count: int) -> list[float]:
    return [*map(float, values), *[0.0] * (count - len(values))]
