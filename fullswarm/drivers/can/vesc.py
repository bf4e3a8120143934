"""VESC: 29-bit identifiers ``command << 8 | node``, big endian, no acknowledgements. Bytes only.

Source: VESC firmware ``comm_can.c``, ``datatypes.h``.
"""

from __future__ import annotations

from dataclasses import dataclass

from fullswarm.drivers.can.layout import Layout, Table
from fullswarm.drivers.can.protocol import Beat, Frame, Mode, Motion, Power, Report, Want, Wheel

MAX_NODE = 254
EVERYBODY = 255
MAX_ERPM = 2_000_000
"""No motor turns faster: a larger reported value is noise."""
TACHO_PER_TURN = 6
"""Tachometer counts per electrical turn."""
FIRMWARE_TIMEOUT_S = 1.0
"""As delivered: without a SET command for that long the motor is let go."""


# ---------------------------------------------------------------- what is sent to a controller
@dataclass(frozen=True, slots=True)
class SetDuty:
    """Duty cycle, -1 to 1."""

    duty: float


@dataclass(frozen=True, slots=True)
class SetCurrent:
    """Drive with a motor current; zero lets the motor go."""

    current_a: float


@dataclass(frozen=True, slots=True)
class SetBrake:
    """Brake with a motor current; without effect at rest."""

    current_a: float


@dataclass(frozen=True, slots=True)
class SetErpm:
    """Regulate the electrical speed; below the firmware's minimum the motor is let go."""

    erpm: int


@dataclass(frozen=True, slots=True)
class SetPosition:
    """Regulate the position."""

    position_deg: float


@dataclass(frozen=True, slots=True)
class SetRelativeCurrent:
    """Share of the greatest current, -1 to 1."""

    share: float


@dataclass(frozen=True, slots=True)
class SetRelativeBrake:
    """Share of the greatest braking current."""

    share: float


@dataclass(frozen=True, slots=True)
class SetHandbrake:
    """Hold the motor with a current."""

    current_a: float


@dataclass(frozen=True, slots=True)
class SetRelativeHandbrake:
    """Hold it with a share of the greatest current."""

    share: float


@dataclass(frozen=True, slots=True)
class Ping:
    """Ask for a sign of life, to be sent to `host`."""

    host: int


# ---------------------------------------------------------------- what it reports
@dataclass(frozen=True, slots=True)
class Pong:
    """The answer of `node`; its identifier holds the host."""

    node: int
    hardware: int = 0


@dataclass(frozen=True, slots=True)
class Status1:
    """Speed, motor current, duty cycle."""

    erpm: int
    current_a: float
    duty: float


@dataclass(frozen=True, slots=True)
class Status2:
    """Charge drawn and fed back, Ah."""

    drawn_ah: float
    charged_ah: float


@dataclass(frozen=True, slots=True)
class Status3:
    """Energy drawn and fed back, Wh."""

    drawn_wh: float
    charged_wh: float


@dataclass(frozen=True, slots=True)
class Status4:
    """Temperatures, input current, position of the regulator."""

    fet_c: float
    motor_c: float
    input_a: float
    position_deg: float


@dataclass(frozen=True, slots=True)
class Status5:
    """Tachometer (wraps at 32 bits) and input voltage."""

    tachometer: int
    volts: float
    reserved: int = 0


@dataclass(frozen=True, slots=True)
class Status6:
    """Inputs: three voltages and the pulse, -1 to 1."""

    adc1_v: float
    adc2_v: float
    adc3_v: float
    ppm: float


def _order(command: int, kind: type[object], scale: float) -> Layout:
    """All orders are one whole number; a longer frame is another firmware's."""
    return Layout(command, kind, ">i", (scale,), most=4)


TABLE: Table[object] = Table(
    (
        _order(0, SetDuty, 1e5),
        _order(1, SetCurrent, 1e3),
        _order(2, SetBrake, 1e3),
        _order(3, SetErpm, 1.0),
        _order(4, SetPosition, 1e6),
        _order(10, SetRelativeCurrent, 1e5),
        _order(11, SetRelativeBrake, 1e5),
        _order(12, SetHandbrake, 1e3),
        _order(13, SetRelativeHandbrake, 1e5),
        Layout(9, Status1, ">ihh", (1.0, 10.0, 1e3)),
        Layout(14, Status2, ">ii", (1e4, 1e4)),
        Layout(15, Status3, ">ii", (1e4, 1e4)),
        Layout(16, Status4, ">hhhh", (10.0, 10.0, 10.0, 50.0)),
        Layout(17, Ping, ">B"),
        Layout(18, Pong, ">BB", least=1),
        Layout(27, Status5, ">ihh", (1.0, 10.0, 1.0), least=6),
        Layout(58, Status6, ">hhhh", (1e3, 1e3, 1e3, 1e3)),
    )
)
ORDERS = frozenset({0, 1, 2, 3, 4, 10, 11, 12, 13})
"""Commands that move or brake the motor; only these feed its timeout."""


