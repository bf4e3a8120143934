"""The lamps, the display and the speaker of a Create as actuators: what was asked for, as commands that may wait.

The robot takes them in Safe mode, and switches its lamps off when it enters it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from fullswarm.drivers import actuators as declare
from fullswarm.drivers.actuators import Actuator, ActuatorValue
from fullswarm.drivers.create_oi import protocol
from fullswarm.drivers.create_oi.protocol import CREATE1, Generation

GAP_S = 0.05
"""Between two commands: the longest, a song of 37 bytes, has left after 19 ms at 19200 baud."""
SONG = 0
"""The song that is overwritten."""
LONGEST_S = 255 / 64
LAMPS = {"led_debris": 1, "led_spot": 2, "led_dock": 4, "led_check": 8}
LAMPS_CREATE1 = {"led_play": 2, "led_advance": 8}


def actuators(generation: Generation) -> tuple[Actuator, ...]:
    """Return what a generation has beside wheels.

    Seeking the dock is motion that the robot chooses by itself, past the safety filter, so it is none of them.
    """
    first = generation is CREATE1
    lamps = tuple(declare.flag(name, "a lamp") for name in (LAMPS_CREATE1 if first else LAMPS))
    display = () if first else (declare.text("display", 4, "four characters"),)
    return (
        *lamps,
        declare.number("power_colour", 0.0, 1.0, "", "of the power lamp, 0 green to 1 red"),
        declare.number("power_light", 0.0, 1.0, "", "brightness of the power lamp"),
        *display,
        declare.pairs("song", ((0, 127), (0, LONGEST_S)), ("MIDI note, 0 a rest, from 31", "s"), 16, "notes to play"),
    )


@dataclass(slots=True)
class Panel:
    """What was asked for since the robot entered Safe mode, and what of it has yet to be sent."""

    bits: int = 0
    colour: int = 0
    light: int = 0
    text: str = ""
    notes: tuple[tuple[int, int], ...] = ()
    _waiting: dict[str, bytes] = field(default_factory=dict)  # the newest of each kind, the oldest kind first
    _next_s: float = -math.inf
    _silent_s: float = -math.inf  # when the song ends: until then the robot ignores another one

    def reset(self) -> None:
        """Forget everything: Safe mode is over, or about to begin."""
        self.bits = self.colour = self.light = 0
        self.text, self.notes = "", ()
        self._waiting.clear()

    def put(self, name: str, value: ActuatorValue) -> None:
        """Ask for a state; ``ValueError`` if the robot cannot have it."""
        if name == "song":
            self._put_song(value)
        elif name == "display":
            if value != self.text:
                self._waiting["display"] = protocol.digit_leds(str(value).upper().ljust(4))
                self.text = str(value)
        else:
            self._put_lamp(name, value)

    def _put_lamp(self, name: str, value: ActuatorValue) -> None:
        before = self.bits, self.colour, self.light
        bit = (LAMPS | LAMPS_CREATE1).get(name)
        if bit is not None:
            self.bits = self.bits | bit if value else self.bits & ~bit
        elif isinstance(value, int | float):
            level = round(255 * value)
            if name == "power_colour":
                self.colour = level
            else:
                self.light = level
        if (self.bits, self.colour, self.light) != before:
            self._waiting["lamps"] = protocol.leds(self.bits, self.colour, self.light)

    def _put_song(self, value: ActuatorValue) -> None:
        notes = tuple((round(a), round(64.0 * b)) for a, b in value) if isinstance(value, tuple) else ()
        if notes == self.notes:
            return
        if notes:
            self._waiting["song"] = protocol.song(SONG, notes) + protocol.play(SONG)
        else:
            self._waiting.pop("song", None)
        self.notes = notes

    def next(self, now_s: float) -> bytes | None:
        """Return the next command, if one is due."""
        if now_s < self._next_s:
            return None
        for kind in self._waiting:
            if kind != "song" or now_s >= self._silent_s:
                self._next_s = now_s + GAP_S
                if kind == "song":
                    self._silent_s = now_s + sum(length for _, length in self.notes) / 64.0
                return self._waiting.pop(kind)
        return None
