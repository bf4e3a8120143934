"""Bodies of the world for emulated firmware: what a skin drives instead of a free body.

The world is stepped on one thread, firmware runs on others: each side only ever replaces one tuple of the other's.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from fullswarm.drivers.body import BodyState
from fullswarm.drivers.sim.contact_kernels import obstacle_gap
from fullswarm.drivers.sim.world import World
from fullswarm.geometry import wrap

MIDDLE_RAD = math.radians(12.0)
"""What touches so close to straight ahead presses both halves of a bumper."""

RETURN_S = 0.05
"""A bumper needs so long to spring back: firmware that asks each 15 ms feels a short contact, too."""

SKIN_RATE_HZ = 200.0
"""Emulated encoders are read every 10 to 15 ms: a slower world would make them jump."""


class WorldBody:
    """A :class:`~fullswarm.drivers.body.Body` that is row `row` of a world."""

    def __init__(self, world: World, row: int) -> None:
        self._world, self._row = world, row
        self._wish = (0.0, 0.0)
        x_m, y_m, heading_rad = world.pose[row].tolist()
        self._state = BodyState(x_m, y_m, heading_rad)
        self._pressed: tuple[tuple[bool, bool], int] = (False, False), 0
        self._pressed_s = -math.inf

    def drive(self, speed_m_s: float, turn_rad_s: float) -> None:
        """Move like this from the next step on; raises ``ValueError`` if not finite."""
        if not (math.isfinite(speed_m_s) and math.isfinite(turn_rad_s)):
            raise ValueError(f"a body cannot move at {speed_m_s} m/s, {turn_rad_s} rad/s")
        self._wish = (speed_m_s, turn_rad_s)

    def state(self) -> BodyState:
        """Return where the body was after the last step."""
        return self._state

    def before_step(self) -> None:
        """Give the world the wish; called on the world's thread."""
        self._world.commanded_s[self._row] = self._world.time_s
        self._world.target[self._row] = self._wish

    def after_step(self) -> None:
        """Take what came of it; called on the world's thread."""
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
        """Tell which halves of a bumper on the front half of the body are pressed: left, right."""
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
        """Give the world what all of them wish."""
        for body in self._all:
            body.before_step()

    def after_step(self) -> None:
        """Take what came of it."""
        for body in self._all:
            body.after_step()
