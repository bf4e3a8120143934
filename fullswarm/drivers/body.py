"""What an emulated robot's firmware stands on: one body, alone on an endless floor or in the simulated world.

An emulator is a skin: it gives a body a real port. Firmware tells the body how its motors turn it and asks what came
of that; wheels and encoders are the skin's business (:func:`wheels_rolled`). Every make uses the same body, so that
Creates, rovers and CAN bases drive in one world and hit each other.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass
from typing import Protocol

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import Pose
from fullswarm.geometry import wrap

ORIGIN = Pose(0.0, 0.0, 0.0)


@dataclass(frozen=True, slots=True)
class BodyState:
    """Where a body truly is and what it has done. World frame (ENU), metres, radians counter-clockwise."""

    x_m: float = 0.0
    y_m: float = 0.0
    heading_rad: float = 0.0  # in [-π, π]
    speed_m_s: float = 0.0  # along the heading
    turn_rad_s: float = 0.0
    rolled_m: float = 0.0  # along its own heading since the start, backwards negative
    turned_rad: float = 0.0  # since the start, not wrapped
    bumps: tuple[bool, bool] = (False, False)  # left and right half of the bumper are pressed
    contacts: int = 0  # bodies and obstacles touched now


class Body(Protocol):
    """What firmware drives. Thread-safe: an emulator and the world run on threads of their own."""

    def drive(self, speed_m_s: float, turn_rad_s: float) -> None:
        """Turn the motors so that the body moves like this, until told otherwise: a body has no watchdog."""
        ...

    def state(self) -> BodyState:
        """Return where the body is now."""
        ...


def wheels_rolled(state: BodyState, base_m: float) -> tuple[float, float]:
    """Return how far the left and the right wheel of a differential drive have rolled, in metres.

    `base_m` is the distance between the wheels.
    """
    half = state.turned_rad * base_m / 2.0
    return state.rolled_m - half, state.rolled_m + half


def drive_wheels(body: Body, left_m_s: float, right_m_s: float, base_m: float) -> None:
    """Drive a body by the speeds of its two wheels, `base_m` apart."""
    body.drive((left_m_s + right_m_s) / 2.0, (right_m_s - left_m_s) / base_m)


class FreeBody:
    """A body alone on an endless floor: it moves at once, and exactly, as its motors turn.

    Parameters
    ----------
    start
        Pose at the start, world frame.
    """

    def __init__(self, start: Pose = ORIGIN, clock: Clock | None = None) -> None:
        self._clock = clock or MonotonicClock()
        self._lock = threading.Lock()
        self._stamp_s = self._clock.now_s()
        self._x_m, self._y_m = start.x_m, start.y_m
        self._start_rad = start.heading_rad
        self._rolled_m = self._turned_rad = 0.0
        self._speed_m_s = self._turn_rad_s = 0.0
        self._bumps = (False, False)

    def drive(self, speed_m_s: float, turn_rad_s: float) -> None:
        """Move like this from now on."""
        with self._lock:
            self._go_on()
            self._speed_m_s, self._turn_rad_s = speed_m_s, turn_rad_s

    def state(self) -> BodyState:
        """Return where the body is now."""
        with self._lock:
            self._go_on()
            heading = wrap(self._start_rad + self._turned_rad)
            return BodyState(
                self._x_m, self._y_m, heading, self._speed_m_s, self._turn_rad_s, self._rolled_m, self._turned_rad,
                self._bumps, int(any(self._bumps)),
            )  # fmt: skip

    def press(self, left: bool, right: bool) -> None:
        """Press or release the halves of the bumper; nothing stops the body, there is nothing in its way."""
        with self._lock:
            self._bumps = (left, right)

    def push(self, rolled_m: float, turned_rad: float) -> None:
        """Move the body by hand along an arc; its wheels roll."""
        with self._lock:
            self._go_on()
            self._move(rolled_m, turned_rad)

    def _go_on(self) -> None:
        now_s = self._clock.now_s()
        passed_s, self._stamp_s = now_s - self._stamp_s, now_s
        self._move(self._speed_m_s * passed_s, self._turn_rad_s * passed_s)

    def _move(self, rolled_m: float, turned_rad: float) -> None:
        half = turned_rad / 2.0
        middle = self._start_rad + self._turned_rad + half
        chord = rolled_m * (math.sin(half) / half if half else 1.0)
        self._x_m += chord * math.cos(middle)
        self._y_m += chord * math.sin(middle)
        self._rolled_m += rolled_m
        self._turned_rad += turned_rad
