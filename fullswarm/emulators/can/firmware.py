"""Two emulated motor controllers and the body that both move, as chunks of a CAN bus or of a serial adapter's line."""

from __future__ import annotations

import struct
from collections import deque

from fullswarm.drivers.can.protocol import MAX_DATA, Frame, WheelCodec
from fullswarm.drivers.can.settings import OdriveOptions, Settings, VescOptions
from fullswarm.drivers.can.slcan import BELL, BITRATES, END, Lines, decode, encode
from fullswarm.emulators.can.odrive import ODriveEmulator
from fullswarm.emulators.can.vesc import VescEmulator
from fullswarm.emulators.can.wheel import STEP_S, Sender
from fullswarm.emulators.ports import Port
from fullswarm.simulation.bodies import Body, drive_wheels, wheels_rolled

VERSION, SERIAL_NUMBER = b"V1013", b"NA123"
"""Of the emulated adapter."""
_EXTENDED, _REMOTE = 1 << 31, 1 << 30  # as in linux/can.h


class Base:
    """Two controllers and their body.

    Parameters
    ----------
    settings
        What the driver's URL says; the controllers are configured accordingly.
    bus
        Where the frames of the controllers go.
    """

    def __init__(self, settings: Settings, body: Body, bus: Sender) -> None:
        self.body, self._base_m = body, settings.base.base
        left, right = (_controller(bus, codec, settings.drive) for codec in settings.codecs())
        self.left, self.right = left, right
        self.wheels = (left, right)

    def receive(self, frame: Frame, now_s: float) -> None:
        """Give both a frame."""
        for wheel in self.wheels:
            wheel.receive(frame, now_s)

    def step(self, now_s: float) -> None:
        """Go on to `now_s`: wheels, body, cyclic messages. Call at 100 Hz."""
        state = self.body.state()
        turning_m_s = state.turn_rad_s * self._base_m / 2.0
        speeds = (state.speed_m_s - turning_m_s, state.speed_m_s + turning_m_s)
        for wheel, rolled_m, speed_m_s in zip(self.wheels, wheels_rolled(state, self._base_m), speeds, strict=True):
            wheel.spin.measure(rolled_m, speed_m_s)
            wheel.step(now_s)
        drive_wheels(self.body, self.left.spin.speed_m_s, self.right.spin.speed_m_s, self._base_m)


def _controller(bus: Sender, codec: WheelCodec, drive: OdriveOptions | VescOptions) -> ODriveEmulator | VescEmulator:
    if isinstance(drive, VescOptions):
        return VescEmulator(bus, codec.node, codec.wheel, min_erpm=drive.min_erpm, timeout_s=drive.watchdog)
    return ODriveEmulator(
        bus, codec.node, codec.wheel,
        firmware=drive.firmware, limit_turn_s=drive.vel_limit, watchdog_s=drive.watchdog,
    )  # fmt: skip


def pack(frame: Frame) -> bytes:
    """Return `frame` as bytes of which each bit may flip."""
    return struct.pack(">I", frame.id | _EXTENDED * frame.extended | _REMOTE * frame.remote) + frame.data


def unpack(data: bytes) -> Frame | None:
    """Return the frame; None when the flipped bit leaves none."""
    (word,) = struct.unpack_from(">I", data)
    identifier, extended, remote = word & 0x1FFFFFFF, bool(word & _EXTENDED), bool(word & _REMOTE)
    if word >> 29 & 1 or (identifier > 0x7FF and not extended) or len(data) > 4 + MAX_DATA:
        return None
    return Frame(identifier, extended, b"" if remote else data[4:], remote)


