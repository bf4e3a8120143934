"""The state of a gamepad at one moment, and the protocol of its source."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

AXES = ("leftx", "lefty", "rightx", "righty", "lefttrigger", "righttrigger")
BUTTONS = (
    "a", "b", "x", "y", "back", "guide", "start", "leftstick", "rightstick", "leftshoulder", "rightshoulder",
    "dpup", "dpdown", "dpleft", "dpright", "misc1", "paddle1", "paddle2", "paddle3", "paddle4", "touchpad",
)  # fmt: skip
"""SDL's names, in SDL's order. They denote positions, not labels: ``a`` is the lowest of four on every make."""


@dataclass(frozen=True, slots=True)
class PadState:
    """A pad that is plugged in.

    Attributes
    ----------
    id
        Unique since the program started; a pad that is plugged in again gets another one.
    known
        Whether SDL knows which axis is which; if not, it has neither axes nor buttons.
    axes
        Each from -1 to 1 (triggers from 0); x to the right, y towards the user, as SDL has it.
    buttons
        Those down now, and those that were down for a moment since the last poll.
    """

    id: int
    name: str
    guid: str
    known: bool = True
    axes: Mapping[str, float] = field(default_factory=dict)
    buttons: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class RawState:
    """A pad without any mapping: axes -1 to 1, buttons by number, hats as bits (1 up, 2 right, 4 down, 8 left)."""

    axes: tuple[float, ...] = ()
    buttons: frozenset[int] = frozenset()
    hats: tuple[int, ...] = ()


class PadSource(Protocol):
    """A source of pads: SDL, or a test."""

    def poll(self) -> tuple[PadState, ...]:
        """Return all pads that are plugged in now, in the order in which they were plugged in."""
        ...

    def rumble(self, pad: int, strength: float, seconds: float) -> None:
        """Rumble a pad, `strength` 0 to 1. Does nothing if it cannot."""
        ...


def shaped(offsets: tuple[float, ...], dead_zone: float, expo: float) -> tuple[float, ...]:
    """Return a stick's offsets without its dead zone: radial, rescaled, so that they begin at zero and end at one.

    Parameters
    ----------
    offsets
        One per axis of the stick, -1 to 1.
    dead_zone
        Radius within which it counts as centred, 0 to below 1.
    expo
        0: linear; 1: cubic, fine near the centre.
    """
    radius = math.hypot(*offsets)
    if not radius > dead_zone:  # also not a number
        return tuple(0.0 for _ in offsets)
    share = (min(radius, 1.0) - dead_zone) / (1.0 - dead_zone)
    share = (1.0 - expo) * share + expo * share**3
    return tuple(max(-1.0, min(1.0, each / radius * share)) for each in offsets)
