"""What a Create's computer is connected to: encoders, battery, lamps, buttons, songs, sensors. Values of packets out.

Sources of the sensors: Create 2 and Create Open Interface specifications, packets 8, 13, 15, 17, 27 to 31, 45 to 53.
These give the ranges of the signals but no thresholds; those here lie well above the noise that a free sensor shows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from fullswarm.drivers.create_oi.protocol import Command, Generation, Op

COAST_S = 0.25
"""How long a wheel with a new commanded direction may still roll in its old one."""

DRIVING_MA, STANDING_MA, CHARGING_MA = -800, -300, 1500
PRESS_S = 1.0 / 6.0
"""How long a button stays pressed that a command presses."""
FLOOR_SIGNAL, NO_FLOOR_SIGNAL = 2600, 12
"""What a cliff sensor measures over a light floor, and over none; its range is 0 to 4095."""
WALL_NEAR, LIGHT_NEAR = 60, 150
"""From these signals on the wall and the light bumper bits are set."""
VIRTUAL_WALL_BYTE = 162
"""What a virtual wall (force field) sends to the infrared receivers."""
MAX_WALL, MAX_LIGHT = 1023, 4095
_CLIFF_SENSORS = ("left", "front_left", "front_right", "right")
_LIGHT_SENSORS = ("left", "front_left", "centre_left", "centre_right", "front_right", "right")


class Wheel:
    """One wheel's encoder. It has one channel: what it counts is up or down by the motor's commanded direction.

    Pushed while it stands it counts up, whichever way. A wheel with a new direction rolls on a little: the motor's
    electronics keep the old direction while it does.
    """

    def __init__(self) -> None:
        self._direction = self._before = 1.0
        self._turned_s = -math.inf

    def commanded(self, mm_s: int, now_s: float) -> None:
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
    """Encoders, and distance and angle since they were last reported.

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

    def commanded(self, left_mm_s: int, right_mm_s: int, now_s: float) -> None:
        """Take the wheels' set-points; what was rolled before must have been counted."""
        self._wheels[0].commanded(left_mm_s, now_s)
        self._wheels[1].commanded(right_mm_s, now_s)

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

    def reported(self, distance: bool, angle: bool) -> None:
        """Start those anew that were sent; the fraction that was not sent is kept, unless the quirk loses it."""
        if distance:
            self._distance_mm = math.fmod(self._distance_mm, 1.0)
        if angle:
            self._angle_deg = 0.0 if self._forgets else math.fmod(self._angle_deg, 1.0)


class Battery:
    """Charge over time; charges only while it may, plugged in and not full."""

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


@dataclass(slots=True)
class Panel:
    """The state of everything that a person could see or hear, as last commanded."""

    led_bits: int = 0
    power_colour: int = 0  # 0 green to 255 red
    power_intensity: int = 0
    weekday_leds: int = 0
    schedule_leds: int = 0
    digits: str = "    "
    segments: tuple[int, int, int, int] = (0, 0, 0, 0)
    motor_bits: int = 0
    motor_pwm: tuple[int, int, int] = (0, 0, 0)  # main, side, vacuum
    digital_outputs: int = 0  # Create 1
    infrared: int | None = None  # Create 1: last byte sent
    songs: dict[int, bytes] = field(default_factory=dict)
    song: int = 0
    played: list[int] = field(default_factory=list)  # all songs ever played, in order
    held: int = 0  # buttons that a person holds down
    _until_s: float = -math.inf  # the song plays, the commanded buttons are pressed
    _pressed: int = 0
    _pressed_until_s: float = -math.inf

    def obey(self, command: Command, now_s: float) -> None:
        """Take a command that reaches it in the present mode; others are ignored."""
        op, data = command.op, command.data
        if op is Op.SONG:
            self.songs[data[0]] = data[2:]
        elif op is Op.PLAY:
            self._play(data[0], now_s)
        elif op is Op.LEDS:
            self.led_bits, self.power_colour, self.power_intensity = data
        elif op is Op.SCHEDULING_LEDS:
            self.weekday_leds, self.schedule_leds = data
        elif op is Op.DIGIT_LEDS:
            self.digits = data.decode("latin-1")
        elif op is Op.DIGIT_LEDS_RAW:
            self.segments = (data[0], data[1], data[2], data[3])
        elif op is Op.BUTTONS:
            self._pressed, self._pressed_until_s = data[0], now_s + PRESS_S
        elif op is Op.MOTORS:
            self.motor_bits = data[0]
        elif op is Op.MOTORS_PWM:
            self.motor_pwm = (_signed(data[0]), _signed(data[1]), data[2])
        elif op is Op.DIGITAL_OUTPUTS:
            self.digital_outputs = data[0]
        elif op is Op.SEND_IR:
            self.infrared = data[0]

    def values(self, now_s: float) -> dict[str, int]:
        """Return the packets' values."""
        commanded = self._pressed if now_s < self._pressed_until_s else 0
        return {"song": self.song, "playing": int(now_s < self._until_s), "buttons": self.held | commanded}

    def dark(self) -> None:
        """Switch all lamps off, as opcodes 130 and 131 do."""
        self.led_bits = self.power_colour = self.power_intensity = self.weekday_leds = self.schedule_leds = 0
        self.digits, self.segments = "    ", (0, 0, 0, 0)

    def stop(self) -> None:
        """Switch brushes and vacuum off: the mode that let them run is over."""
        self.motor_bits, self.motor_pwm = 0, (0, 0, 0)

    def _play(self, number: int, now_s: float) -> None:
        if number in self.songs and now_s >= self._until_s:
            self.song = number
            self.played.append(number)
            self._until_s = now_s + sum(self.songs[number][1::2]) / 64.0


def _signed(byte: int) -> int:
    return byte - 256 if byte > 128 else byte


@dataclass(slots=True)
class Surroundings:
    """What is around the robot now."""

    wall_signal: int = 0  # 0 to 1023: reflection at its right-hand side
    light_signals: tuple[int, int, int, int, int, int] = (0, 0, 0, 0, 0, 0)  # 0 to 4095, left to right
    infrared: tuple[int, int, int] | None = None  # bytes at the omnidirectional, left, right receiver; None: none
    virtual_wall: bool = False
    dirt: int = 0  # 0 to 255

    def values(self, generation: Generation, cliffs: list[bool]) -> dict[str, int]:
        """Return the packets' values; `cliffs`: where the floor is gone: left, front left, front right, right."""
        nothing = 0 if generation.m_per_count is not None else 255  # a Create 1 sends 255 for no infrared byte
        omni, left, right = self.infrared or (nothing, nothing, nothing)
        if self.virtual_wall and self.infrared is None:
            omni = VIRTUAL_WALL_BYTE if generation.m_per_count is not None else omni
        signals = {f"light_{name}": value for name, value in zip(_LIGHT_SENSORS, self.light_signals, strict=True)}
        return {
            "wall": int(self.wall_signal >= WALL_NEAR),
            "wall_signal": self.wall_signal,
            "virtual_wall": int(self.virtual_wall),
            "dirt": self.dirt,
            "ir_omni": omni,
            "ir_left": left,
            "ir_right": right,
            "light_bumper": sum(1 << bit for bit, each in enumerate(self.light_signals) if each >= LIGHT_NEAR),
            **signals,
            **{f"cliff_{name}": int(gone) for name, gone in zip(_CLIFF_SENSORS, cliffs, strict=True)},
            **{
                f"cliff_{name}_signal": NO_FLOOR_SIGNAL if gone else FLOOR_SIGNAL
                for name, gone in zip(_CLIFF_SENSORS, cliffs, strict=True)
            },
        }
