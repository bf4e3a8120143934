"""The robot's end of the Open Interface: bytes and time in, bytes out, over any body. No port, no thread.

What it does with the wheels, the modes and the counters follows the specifications and the defects known of real
robots; what is not modelled (scripts and waits of the Create 1, LEDs, brushes) is parsed and has no effect.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

from fullswarm.drivers.create_oi.packets import LONGEST_STREAM, encode, frame
from fullswarm.drivers.create_oi.protocol import (
    PERIOD_S,
    TOP_MM_S,
    Command,
    CommandParser,
    Generation,
    Mode,
    Op,
)

BANNER = b"bl-start\r\nr3-robot/tags/release-3.5.x:6058 CLEAN\r\n"
"""What a Create 2 prints after a reset (shortened)."""

STRAIGHT = (-32768, 32767)
OWN_SPEED_MM_S = 200
"""How fast it goes when it cleans or looks for its dock by itself."""


class Body(Protocol):
    """What carries the wheels and the bumper: a kinematic toy or a body of the simulated world."""

    def set_wheels(self, left_m_s: float, right_m_s: float) -> None:
        """Turn the wheels from now on."""
        ...

    def travelled(self) -> tuple[float, float]:
        """Return how far the left and right wheel have rolled since the start, metres, backwards negative."""
        ...

    def bumped(self) -> tuple[bool, bool]:
        """Tell whether the left and the right half of the bumper are pressed."""
        ...


@dataclass(frozen=True, slots=True)
class Quirks:
    """Defects of real firmware, to be switched on."""

    mode_offset: int = 0  # some 600s report their mode one too high
    deaf_to_safe: bool = False  # after a long time on the charger 131 and 132 do nothing
    speed_quantum_mm_s: float = 0.0  # a Create 2 rounds wheel speeds to steps of about 28.5
    angle_scale: float = 1.0  # firmware up to 3.4.0 reports 0.324056 of the angle
    header_in_sum: bool = True  # False: the checksum as the older documents print it
    angle_forgets: bool = False  # the part of a degree that was not reported is lost


class Counters:
    """Encoders, distance and angle. The encoders have one channel: they cannot tell which way a wheel rolls."""

    def __init__(self, generation: Generation, quirks: Quirks, encoders: tuple[int, int]) -> None:
        self._generation, self._quirks = generation, quirks
        self._left, self._right = (float(each) for each in encoders)
        self._distance_mm = self._angle_deg = 0.0

    def roll(self, left_m: float, right_m: float, wheels: tuple[int, int]) -> None:
        """Count what the wheels rolled while they were told `wheels`: the command decides the sign, 0 is up."""
        left = math.copysign(left_m, -1.0 if wheels[0] < 0 else 1.0)
        right = math.copysign(right_m, -1.0 if wheels[1] < 0 else 1.0)
        self._distance_mm += 500.0 * (left + right)
        self._angle_deg += math.degrees((right - left) / self._generation.wheel_base_m)
        if self._generation.m_per_count is not None:
            self._left += left / self._generation.m_per_count
            self._right += right / self._generation.m_per_count

    def values(self) -> dict[str, int]:
        """Return the packets' values; does not clear distance and angle."""
        return {
            "encoder_left": math.floor(self._left) & 0xFFFF,
            "encoder_right": math.floor(self._right) & 0xFFFF,
            "distance_mm": _saturate(self._distance_mm),
            "angle_deg": _saturate(self._angle_deg * self._quirks.angle_scale),
        }

    def asked(self) -> None:
        """Start distance and angle anew; the fraction that was not told is kept, unless the quirk says no."""
        self._distance_mm = math.fmod(self._distance_mm, 1.0)
        scaled = self._angle_deg * self._quirks.angle_scale
        rest = math.fmod(scaled, 1.0) / self._quirks.angle_scale
        self._angle_deg = 0.0 if self._quirks.angle_forgets else rest


