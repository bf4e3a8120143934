"""What a Create counts: encoders, distance, angle, charge. Metres and seconds in, packet values out."""

from __future__ import annotations

import math

from fullswarm.drivers.create_oi.protocol import Generation

COAST_S = 0.25
"""So long a wheel that was told another direction may still roll in its old one."""

DRIVING_MA, STANDING_MA, CHARGING_MA = -800, -300, 1500


class Wheel:
    """One wheel's encoder. It has one channel: what it counts is up or down by what the motor was told.

    Pushed while it stands it counts up, whichever way. A wheel that has just been told otherwise rolls on a little:
    the motor's electronics know that and keep the old direction while it does.
    """

    def __init__(self) -> None:
        self._direction = self._before = 1.0
        self._turned_s = -math.inf

    def told(self, mm_s: int, now_s: float) -> None:
        """Take a set-point; zero counts up."""
        direction = -1.0 if mm_s < 0 else 1.0
        if direction != self._direction:
            self._before, self._direction, self._turned_s = self._direction, direction, now_s

    def counted(self, rolled_m: float, now_s: float) -> float:
        """Return what the robot takes `rolled_m` for."""
        if rolled_m * self._before > 0.0 and now_s - self._turned_s < COAST_S:
            return rolled_m
        return math.copysign(rolled_m, self._direction)


class Counters:
    """Encoders, and distance and angle since they were last asked for.

    Parameters
    ----------
    encoders
        Where the counts stand at power-on, left and right.
    angle_scale, distance_scale, angle_forgets
        See :class:`~.firmware.Quirks`.
    """

    def __init__(
        self,
        generation: Generation,
        encoders: tuple[int, int] = (0, 0),
        *,
        angle_scale: float = 1.0,
        distance_scale: float = 1.0,
        angle_forgets: bool = False,
    ) -> None:
        self._generation, self._forgets = generation, angle_forgets
        self._angle_scale, self._distance_scale = angle_scale, distance_scale
        self._left, self._right = (float(each) for each in encoders)
        self._wheels = Wheel(), Wheel()
        self._distance_mm = self._angle_deg = 0.0

    def told(self, left_mm_s: int, right_mm_s: int, now_s: float) -> None:
        """Take the wheels' set-points; what was rolled before must have been counted."""
        self._wheels[0].told(left_mm_s, now_s)
        self._wheels[1].told(right_mm_s, now_s)

    def roll(self, left_m: float, right_m: float, now_s: float) -> None:
        """Count what the wheels rolled."""
        left, right = self._wheels[0].counted(left_m, now_s), self._wheels[1].counted(right_m, now_s)
        self._distance_mm += 500.0 * (left + right) * self._distance_scale
        self._angle_deg += math.degrees((right - left) / self._generation.wheel_base_m) * self._angle_scale
        if self._generation.m_per_count is not None:
            self._left += left / self._generation.m_per_count
            self._right += right / self._generation.m_per_count

    def values(self) -> dict[str, int]:
        """Return the packets' values; does not clear distance and angle."""
        return {
            "encoder_left": math.floor(self._left) & 0xFFFF,
            "encoder_right": math.floor(self._right) & 0xFFFF,
            "distance_mm": _saturate(self._distance_mm),
            "angle_deg": _saturate(self._angle_deg),
        }

    def asked(self, distance: bool, angle: bool) -> None:
        """Start those anew that were told; the fraction that was not told is kept, unless the quirk says no."""
        if distance:
            self._distance_mm = math.fmod(self._distance_mm, 1.0)
        if angle:
            self._angle_deg = 0.0 if self._forgets else math.fmod(self._angle_deg, 1.0)


class Battery:
    """Charge over time; charges only while it is let, plugged in and not full."""

    def __init__(self, charge_mah: float = 2200.0, capacity_mah: int = 2696) -> None:
        self.charge_mah, self.capacity_mah = charge_mah, capacity_mah
        self._current_ma = STANDING_MA
        self._plugged = False
        self._stamp_s: float | None = None

    def step(self, now_s: float, plugged: bool, driving: bool) -> None:
        """Go on until `now_s`."""
        passed_s = 0.0 if self._stamp_s is None else now_s - self._stamp_s
        self._stamp_s, self._plugged = now_s, plugged
        full = self.charge_mah >= self.capacity_mah
        self._current_ma = 0 if plugged and full else CHARGING_MA if plugged else DRIVING_MA if driving else STANDING_MA
        charge = self.charge_mah + self._current_ma * passed_s / 3600.0
        self.charge_mah = max(0.0, min(float(self.capacity_mah), charge))

    def values(self) -> dict[str, int]:
        """Return the packets' values."""
        full = self.charge_mah >= self.capacity_mah
        return {
            "charging_state": 0 if not self._plugged else 3 if full else 2,
            "voltage_mv": round(13000 + 3000 * self.charge_mah / self.capacity_mah),
            "current_ma": self._current_ma,
            "temperature_c": 25,
            "charge_mah": round(self.charge_mah),
            "capacity_mah": self.capacity_mah,
        }


def _saturate(value: float) -> int:
    return max(-32768, min(32767, math.trunc(value)))
