"""Converts between values and the Scout's line protocol; the only place where units are converted.

A line is words of ASCII, an asterisk, four digits of CRC and a line feed: ``DRIVE 250 -300*e456``. Lengths are mm,
angles mrad, counter-clockwise, x forward as ours::

    to the robot     HELLO      asks for ROBOT, and for STATE 50 times a second from now on
                     ENABLE     motors on: they obey DRIVE
                     DISABLE    motors off
                     DRIVE v w  set-point; the robot stops when no other one arrives within 1 s
    from the robot   ROBOT model firmware boot
                     STATE mode x y heading v w bumper battery      mode is IDLE, ON or ESTOP; since its boot
"""

from __future__ import annotations

import binascii
import re
from dataclasses import dataclass

from fullswarm.drivers.base import Pose, Twist
from fullswarm.geometry import wrap

LONGEST = 120
WATCHDOG_S = 1.0
MODES = ("IDLE", "ON", "ESTOP")
_STATE = re.compile(r"STATE (IDLE|ON|ESTOP) ((?:-?\d{1,9} ){5})([01]) (\d{1,3})")
_ROBOT = re.compile(r"ROBOT (\w{1,20}) ([\w.]{1,20}) (\d{1,9})")
_DRIVE = re.compile(r"DRIVE (-?\d{1,5}) (-?\d{1,5})")


@dataclass(frozen=True, slots=True)
class Robot:
    """The answer to HELLO; `boot` differs after a restart."""

    model: str
    firmware: str
    boot: int


@dataclass(frozen=True, slots=True)
class State:
    """What the robot reports 50 times a second; its pose is counted since its boot."""

    mode: str
    pose: Pose
    twist: Twist
    bumper: bool
    battery: float  # 0 to 1


def line(text: str) -> bytes:
    """Return a line with its check."""
    return f"{text}*{_crc(text.encode('ascii')):04x}\n".encode("ascii")


def drive(twist: Twist) -> str:
    """Return the text of a set-point; it must be finite."""
    return f"DRIVE {round(twist.linear_m_s * 1e3)} {round(twist.angular_rad_s * 1e3)}"


def quantised(twist: Twist) -> Twist:
    """Return what is left of a set-point in whole mm/s and mrad/s."""
    return Twist(round(twist.linear_m_s * 1e3) / 1e3, round(twist.angular_rad_s * 1e3) / 1e3)


def state(known: State) -> str:
    """Return the text of a state."""
    pose, twist = known.pose, known.twist
    values = (pose.x_m, pose.y_m, pose.heading_rad, twist.linear_m_s, twist.angular_rad_s)
    numbers = " ".join(str(round(value * 1e3)) for value in values)
    return f"STATE {known.mode} {numbers} {int(known.bumper)} {round(known.battery * 100)}"


def parse_state(text: str) -> State | None:
    """Read a STATE; None if it is none."""
    found = _STATE.fullmatch(text)
    if found is None or int(found[4]) > 100:
        return None
    x, y, heading, v, w = (int(each) / 1e3 for each in found[2].split())
    return State(found[1], Pose(x, y, wrap(heading)), Twist(v, w), found[3] == "1", int(found[4]) / 100.0)


def parse_robot(text: str) -> Robot | None:
    """Read a ROBOT; None if it is none."""
    found = _ROBOT.fullmatch(text)
    return None if found is None else Robot(found[1], found[2], int(found[3]))


def parse_drive(text: str) -> Twist | None:
    """Read a DRIVE; None if it is none."""
    found = _DRIVE.fullmatch(text)
    return None if found is None else Twist(int(found[1]) / 1e3, int(found[2]) / 1e3)


class LineParser:
    """Finds good lines in a stream that may begin in the middle of one and hold noise."""

    def __init__(self) -> None:
        self._rest = bytearray()

    def feed(self, data: bytes) -> list[str]:
        """Return the texts of the lines that are whole now and whose check holds."""
        *lines, rest = bytes(self._rest + data).split(b"\n")
        self._rest = bytearray(rest[-LONGEST:])  # what is longer is no line
        texts = [_checked(each) for each in lines]
        return [each for each in texts if each is not None]


def _checked(raw: bytes) -> str | None:
    text, star, check = raw.rpartition(b"*")
    if not star or not text.isascii() or check != f"{_crc(text):04x}".encode("ascii"):
        return None
    return text.decode("ascii")


def _crc(text: bytes) -> int:
    return binascii.crc_hqx(text, 0xFFFF)
