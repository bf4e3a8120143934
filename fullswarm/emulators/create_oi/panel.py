"""What a Create shows and sounds: lamps, digits, songs, buttons. For its emulator; the robot's end of the wire."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from fullswarm.drivers.create_oi.protocol import Command, Op

PRESS_S = 1.0 / 6.0
"""How long a button stays pressed that a command presses."""


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
        """Take a command that reaches it in the present mode; anything else is not its business."""
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
