"""What the two protocols share: a frame, a wheel, what a controller may report, what a codec must do. Bytes only."""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import Protocol

MAX_DATA = 8
"""Bytes of a classic CAN frame; none of the protocols here uses CAN FD."""


@dataclass(frozen=True, slots=True)
class Frame:
    """One classic CAN frame: identifier of 11 or (`extended`) 29 bits, up to 8 bytes; `remote` asks for a value."""

    id: int
    extended: bool
    data: bytes = b""
    remote: bool = False


@dataclass(frozen=True, slots=True)
class Wheel:
    """How a wheel is connected to its motor.

    Parameters
    ----------
    radius_m
        Of the wheel.
    gear
        Motor turns per wheel turn.
    pole_pairs
        Of the motor; electrical turns per motor turn.
    sign
        -1 when the motor turns backwards for the robot to go forwards (a mirrored wheel).
    """

    radius_m: float
    gear: float = 1.0
    pole_pairs: int = 1
    sign: int = 1

    def __post_init__(self) -> None:
        if not (0.0 < self.radius_m < math.inf and 0.0 < self.gear < math.inf and self.pole_pairs >= 1):
            raise ValueError(f"radius, gear and pole pairs of a wheel are positive, not {self}")
        if self.sign not in (-1, 1):
            raise ValueError(f"the sign of a wheel is 1 or -1, not {self.sign}")

    def turns(self, distance_m: float) -> float:
        """Return motor turns (turn/s) for a distance in m (m/s)."""
        return self.sign * distance_m * self.gear / (2.0 * math.pi * self.radius_m)

    def metres(self, turns: float) -> float:
        """Return the distance in m (m/s) for motor turns (turn/s)."""
        return self.sign * turns * (2.0 * math.pi * self.radius_m) / self.gear

    def erpm(self, speed_m_s: float) -> float:
        """Return electrical revolutions per minute: motor rpm times pole pairs."""
        return self.turns(speed_m_s) * 60.0 * self.pole_pairs

    def speed_of_erpm(self, erpm: float) -> float:
        """Return m/s for electrical revolutions per minute."""
        return self.metres(erpm / (60.0 * self.pole_pairs))


class Mode(enum.Enum):
    """What a controller does with its motor."""

    IDLE = "idle"
    DRIVING = "driving"  # obeys set-points
    BUSY = "busy"  # calibrates, homes, starts up
    UNKNOWN = "unknown"  # the protocol does not show it


@dataclass(frozen=True, slots=True)
class Beat:
    """A sign of life, with the state where the protocol has one."""

    mode: Mode
    state: str = ""  # the maker's name for it
    error: str = ""  # decoded names; empty: none
    estop: bool = False  # among the errors is an emergency stop


@dataclass(frozen=True, slots=True)
class Power:
    """What the controller is supplied with."""

    volts: float


@dataclass(frozen=True, slots=True)
class Motion:
    """How the wheel moves: m/s and m along the robot's x axis; None where this message does not contain it."""

    speed_m_s: float | None
    distance_m: float | None  # since the controller started
    power: Power | None = None  # in the same message


@dataclass(frozen=True, slots=True)
class Version:
    """What firmware the controller runs."""

    firmware: str


Report = Beat | Motion | Version | Power


class Want(enum.Flag):
    """What a controller is asked for where it does not report by itself."""

    BEAT = 1  # a sign of life
    MOTION = 2
    POWER = 4
    VERSION = 8


class WheelCodec(Protocol):
    """The frames of one wheel's controller. Pure but for `malformed`; never raises on what the bus carries."""

    node: int
    wheel: Wheel
    malformed: int  # frames of ours that were too short, too long or not finite

    @property
    def max_speed_m_s(self) -> float:
        """Return the wheel speed that the controller itself allows; ``inf`` when it states none."""
        ...

    @property
    def generic_firmware(self) -> str:
        """Return what is known of the firmware when the controller reports nothing."""
        ...

    def quantised(self, speed_m_s: float) -> float:
        """Return the speed that the controller makes of `speed_m_s`: rounding, dead band."""
        ...

    def start(self) -> tuple[Frame, ...]:
        """Clear errors, choose the control mode, set-point zero. Moves nothing."""
        ...

    def engage(self) -> tuple[Frame, ...]:
        """Hand the motor to the set-points, beginning at zero."""
        ...

    def drive(self, speed_m_s: float) -> tuple[Frame, ...]:
        """Turn at `speed_m_s`; zero holds the wheel as well as the controller can."""
        ...

    def release(self) -> tuple[Frame, ...]:
        """Set-point zero, then let the motor go."""
        ...

    def keep_alive(self) -> tuple[Frame, ...]:
        """Feed the controller's watchdog while it is idle; empty where that is needless."""
        ...

    def poll(self, wants: Want) -> tuple[Frame, ...]:
        """Ask for what is wanted, as far as this protocol can be asked."""
        ...

    def decode(self, frame: Frame) -> Report | None:
        """Return what `frame` reports of this wheel; None when it is not ours, irrelevant or malformed."""
        ...