def encode(node: int, message: object) -> Frame:
    """Return the frame of `message` to or from `node` (a pong: to the host).

    Raises ``KeyError`` for what is no message of ours, ``ValueError`` when a value does not fit.
    """
    command, data = TABLE.pack(message)
    return Frame(command << 8 | node, extended=True, data=data)


def decode(frame: Frame) -> object | None:
    """Return the message in `frame`; None when it is no message of ours or malformed."""
    if not frame.extended or frame.remote:
        return None
    return TABLE.unpack(frame.id >> 8, frame.data)


# ---------------------------------------------------------------- one wheel
_PONG = 18
_OURS = frozenset({9, _PONG, 27})  # statuses 1 and 5
_WRAP = 1 << 32


@dataclass(slots=True)
class VescCodec:
    """One controller as a :class:`~fullswarm.drivers.can.protocol.WheelCodec`.

    The protocol has no states and its status messages no faults: life is shown by answering a ping, and a
    controller in fault only by a wheel that does not turn. Status messages 1 and 5 are off as delivered and its
    timeout (1 s, then the motor coasts) is set in VESC Tool only; just SET commands feed it. A set-point inside
    the dead band is sent as a brake current, because the regulator would let the wheel roll.
    """

    node: int
    wheel: Wheel
    host: int = 253  # our own address, for pongs
    min_erpm: float = 900.0  # s_pid_min_erpm
    brake_a: float = 5.0
    malformed: int = 0
    _tachometer: int = 0  # as reported last …
    _counts: int = 0  # … and without its wraps

    @property
    def max_speed_m_s(self) -> float:
        """Return ``inf``: the controller's own limit is not to be had on the bus."""
        return float("inf")

    @property
    def generic_firmware(self) -> str:
        """Return what is known: plain frames do not carry its version."""
        return "VESC"

    def quantised(self, speed_m_s: float) -> float:
        """Return the speed of the nearest whole ERPM, zero below the firmware's minimum."""
        return self.wheel.speed_of_erpm(self._erpm(speed_m_s))

    def _erpm(self, speed_m_s: float) -> int:
        erpm = round(max(-MAX_ERPM, min(MAX_ERPM, self.wheel.erpm(speed_m_s))))
        return erpm if abs(erpm) >= self.min_erpm else 0

    def start(self) -> tuple[Frame, ...]:
        """Nothing to clear and no mode to choose: let the motor go."""
        return self.release()

    def engage(self) -> tuple[Frame, ...]:
        """Hold the wheel."""
        return self.drive(0.0)

    def drive(self, speed_m_s: float) -> tuple[Frame, ...]:
        """Regulate the speed, or brake when it is zero or too slow to be regulated."""
        erpm = self._erpm(speed_m_s)
        order = SetErpm(erpm) if erpm else SetBrake(self.brake_a)
        return (encode(self.node, order),)

    def release(self) -> tuple[Frame, ...]:
        """Current zero: the wheel coasts."""
        return (encode(self.node, SetCurrent(0.0)),)

    def keep_alive(self) -> tuple[Frame, ...]:
        """Nothing: an idle controller that times out stays idle."""
        return ()

    def poll(self, wants: Want) -> tuple[Frame, ...]:
        """Ping; status messages cannot be asked for."""
        return (encode(self.node, Ping(self.host)),) if Want.BEAT in wants else ()

    def decode(self, frame: Frame) -> Report | None:
        """Return what the controller reports: pong, speed, tachometer and voltage."""
        if not frame.extended or frame.remote:
            return None
        command, address = frame.id >> 8, frame.id & 0xFF
        if command not in _OURS or address != (self.host if command == _PONG else self.node):
            return None
        message = decode(frame)
        match message:
            case Pong(node=node):
                return Beat(Mode.UNKNOWN) if node == self.node else None
            case Status1(erpm=erpm) if abs(erpm) <= MAX_ERPM:
                return Motion(self.wheel.speed_of_erpm(erpm), None)
            case Status5(tachometer=tachometer, volts=volts):
                distance_m = self.wheel.metres(self._unwrapped(tachometer) / self._counts_per_turn)
                return Motion(None, distance_m, Power(volts) if volts >= 0.0 else None)
        self.malformed += 1
        return None

    @property
    def _counts_per_turn(self) -> int:
        return TACHO_PER_TURN * self.wheel.pole_pairs

    def _unwrapped(self, tachometer: int) -> int:
        step = (tachometer - self._tachometer + _WRAP // 2) % _WRAP - _WRAP // 2
        self._tachometer = tachometer
        self._counts += step
        return self._counts