class OnBus:
    """A base as chunks: one is a packed frame."""

    def __init__(self, settings: Settings, body: Body, port: Port) -> None:
        self.base = Base(settings, body, self)
        self._port = port
        self._waits = port.fileno() >= 0
        self._next_s = 0.0
        self._out: deque[bytes] = deque()

    @property
    def next_due_s(self) -> float:
        """When the wheels go on; at once for a bus without a descriptor to wait on."""
        return self._next_s if self._waits else 0.0

    def send(self, frame: Frame) -> None:
        """Put a controller's frame on the bus."""
        self._out.append(pack(frame))

    def receive(self, data: bytes, now_s: float, _port: int) -> None:
        """Give the controllers a frame."""
        frame = unpack(data)
        if frame is not None:
            self.base.receive(frame, now_s)

    def step(self, now_s: float) -> bool:
        """Turn the wheels at 100 Hz."""
        if now_s >= self._next_s:
            self._next_s = max(self._next_s + STEP_S, now_s)
            self.base.step(now_s)
        return False

    def take(self, _port: int) -> list[bytes]:
        """Return the frames that the controllers have sent."""
        out = list(self._out)
        self._out.clear()
        return out

    def hung_up(self, _port: int) -> None:
        """Do nothing: a bus has no other side."""


class Adapter:
    """An adapter's command interpreter, as delivered: closed, no bit rate, no time stamps.

    Parameters
    ----------
    bitrate
        Of the bus behind it: with another one it opens, and no frame passes either way.
    """

    def __init__(self, bitrate: int) -> None:
        self._bitrate = bitrate
        self._lines = Lines()
        self._chosen: int | None = None
        self.is_open = False
        self._listens_only = False
        self.refused = 0  # lines that were neither a command nor a frame

    def receive(self, data: bytes) -> tuple[bytes, list[Frame]]:
        """Run what a computer writes; return the answers and the frames for the bus."""
        answers, frames = b"", []
        for line in self._lines.feed(data):
            frame = decode(line)
            if frame is None:
                answer = self._command(line)
            elif self.is_open and not self._listens_only:
                frames += [frame] if self._chosen == self._bitrate else []
                answer = (b"Z" if frame.extended else b"z") + END
            else:
                answer = BELL
            self.refused += frame is None and answer == BELL
            answers += answer
        return answers, frames

    def deliver(self, frame: Frame) -> bytes:
        """Return the line for the computer of a frame on the bus; nothing while closed."""
        return encode(frame) if self.is_open and self._chosen == self._bitrate else b""

    def restart(self) -> None:
        """Start anew: power was cut, or the computer has closed the port."""
        self._lines = Lines()
        self.is_open = self._listens_only = False
        self._chosen = None

    def _command(self, line: bytes) -> bytes:
        match line[:1]:
            case b"C" if line == b"C":
                self.is_open = False
                return END
            case b"O" | b"L" if len(line) == 1 and self._chosen is not None:
                was_open, self.is_open, self._listens_only = self.is_open, True, line == b"L"
                return BELL if was_open else END
            case b"S" if line in BITRATES and not self.is_open:
                self._chosen = BITRATES[line]
                return END
            case b"Z" if line == b"Z0":
                return END
            case b"V" if line == b"V":
                return VERSION + END
            case b"N" if line == b"N":
                return SERIAL_NUMBER + END
            case b"F" if line == b"F" and self.is_open:
                return b"F00" + END
        return BELL


class OnAdapter(OnBus):
    """A base behind a serial adapter; a chunk is a line of its text."""

    def __init__(self, settings: Settings, body: Body, port: Port) -> None:
        super().__init__(settings, body, port)
        self._adapter, self._waits = Adapter(settings.bitrate), True

    def send(self, frame: Frame) -> None:
        """Put a controller's frame on the line, if the computer has opened the channel."""
        line = self._adapter.deliver(frame)
        if line:
            self._out.append(line)

    def receive(self, data: bytes, now_s: float, _port: int) -> None:
        """Obey a line; the adapter's own answers are not subject to faults."""
        answers, frames = self._adapter.receive(data)
        self._port.send(answers)
        for frame in frames:
            self.base.receive(frame, now_s)

    def hung_up(self, _port: int) -> None:
        """Start the adapter anew: its computer has closed the port."""
        self._adapter.restart()
        self._out.clear()
