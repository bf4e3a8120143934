"""What a session asks of a Create and makes of the answers: the stream's list, hazards, what bars Safe mode, power."""

from __future__ import annotations

import enum
import math
import re
from dataclasses import dataclass

from fullswarm.drivers.base import Hazard, Twist
from fullswarm.drivers.create_oi.protocol import TOP_MM_S, Generation, Sensors, frame_size
from fullswarm.reasons import NONE, Code, Reason, given

HOLD_S = 0.2
"""A hazard is reported at least this long: a reader at 10 Hz must not miss a blip of one frame."""
LOW_BATTERY = 0.1

_WANTED_IDS = (35, 7, 9, 10, 11, 12, 14, 34, 41, 42, 25, 26, 21, 22, 23, 24)
_VERSION = re.compile(rb"release-(?:stm32-)?(\d+\.\d+\.\d+)")
_STARTED = b"flash version"  # the last line of what a robot prints when it has started
_TEXT_BYTES = 1024


def stream_ids(generation: Generation, baud: int) -> tuple[int, ...]:
    """Choose what to stream: odometry and safety always, the rest while it fits into 15 ms at this rate."""
    ids = [43, 44] if generation.m_per_count is not None else [19, 20]
    for number in _WANTED_IDS:
        if frame_size([*ids, number]) <= generation.budget(baud):
            ids.append(number)
    return tuple(ids)


def wheel_speeds(twist: Twist, wheel_base_m: float, step_mm_s: float = 0.0) -> tuple[int, int]:
    """Return left and right wheel in whole mm/s, both scaled alike to ±500 so that the curvature stays.

    `step_mm_s`: round to multiples of it, as some firmware does.

    Raises
    ------
    ValueError
        The twist is not finite.
    """
    if not (math.isfinite(twist.linear_m_s) and math.isfinite(twist.angular_rad_s)):
        raise ValueError(f"not a velocity: {twist.linear_m_s} m/s, {twist.angular_rad_s} rad/s")
    # Half speeds: the sum of two huge but finite numbers must not overflow.
    forward, turn = twist.linear_m_s / 2.0, twist.angular_rad_s * wheel_base_m / 4.0
    left, right = forward - turn, forward + turn
    top_mm_s = TOP_MM_S // step_mm_s * step_mm_s if step_mm_s else TOP_MM_S
    per_half_m_s = min(2000.0, top_mm_s / max(abs(left), abs(right), 1e-3))
    left, right = left * per_half_m_s, right * per_half_m_s
    if step_mm_s:
        left, right = round(left / step_mm_s) * step_mm_s, round(right / step_mm_s) * step_mm_s
    return round(left), round(right)


class Charging(enum.IntEnum):
    """Packet 21."""

    NO = 0
    RECONDITIONING = 1
    FULL = 2  # charging at full current
    TRICKLE = 3
    WAITING = 4
    FAULT = 5


@dataclass(frozen=True, slots=True)
class Power:
    """A Create's battery; None where its stream has no room for it."""

    charging: Charging | None
    on_charger: bool
    on_dock: bool
    voltage_v: float | None
    current_a: float | None  # negative: discharging
    temperature_c: int | None
    charge_ah: float | None
    capacity_ah: float | None


def power(sensors: Sensors) -> Power:
    """Read the battery from one frame."""
    state, chargers = sensors.charging_state, sensors.chargers or 0
    return Power(
        Charging(state) if state is not None and state <= Charging.FAULT else None,
        bool(chargers & 1),
        bool(chargers & 2),
        _thousandth(sensors.voltage_mv),
        _thousandth(sensors.current_ma),
        sensors.temperature_c,
        _thousandth(sensors.charge_mah),
        _thousandth(sensors.capacity_mah),
    )


def charges(sensors: Sensors) -> bool | None:
    """Tell whether current flows into the battery; None where the stream has no room for that."""
    if sensors.charging_state is None:
        return None
    return sensors.charging_state in (Charging.RECONDITIONING, Charging.FULL, Charging.TRICKLE)


def _thousandth(value: int | None) -> float | None:
    return None if value is None else value / 1000.0


class Senses:
    """Hazards, each held for a while, and what would make the robot leave Safe mode by itself."""

    def __init__(self) -> None:
        self._seen: dict[Hazard, float] = {}
        self._now_s = -math.inf
        self._charger = False

    def note(self, sensors: Sensors, now_s: float) -> None:
        """Take one frame in."""
        self._now_s, self._charger = now_s, bool((sensors.chargers or 0) & 1)
        if sensors.bumps_drops:
            if sensors.bump_left or sensors.bump_right:
                self._seen[Hazard.BUMP] = now_s
            if sensors.wheel_drop:
                self._seen[Hazard.WHEEL_DROP] = now_s
        if sensors.cliff:
            self._seen[Hazard.CLIFF] = now_s
        if sensors.wheel_overcurrent:
            self._seen[Hazard.OVERCURRENT] = now_s
        if (charge := sensors.battery) is not None and charge < LOW_BATTERY:
            self._seen[Hazard.BATTERY_LOW] = now_s

    @property
    def hazards(self) -> Hazard:
        """What is wrong now or was so within the last `HOLD_S`."""
        hazards = Hazard.NONE
        for hazard, seen_s in self._seen.items():
            if self._now_s - seen_s <= HOLD_S:
                hazards |= hazard
        return hazards

    @property
    def cause(self) -> Reason:
        """What would make the robot leave Safe mode at once; false when nothing would."""
        hazards = self.hazards
        if Hazard.WHEEL_DROP in hazards:
            return given("a wheel hangs", Code.WHEEL_DROP)
        if Hazard.CLIFF in hazards:
            return given("a cliff sensor sees no floor", Code.CLIFF)
        return given("the charger is plugged in", Code.CHARGER) if self._charger else NONE


class Banner:
    """Finds the firmware's version in what a robot prints when it starts."""

    def __init__(self) -> None:
        self.version = ""
        self._text = b""

    def feed(self, data: bytes) -> bool:
        """Take bytes that are in no frame; return whether they end the text of a robot that has just started."""
        self._text = (self._text + data)[-_TEXT_BYTES:]
        if found := _VERSION.findall(self._text):
            self.version = found[-1].decode()
        if _STARTED not in self._text:
            return False
        self._text = b""
        return True