def _saturate(value: float) -> int:
    return max(-32768, min(32767, math.trunc(value)))


class Firmware:
    """One robot's firmware. Its public fields are the switches of the outside world.

    Parameters
    ----------
    encoders
        Where the counts stand at power-on, left and right.
    """

    def __init__(
        self,
        generation: Generation,
        body: Body,
        *,
        quirks: Quirks | None = None,
        encoders: tuple[int, int] = (0, 0),
    ) -> None:
        self.generation = generation
        self.mode = Mode.OFF
        self.cliffs = [False, False, False, False]  # left, front left, front right, right
        self.drops = [False, False]  # left, right
        self.overcurrents = 0
        self.charger = False
        self.charge_mah, self.capacity_mah = 2200, 2696
        self.songs: dict[int, bytes] = {}
        self._body, self._quirks = body, quirks or Quirks()
        self._counters = Counters(generation, self._quirks, encoders)
        self._parser = CommandParser(generation)
        self._rolled = body.travelled()
        self._wheels = (0, 0)  # as told, mm/s
        self._velocity, self._radius = 0, 0
        self._stream: tuple[int, ...] = ()
        self._streaming = False
        self._due_s = 0.0

    @property
    def wheels_mm_s(self) -> tuple[int, int]:
        """Left and right wheel as last told."""
        return self._wheels

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes from the wire; return the answers to queries."""
        answer = b""
        for byte in data:
            if self.mode is Mode.OFF:  # deaf, but for one byte
                if byte == Op.START:
                    self._enter(Mode.PASSIVE)
                continue
            command = self._parser.push(byte)
            if command is not None:
                answer += self._obey(command, now_s)
        return answer

    def step(self, now_s: float, budget: int = LONGEST_STREAM + 3) -> bytes:
        """Look at the world, react, and return the stream frame that is due; longer than `budget` is cut off."""
        self._measure()
        self._guard()
        if not self._streaming or self.mode is Mode.OFF or now_s < self._due_s:
            return b""
        self._due_s += PERIOD_S
        if self._due_s <= now_s:
            self._due_s = now_s + PERIOD_S
        told = frame(self._stream, self._values(), header_in_sum=self._quirks.header_in_sum)
        self._counters.asked()
        return told[:budget]

    # ------------------------------------------------------------ commands
    def _obey(self, command: Command, now_s: float) -> bytes:
        op, data = command.op, command.data
        if op in (Op.QUERY, Op.QUERY_LIST):
            return self._answer(data if op is Op.QUERY else data[1:])
        if op is Op.STREAM:
            self._stream = tuple(each for each in data[1:] if self.generation.has_packet(each))
            self._streaming, self._due_s = bool(self._stream), now_s
        elif op is Op.PAUSE_STREAM:
            self._streaming = bool(data[0]) and bool(self._stream)
        elif op is Op.SONG:
            self.songs[data[0]] = data[2:]
        elif op in (Op.DRIVE, Op.DRIVE_DIRECT, Op.DRIVE_PWM):
            if self.mode in (Mode.SAFE, Mode.FULL):
                self._drive(op, data)
        else:
            return self._change_mode(op)
        return b""

    def _change_mode(self, op: Op) -> bytes:
        if op in (Op.SAFE, Op.CONTROL, Op.FULL):
            if not self._quirks.deaf_to_safe:
                self._enter(Mode.FULL if op is Op.FULL else Mode.SAFE)
        elif op in (Op.START, Op.POWER, Op.SPOT, Op.CLEAN, Op.MAX, Op.DOCK):
            self._enter(Mode.PASSIVE)
            if op in (Op.SPOT, Op.CLEAN, Op.MAX, Op.DOCK):
                self._turn((OWN_SPEED_MM_S, OWN_SPEED_MM_S))
        elif op in (Op.STOP, Op.RESET):
            self._enter(Mode.OFF)
            self._streaming, self._stream = False, ()
            return BANNER if op is Op.RESET else b""
        return b""

    def _enter(self, mode: Mode) -> None:
        if mode is not self.mode or mode is Mode.PASSIVE:
            self._turn((0, 0))
        self.mode = mode
        if mode is Mode.OFF:
            self._parser.reset()

    def _drive(self, op: Op, data: bytes) -> None:
        first = int.from_bytes(data[:2], "big", signed=True)
        second = int.from_bytes(data[2:], "big", signed=True)
        if op is Op.DRIVE:
            self._velocity, self._radius = first, second
            self._turn(self._arc(max(-TOP_MM_S, min(TOP_MM_S, first)), second))
        else:
            scale = 1.0 if op is Op.DRIVE_DIRECT else TOP_MM_S / 255.0
            self._turn((_clip(second * scale), _clip(first * scale)))

    def _arc(self, speed: int, radius: int) -> tuple[int, int]:
        if radius in STRAIGHT or radius == 0:
            return speed, speed
        if abs(radius) == 1:
            return -speed * radius, speed * radius
        half = self.generation.wheel_base_m * 500.0
        return _clip(speed * (radius - half) / radius), _clip(speed * (radius + half) / radius)

    def _turn(self, wheels: tuple[int, int]) -> None:
        self._measure()  # what was rolled until now counts for the old direction
        self._wheels = wheels
        step = self._quirks.speed_quantum_mm_s
        left, right = (round(each / step) * step if step else float(each) for each in wheels)
        self._body.set_wheels(left / 1000.0, right / 1000.0)

    # ------------------------------------------------------------ sensors
    def _measure(self) -> None:
        rolled = self._body.travelled()
        self._counters.roll(rolled[0] - self._rolled[0], rolled[1] - self._rolled[1], self._wheels)
        self._rolled = rolled

    def _guard(self) -> None:
        """Leave Safe mode where the robot does so by itself; a bump is no reason."""
        if self.mode is not Mode.SAFE:
            return
        left, right = self._wheels
        backwards_in_place = left + right < 0 and self._turn_radius_m() < self.generation.radius_m
        cliff = any(self.cliffs) and (left + right > 0 or backwards_in_place)
        if cliff or any(self.drops) or self.charger:
            self._enter(Mode.PASSIVE)

    def _turn_radius_m(self) -> float:
        left, right = self._wheels
        if left == right:
            return math.inf
        return abs(self.generation.wheel_base_m / 2.0 * (left + right) / (right - left))

    def _answer(self, ids: bytes) -> bytes:
        self._measure()
        known = [each for each in ids if self.generation.has_packet(each)]
        answer = encode(known, self._values())
        self._counters.asked()
        return answer

    def _values(self) -> dict[str, int]:
        bump_left, bump_right = self._body.bumped()
        drop_left, drop_right = self.drops
        left, front_left, front_right, right = (int(each) for each in self.cliffs)
        return {
            "bumps_drops": bump_right | bump_left << 1 | drop_right << 2 | drop_left << 3,
            "cliff_left": left,
            "cliff_front_left": front_left,
            "cliff_front_right": front_right,
            "cliff_right": right,
            "overcurrents": self.overcurrents,
            "ir_omni": 0 if self.generation.m_per_count is not None else 255,
            "charging_state": 2 if self.charger else 0,
            "chargers": int(self.charger),
            "voltage_mv": 15000,
            "current_ma": 500 if self.charger else -300,
            "temperature_c": 25,
            "charge_mah": self.charge_mah,
            "capacity_mah": self.capacity_mah,
            "mode": self.mode + self._quirks.mode_offset,
            "stream_count": len(self._stream),
            "velocity_mm_s": self._velocity,
            "radius_mm": self._radius,
            "right_mm_s": self._wheels[1],
            "left_mm_s": self._wheels[0],
            "stasis": int(self._wheels != (0, 0)),
            **self._counters.values(),
        }


def _clip(speed: float) -> int:
    return max(-TOP_MM_S, min(TOP_MM_S, round(speed)))
