"""Converts between values and the bytes of advanced sercom v2 in its binary mode; the only place with units.

A request is a row of commands, each the negative of a letter, with what belongs to it, and a zero. The robot answers
with what the commands ask for, in their order, without any frame or checksum. So each request here sets the motors (D)
and asks for their set speeds (E), the step counters (Q), the battery (b), and the set speeds again: an answer is right
only if both echoes are what was set. All numbers are 16 bits, the low byte first, speeds in steps/s. Source: GCtronic
wiki, "Advanced sercom protocol", and ``Asercom2.c`` of e-puck2_main-processor.
"""

import math
import struct
from dataclasses import dataclass

from fullswarm.drivers.base import Twist

MOST_STEPS = 1000
"""Per second; the firmware cuts off at 1100."""
STEP_M = math.pi * 0.041 / 1000.0
"""A wheel of 41 mm turns once in 1000 steps (e-puck.org, "Mechanics")."""
BASE_M = 0.053
COUNTS_PER_VOLT = 4096.0 * 330.0 / (220.0 + 330.0) / 3.0
EMPTY_V, FULL_V = 3.4, 4.2
PLAUSIBLE_V = (2.8, 4.6)
ANSWER_BYTES = 14

_D, _E, _Q, _B = (256 - ord(each) for each in "DEQb")


@dataclass(frozen=True, slots=True)
class Steps:
    """Speeds or counters of the left and the right wheel."""

    left: int
    right: int


STOP = Steps(0, 0)


@dataclass(frozen=True, slots=True)
class Answer:
    """What the robot has answered: its step counters, modulo 2^16, and its charge, 0 to 1."""

    counters: Steps
    charge: float


def to_steps(twist: Twist) -> Steps:
    """Return whole steps/s of a twist; both wheels are slowed alike where one would be too fast."""
    half = twist.angular_rad_s * BASE_M / 2.0
    left, right = (twist.linear_m_s - half) / STEP_M, (twist.linear_m_s + half) / STEP_M
    scale = min(1.0, MOST_STEPS / max(abs(left), abs(right), 1.0))
    return Steps(round(left * scale), round(right * scale))


def to_twist(steps: Steps) -> Twist:
    """Return the twist of wheel speeds."""
    return Twist((steps.left + steps.right) * STEP_M / 2.0, (steps.right - steps.left) * STEP_M / BASE_M)


def drive(speeds: Steps) -> bytes:
    """Return a request that sets the motors and asks for nothing."""
    return struct.pack("<BhhB", _D, speeds.left, speeds.right, 0)


def request(speeds: Steps) -> bytes:
    """Return a request that sets the motors and asks for everything."""
    return struct.pack("<Bhh5B", _D, speeds.left, speeds.right, _E, _Q, _B, _E, 0)


PARK = bytes(8) + drive(STOP)
"""Stops it in any state: the zeros end a request that was cut in two."""
RESYNC = PARK + b"S\r"
"""The same, and ends a line of text in which noise may have begun: S stops as well."""


def answer(data: bytes, speeds: Steps) -> Answer | None:
    """Return the last answer in `data` to a request that set these speeds; None: there is none."""
    for begin in range(len(data) - ANSWER_BYTES, -1, -1):
        left, right, *counters, battery, left_again, right_again = struct.unpack_from("<hhHHHhh", data, begin)
        volt = battery / COUNTS_PER_VOLT
        if (left, right) == (left_again, right_again) == (speeds.left, speeds.right) and (
            PLAUSIBLE_V[0] <= volt <= PLAUSIBLE_V[1]
        ):
            charge = (volt - EMPTY_V) / (FULL_V - EMPTY_V)
            return Answer(Steps(*counters), min(max(charge, 0.0), 1.0))
    return None


def difference(new: int, old: int) -> int:
    """Return how many steps a counter has gone; it wraps at 2^16."""
    return (new - old + 0x8000) % 0x10000 - 0x8000
