"""Converts between values and the Scout's messages; the only place where units are converted.

A message is a line of JSON over TCP. Lengths are mm, angles mrad, counter-clockwise, x forward as ours. `Hello`,
`Enable` and `Drive` go to the robot; `Robot` and `State` come from it.
"""

from contextlib import suppress
from typing import Annotated, Literal, Self

from fullswarm.drivers.base import Pose, Twist
from fullswarm.geometry import wrap
from msgspec import Meta, MsgspecError, Struct, json

LONGEST = 300
WATCHDOG_S = 1.0
Milli = Annotated[int, Meta(ge=-(10**9), le=10**9)]


class Hello(Struct, tag=True):
    """Asks for `Robot`, and for `State` 50 times a second from now on."""


class Enable(Struct, tag=True):
    """Motors on: they obey `Drive`. Or off."""

    on: bool


class Motion(Struct):
    """Speed and turn rate."""

    v: Milli
    w: Milli

    @classmethod
    def of(cls, twist: Twist) -> Self:
        """Round a twist, which must be finite."""
        return cls(round(twist.linear_m_s * 1e3), round(twist.angular_rad_s * 1e3))

    @property
    def twist(self) -> Twist:
        """What is left of it in whole mm/s and mrad/s."""
        return Twist(self.v / 1e3, self.w / 1e3)


class Drive(Motion, tag=True):
    """Set-point; the robot stops when no other one arrives within 1 s."""


class Robot(Struct, tag=True):
    """The answer to `Hello`; `boot` differs after a restart."""

    model: str
    firmware: str
    boot: int


class State(Motion, tag=True):
    """What the robot reports 50 times a second; its pose is counted since its boot."""

    x: Milli
    y: Milli
    heading: Milli
    mode: Literal["IDLE", "ON", "ESTOP"] = "IDLE"
    bumper: bool = False
    percent: Annotated[int, Meta(ge=0, le=100)] = 100

    @property
    def pose(self) -> Pose:
        """Where it is since its boot."""
        return Pose(self.x / 1e3, self.y / 1e3, wrap(self.heading / 1e3))


Message = Hello | Enable | Drive | Robot | State
_decoder = json.Decoder(Message)


def line(message: Message) -> bytes:
    """Return a message with its line feed."""
    return json.encode(message) + b"\n"


class LineParser:
    """Finds messages in a stream that may begin in the middle of one and hold noise."""

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[Message]:
        """Return the messages that are whole now."""
        *lines, rest = (self._rest + data).split(b"\n")
        self._rest, messages = rest[-LONGEST:], list[Message]()  # what is longer is no message
        for each in lines:
            with suppress(MsgspecError, ValueError):
                messages.append(_decoder.decode(each))
        return messages
