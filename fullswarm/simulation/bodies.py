"""What emulated firmware drives: one body, alone on an endless floor or in the simulated world.

An emulator gives a body a real port. Its firmware sets how the motors move the body and reads the result; wheels and
encoders belong to the firmware (:func:`wheels_rolled`). All makes use the same body, so that Creates, rovers and CAN
bases drive in one world and collide with each other.

The world is stepped on one thread, firmware runs on others: each side only replaces one tuple of the other's.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from fullswarm.clock import Clock, MonotonicClock
from fullswarm.drivers.base import Pose
from fullswarm.geometry import wrap
from fullswarm.simulation.obstacles import obstacle_gap
from fullswarm.simulation.world import World

ORIGIN = Pose(0.0, 0.0, 0.0)

MIDDLE_RAD = math.radians(12.0)
"""A contact this close to straight ahead presses both halves of a bumper."""

RETURN_S = 0.05
"""A bumper needs so long to spring back: firmware that reads it each 15 ms must not miss a short contact."""

EMULATED_RATE_HZ = 200.0
"""Emulated encoders are read every 10 to 15 ms: a slower world would make them jump."""


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
        """Turn the motors so that the body moves like this, until the next call: a body has no watchdog."""
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


class WorldBody:
    """A :class:`~fullswarm.simulation.bodies.Body` that is row `row` of a world."""

    def __init__(self, world: World, row: int) -> None:
        self._world, self._row = world, row
        self._desired = (0.0, 0.0)
        x_m, y_m, heading_rad = world.pose[row].tolist()
        self._state = BodyState(x_m, y_m, heading_rad)
        self._pressed: tuple[tuple[bool, bool], int] = (False, False), 0
        self._pressed_s = -math.inf

    def drive(self, speed_m_s: float, turn_rad_s: float) -> None:
        """Move like this from the next step on; raises ``ValueError`` if not finite."""
        if not (math.isfinite(speed_m_s) and math.isfinite(turn_rad_s)):
            raise ValueError(f"a body cannot move at {speed_m_s} m/s, {turn_rad_s} rad/s")
        self._desired = (speed_m_s, turn_rad_s)

    def state(self) -> BodyState:
        """Return where the body was after the last step."""
        return self._state

    def before_step(self) -> None:
        """Give the world the desired twist; called on the world's thread."""
        self._world.commanded_s[self._row] = self._world.time_s
        self._world.target[self._row] = self._desired

    def after_step(self) -> None:
        """Take the state after the step; called on the world's thread."""
        world, row, before = self._world, self._row, self._state
        x_m, y_m, heading_rad = world.pose[row].tolist()
        speed_m_s, _ = world.twist[row].tolist()
        turned_rad = wrap(heading_rad - before.heading_rad)
        if world.contacts[row]:
            self._pressed = self._bumps(x_m, y_m, heading_rad), int(world.contacts[row])
            self._pressed_s = world.time_s
        bumps, contacts = self._pressed if world.time_s - self._pressed_s < RETURN_S else ((False, False), 0)
        self._state = BodyState(
            x_m, y_m, heading_rad, speed_m_s, turned_rad / world.dt_s,
            before.rolled_m + speed_m_s * world.dt_s, before.turned_rad + turned_rad,
            bumps, contacts,
        )  # fmt: skip

    def _bumps(self, x_m: float, y_m: float, heading_rad: float) -> tuple[bool, bool]:
        """Return which halves of a bumper on the front half of the body are pressed: left, right."""
        left = right = False
        for i, j in self._world.pairs.tolist():
            if self._row not in (i, j):
                continue
            if j < 0:
                _, nx, ny = obstacle_gap(x_m, y_m, self._world.shapes, -1 - j)
                dx, dy = -nx, -ny
            else:
                other_x, other_y, _ = self._world.pose[j if i == self._row else i].tolist()
                dx, dy = other_x - x_m, other_y - y_m
            side_rad = wrap(math.atan2(dy, dx) - heading_rad)
            if abs(side_rad) <= math.pi / 2:
                left |= side_rad > -MIDDLE_RAD
                right |= side_rad < MIDDLE_RAD
        return left, right


class SteppedBodies:
    """Steps a world in real time together with the bodies that emulated firmware drives."""

    def __init__(self, world: World, robots: Sequence[str]) -> None:
        self.of = {robot: WorldBody(world, world.row(robot)) for robot in robots}
        self._all = tuple(self.of.values())

    def before_step(self) -> None:
        """Give the world the desired twists of all."""
        for body in self._all:
            body.before_step()

    def after_step(self) -> None:
        """Take the states after the step."""
        for body in self._all:
            body.after_step()
