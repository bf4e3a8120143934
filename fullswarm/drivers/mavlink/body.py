"""What an emulated rover drives, and how its firmware understands a set-point."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Protocol

from fullswarm.drivers.mavlink import protocol as p
from fullswarm.geometry import clamp, wrap

COAST_S = 0.36  # time constant of a coasting skid-steer rover, from its measured stops
STAND = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class BodyState:
    """Where a body is: ENU metres, heading, speed along it, turn rate (counter-clockwise)."""

    x_m: float = 0.0
    y_m: float = 0.0
    heading_rad: float = 0.0
    speed_m_s: float = 0.0
    turn_rad_s: float = 0.0


class Body(Protocol):
    """What the firmware drives: the kinematic one below, or one of a simulated world."""

    def drive(self, speed_m_s: float, turn_rad_s: float, duration_s: float) -> None:
        """Move on with these set-points (ENU: counter-clockwise positive)."""
        ...

    def coast(self, duration_s: float) -> None:
        """Move on with motors off."""
        ...

    def state(self) -> BodyState:
        """Return where it is."""
        ...


class UnicycleBody:
    """A kinematic unicycle with limited accelerations (defaults measured on the real firmware's simulator)."""

    def __init__(
        self, start: BodyState | None = None, accel_m_s2: float = 1.08, turn_accel_rad_s2: float = 2.3
    ) -> None:
        self._state = start or BodyState()
        self._accel, self._turn_accel = accel_m_s2, turn_accel_rad_s2

    def drive(self, speed_m_s: float, turn_rad_s: float, duration_s: float) -> None:
        """Approach the set-points within the accelerations."""
        now, step, turn_step = self._state, self._accel * duration_s, self._turn_accel * duration_s
        self._move(
            now.speed_m_s + clamp(speed_m_s - now.speed_m_s, -step, step),
            now.turn_rad_s + clamp(turn_rad_s - now.turn_rad_s, -turn_step, turn_step),
            duration_s,
        )

    def coast(self, duration_s: float) -> None:
        """Lose speed to friction."""
        left = math.exp(-duration_s / COAST_S)
        self._move(self._state.speed_m_s * left, self._state.turn_rad_s * left, duration_s)

    def state(self) -> BodyState:
        """Return where it is."""
        return self._state

    def _move(self, speed: float, turn: float, duration_s: float) -> None:
        now = self._state
        middle = now.heading_rad + turn * duration_s / 2
        self._state = BodyState(
            now.x_m + speed * math.cos(middle) * duration_s,
            now.y_m + speed * math.sin(middle) * duration_s,
            wrap(now.heading_rad + turn * duration_s),
            speed,
            turn,
        )


def interpret(message: Any, state: BodyState) -> tuple[float, float] | None:
    """Return the speed and turn rate (ENU) that ArduRover makes of SET_POSITION_TARGET_LOCAL_NED.

    None: silently ignored. Only both-or-nothing pairs of mask bits count; frame 12 and others are not obeyed.
    Positions and headings are not emulated and read as ignored.
    """
    mask, frame = message.type_mask, message.coordinate_frame
    position, velocity = not mask & 0b11, not mask & 0b11000
    acceleration, heading, turn = not mask & 0b11000000, not mask & 1024, not mask & 2048
    if frame not in p.OBEYED_FRAMES or position or acceleration or heading or not (velocity or turn):
        return None
    vx, vy, turn_rate = message.vx, message.vy, -message.yaw_rate
    if not all(map(math.isfinite, (vx, vy) if velocity else ())) or (turn and not math.isfinite(turn_rate)):
        return STAND
    if turn:
        return (math.copysign(math.hypot(vx, vy), vx) if velocity else 0.0), turn_rate
    # A velocity vector alone is driven forwards along it: one that points behind makes the rover turn for ever.
    ahead = -math.atan2(vy, vx)
    if frame in (1, 7):
        ahead = p.heading_from_yaw(math.atan2(vy, vx)) - state.heading_rad
    return math.hypot(vx, vy), clamp(2.0 * wrap(ahead), -2.1, 2.1)
