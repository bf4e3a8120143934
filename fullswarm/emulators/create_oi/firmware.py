"""The robot's end of the Open Interface: bytes and time in, bytes out, over any body. No port, no thread.

What it does with the wheels, the modes and the counters follows the specifications and the defects known of real
robots. Cleaning only drives straight on, and so does docking where there is no Home Base; the schedule and the clock
are ignored.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

from fullswarm.drivers.base import Pose
from fullswarm.drivers.create_oi.protocol import (
    BAUD_CODES,
    CREATE1,
    LONGEST_STREAM,
    MEMBERS,
    PERIOD_S,
    TOP_MM_S,
    Command,
    CommandParser,
    Generation,
    Mode,
    Op,
    encode,
    frame,
    frame_size,
)
from fullswarm.emulators.create_oi.hardware import Battery, Counters, Panel, Surroundings
from fullswarm.emulators.create_oi.home_base import on_base, seek
from fullswarm.simulation.bodies import Body, drive_wheels, wheels_rolled

BANNER = (
    b"\r\n2015-08-24-1648-L   \r\nr3-robot/tags/release-3.5.x-tags/release-3.5.4:6058 CLEAN\r\n\r\n"
    b"bootloader id: 470E 6360 83EB FFFF \r\nassembly: 3.5-lite-batt\r\nrevision: 2\r\nflash version: 10\r\n"
)
"""What a Create 2 prints when it has started."""

BOOT_S = 1.0
SLEEP_S = 300.0
"""So long it stays awake in Passive mode without commands."""
BUFFER = 256
"""Bytes that it keeps while it waits; what comes on top is lost."""
STRAIGHT = (-32768, 32767)
TOP_RADIUS_MM = 2000
OWN_SPEED_MM_S = 200
"""How fast it goes when it cleans or looks for its dock by itself."""

_GOES = 0b111
"""The buttons Clean, Spot and Dock."""
_BY_ITSELF = (Op.SPOT, Op.CLEAN, Op.MAX, Op.DOCK)
_NEED_CONTROL = (
    Op.PLAY, Op.LEDS, Op.SCHEDULING_LEDS, Op.DIGIT_LEDS, Op.DIGIT_LEDS_RAW, Op.MOTORS, Op.MOTORS_PWM,
    Op.DIGITAL_OUTPUTS, Op.SEND_IR,
)  # fmt: skip
WAITS = (Op.WAIT_TIME, Op.WAIT_DISTANCE, Op.WAIT_ANGLE, Op.WAIT_EVENT)

# Event number to (packet, bits) that mean it; 22 is the mode. Source: Create Open Interface, command 158.
_EVENTS: dict[int, tuple[str, int]] = {
    1: ("bumps_drops", 0b11100), 2: ("bumps_drops", 0b10000), 3: ("bumps_drops", 0b01000), 4: ("bumps_drops", 0b00100),
    5: ("bumps_drops", 0b11), 6: ("bumps_drops", 0b10), 7: ("bumps_drops", 0b01), 8: ("virtual_wall", 1),
    9: ("wall", 1), 11: ("cliff_left", 1), 12: ("cliff_front_left", 1), 13: ("cliff_front_right", 1),
    14: ("cliff_right", 1), 15: ("chargers", 0b10), 16: ("buttons", 0b100), 17: ("buttons", 0b001),
    18: ("digital_inputs", 0b0001), 19: ("digital_inputs", 0b0010), 20: ("digital_inputs", 0b0100),
    21: ("digital_inputs", 0b1000),
}  # fmt: skip
_CLIFFS = ("cliff_left", "cliff_front_left", "cliff_front_right", "cliff_right")


@dataclass(frozen=True, slots=True)
class Quirks:
    """Defects of real firmware, to be switched on."""

    mode_offset: int = 0  # some 600s report their mode one too high
    deaf_to_safe: bool = False  # after a long time on the charger 131 and 132 do nothing
    speed_quantum_mm_s: float = 0.0  # a Create 2 rounds wheel speeds to steps of about 28.5
    angle_scale: float = 1.0  # firmware up to 3.4.0 reports 0.324056 of the angle
    distance_scale: float = 1.0  # firmware before 3.3.0 reports a wrong distance
    header_in_sum: bool = True  # False: the checksum as the older documents print it
    angle_forgets: bool = False  # the part of a degree that was not reported is lost


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
        self.cliffs = [False, False, False, False]  # left, front left, front right, right
        self.drops = [False, False]  # left, right
        self.overcurrents = 0
        self.charger = self.dock = False
        self.bases: tuple[Pose, ...] = ()  # of robots that stand on them; none: `dock` is switched by hand
        self.battery, self.panel, self.surroundings = Battery(), Panel(), Surroundings()
        self._body, self._quirks, self._encoders = body, quirks or Quirks(), encoders
        self._parser = CommandParser(generation)
        self._rolled = wheels_rolled(body.state(), generation.wheel_base_m)
        self._frozen: dict[str, int] | None = None
        self._boot_s = -math.inf  # when it will have started
        self._power_on()

    def _power_on(self) -> None:
        generation, quirks = self.generation, self._quirks
        self.mode, self.asleep, self.baud = Mode.OFF, False, generation.baud
        self._counters = Counters(
            generation, self._encoders, angle_scale=quirks.angle_scale, distance_scale=quirks.distance_scale,
            angle_forgets=quirks.angle_forgets,
        )  # fmt: skip
        self._parser.reset()
        self._inbox = bytearray()
        self._script = b""
        self._wait: Wait | None = None
        self._wheels = (0, 0)  # as commanded, mm/s
        self._seeking = False  # drives into its Home Base by itself
        self._buttons = 0  # as pressed at the last step
        self._velocity, self._radius = 0, 0
        self._stream: tuple[int, ...] = ()
        self._streaming = False
        self._due_s = self._awake_s = -math.inf

    @property
    def wheels_mm_s(self) -> tuple[int, int]:
        """Left and right wheel as last commanded."""
        return self._wheels

    @property
    def due_s(self) -> float:
        """When it will next send something by itself."""
        booting = self._boot_s if self._boot_s != -math.inf else math.inf
        streams = self._streaming and self._wait is None and self.mode is not Mode.OFF
        return min(booting, self._due_s if streams else math.inf)

    def reboot(self, now_s: float) -> None:
        """Start anew: the counts too; receives and sends nothing until it has started."""
        self._turn((0, 0), now_s)
        self._power_on()
        self.panel = Panel()
        self._boot_s = now_s + BOOT_S

    def brc(self, now_s: float) -> None:
        """Take a falling edge at the BRC pin: stays awake, or wakes up."""
        self._awake_s = now_s
        if self.asleep:
            self.reboot(now_s)

    def stick(self, stuck: bool, now_s: float) -> None:
        """Repeat the present sensor values from now on, or report true ones again."""
        self._frozen = self._values(now_s) if stuck else None

    def receive(self, data: bytes, now_s: float) -> bytes:
        """Take bytes from the wire; return the answers to queries."""
        if self.asleep or now_s < self._boot_s:
            return b""
        if self._wait is None or len(self._inbox) + len(data) <= BUFFER:  # it reads nothing while it waits
            self._inbox += data
        return self._work(now_s)

    def step(self, now_s: float, budget: int = LONGEST_STREAM + 3) -> bytes:
        """Read the sensors, react, and return the stream frame that is due; longer than `budget` is cut off."""
        out = b""
        if self._boot_s != -math.inf and now_s >= self._boot_s:
            self._boot_s = -math.inf
            out = BANNER if self.generation is not CREATE1 else b""
        self._measure(now_s)
        self._press(now_s)
        if self.bases:
            self.dock = on_base(self._body.state(), self.bases)
        self._seek(now_s)
        self._guard(now_s)
        charges = (self.charger or self.dock) and self.mode in (Mode.OFF, Mode.PASSIVE)
        self.battery.step(now_s, charges, self._wheels != (0, 0))
        if self._wait is not None and self._wait.over(now_s, *self._gone(), self._values(now_s)):
            self._wait = None
        out += self._work(now_s)
        if not self._streaming or self.mode is Mode.OFF or self._wait is not None or now_s < self._due_s:
            return out
        self._due_s += PERIOD_S
        if self._due_s <= now_s:
            self._due_s = now_s + PERIOD_S
        sent = frame(self._stream, self._values(now_s), header_in_sum=self._quirks.header_in_sum)
        self._reported(self._stream)
        return out + sent[:budget]

    # ------------------------------------------------------------ commands
    def _work(self, now_s: float) -> bytes:
        """Read what has arrived, byte by byte, until the end or a wait."""
        answer, taken = b"", 0
        while taken < len(self._inbox) and self._wait is None:
            byte = self._inbox[taken]
            taken += 1
            if self.mode is Mode.OFF:  # ignores all but one byte
                if byte == Op.START:
                    self._enter(Mode.PASSIVE, now_s)
                continue
            command = self._parser.push(byte)
            if command is None:
                continue
            if command.op is Op.PLAY_SCRIPT:
                # The rest waits for the next step: a script that plays itself never ends, but must not hold this loop.
                self._inbox[:taken] = self._script
                return answer
            answer += self._obey(command, now_s)
            if self.asleep or now_s < self._boot_s:
                self._inbox.clear()
                return answer
        del self._inbox[:taken]
        return answer

    def _obey(self, command: Command, now_s: float) -> bytes:
        op, data = command.op, command.data
        in_control = self.mode in (Mode.SAFE, Mode.FULL)
        if op in (Op.QUERY, Op.QUERY_LIST):
            return self._answer(data if op is Op.QUERY else data[1:], now_s)
        if op is Op.SHOW_SCRIPT:
            return bytes([len(self._script)]) + self._script
        if op is Op.STREAM:
            self._start_stream(data[1:], now_s)
        elif op is Op.PAUSE_STREAM:
            self._streaming = bool(data[0]) and bool(self._stream)
        elif op is Op.BAUD:
            self.baud = BAUD_CODES.get(data[0], self.baud)
        elif op is Op.SCRIPT:
            self._script = data[1:]
        elif op in WAITS:
            self._wait = Wait(command, now_s, *self._gone())
        elif op in (Op.DRIVE, Op.DRIVE_DIRECT, Op.DRIVE_PWM):
            if in_control:
                self._drive(op, data, now_s)
        elif op in _NEED_CONTROL or op in (Op.SONG, Op.BUTTONS):
            if in_control or op not in _NEED_CONTROL:
                self.panel.obey(command, now_s)
        else:
            self._change_mode(op, now_s)
        return b""

    def _start_stream(self, ids: bytes, now_s: float) -> None:
        """Stream the packets that it has, as many as the length byte of a frame can count."""
        stream: list[int] = []
        for each in ids:
            if self.generation.has_packet(each) and frame_size([*stream, each]) <= LONGEST_STREAM + 3:
                stream.append(each)
        self._stream, self._streaming, self._due_s = tuple(stream), bool(stream), now_s

    def _change_mode(self, op: Op, now_s: float) -> None:
        if op in (Op.SAFE, Op.CONTROL, Op.FULL):
            if not self._quirks.deaf_to_safe:
                if op is not Op.FULL:
                    self.panel.dark()
                self._enter(Mode.FULL if op is Op.FULL else Mode.SAFE, now_s)
        elif op in (Op.START, Op.POWER, *_BY_ITSELF):
            self._enter(Mode.PASSIVE, now_s)
            self.asleep = op is Op.POWER
            self._seeking = op is Op.DOCK and bool(self.bases)
            if op in _BY_ITSELF:
                self._turn((OWN_SPEED_MM_S, OWN_SPEED_MM_S), now_s)
        elif op is Op.STOP:
            self._enter(Mode.OFF, now_s)
            self._streaming, self._stream = False, ()
        elif op is Op.RESET:
            self.reboot(now_s)

    def _enter(self, mode: Mode, now_s: float) -> None:
        if mode is not self.mode:
            self._awake_s = now_s
        if mode is not self.mode or mode is Mode.PASSIVE:
            self._turn((0, 0), now_s)
        if mode not in (Mode.SAFE, Mode.FULL):
            self.panel.stop()
        self.mode = mode
        if mode is Mode.OFF:
            self._parser.reset()

    def _drive(self, op: Op, data: bytes, now_s: float) -> None:
        first = int.from_bytes(data[:2], "big", signed=True)
        second = int.from_bytes(data[2:], "big", signed=True)
        if op is Op.DRIVE:
            self._velocity = _clip(first)
            self._radius = second if second in STRAIGHT else max(-TOP_RADIUS_MM, min(TOP_RADIUS_MM, second))
            self._turn(self._arc(self._velocity, self._radius), now_s)
        else:
            scale = 1.0 if op is Op.DRIVE_DIRECT else TOP_MM_S / 255.0
            self._turn((_clip(second * scale), _clip(first * scale)), now_s)

    def _arc(self, speed: int, radius: int) -> tuple[int, int]:
        if radius in STRAIGHT or radius == 0:
            return speed, speed
        if abs(radius) == 1:
            return -speed * radius, speed * radius
        half = self.generation.wheel_base_m * 500.0
        return _clip(speed * (radius - half) / radius), _clip(speed * (radius + half) / radius)

    def _turn(self, wheels: tuple[int, int], now_s: float) -> None:
        self._measure(now_s)  # what was rolled until now counts for the old direction
        self._wheels = wheels
        self._counters.commanded(*wheels, now_s)
        step = self._quirks.speed_quantum_mm_s
        left, right = (round(each / step) * step if step else float(each) for each in wheels)
        drive_wheels(self._body, left / 1000.0, right / 1000.0, self.generation.wheel_base_m)

    # ------------------------------------------------------------ sensors
    def _measure(self, now_s: float) -> None:
        rolled = wheels_rolled(self._body.state(), self.generation.wheel_base_m)
        self._counters.roll(rolled[0] - self._rolled[0], rolled[1] - self._rolled[1], now_s)
        self._rolled = rolled

    def _gone(self) -> tuple[float, float]:
        """Return how far the robot has rolled in mm and turned in degrees since ever."""
        left, right = self._rolled
        return 500.0 * (left + right), math.degrees((right - left) / self.generation.wheel_base_m)

    def _guard(self, now_s: float) -> None:
        """Leave Safe mode where the robot does so by itself, and fall asleep; a bump is no reason."""
        if self.mode is Mode.PASSIVE:
            if self._wheels != (0, 0) or self.charger or self.dock:
                self._awake_s = now_s
            if self._wheels != (0, 0) and (self.dock or any(self.drops)):
                self._turn((0, 0), now_s)
            self.asleep |= now_s - self._awake_s > SLEEP_S
            self._streaming &= not self.asleep
            return
        if self.mode is not Mode.SAFE:
            return
        left, right = self._wheels
        backwards_in_place = left + right < 0 and self._turn_radius_m() < self.generation.radius_m
        cliff = any(self.cliffs) and (left + right > 0 or backwards_in_place)
        if cliff or any(self.drops) or self.charger:
            self._enter(Mode.PASSIVE, now_s)

    def _press(self, now_s: float) -> None:
        """Clean, Spot and Dock, pressed by hand or by command, set it going in Passive mode, or stop it again."""
        pressed = self.panel.values(now_s)["buttons"]
        fresh, self._buttons = pressed & ~self._buttons, pressed
        if self.mode is Mode.PASSIVE and self.generation is not CREATE1 and fresh & _GOES:
            stands = self._wheels == (0, 0)
            self._turn((OWN_SPEED_MM_S, OWN_SPEED_MM_S) if stands else (0, 0), now_s)
            self._awake_s = now_s

    def _seek(self, now_s: float) -> None:
        """Drive into the Home Base, if it was asked for and is somewhere."""
        self._seeking = self._seeking and self.mode is Mode.PASSIVE and not self.dock and self._wheels != (0, 0)
        if self._seeking:
            speed_m_s, turn_rad_s = seek(self._body.state(), self.bases)
            half = turn_rad_s * self.generation.wheel_base_m / 2.0
            self._turn((round(1000.0 * (speed_m_s - half)), round(1000.0 * (speed_m_s + half))), now_s)

    def _turn_radius_m(self) -> float:
        left, right = self._wheels
        if left == right:
            return math.inf
        return abs(self.generation.wheel_base_m / 2.0 * (left + right) / (right - left))

    def _answer(self, ids: bytes, now_s: float) -> bytes:
        self._measure(now_s)
        known = [each for each in ids if self.generation.has_packet(each)]
        answer = encode(known, self._values(now_s))
        self._reported(known)
        return answer

    def _reported(self, ids: tuple[int, ...] | list[int]) -> None:
        sent = {packet.id for each in ids for packet in MEMBERS[each]}
        self._counters.reported(19 in sent, 20 in sent)

    def _values(self, now_s: float) -> dict[str, int]:
        if self._frozen is not None:
            return self._frozen
        bump_left, bump_right = self._body.state().bumps
        drop_left, drop_right = self.drops
        return {
            "bumps_drops": bump_right | bump_left << 1 | drop_right << 2 | drop_left << 3,
            "overcurrents": self.overcurrents,
            "chargers": self.charger | self.dock << 1,
            "mode": self.mode + self._quirks.mode_offset,
            "stream_count": len(self._stream),
            "velocity_mm_s": self._velocity,
            "radius_mm": self._radius,
            "right_mm_s": self._wheels[1],
            "left_mm_s": self._wheels[0],
            "stasis": int(self._wheels != (0, 0)),
            **self.surroundings.values(self.generation, self.cliffs),
            **self.battery.values(),
            **self.panel.values(now_s),
            **self._counters.values(),
        }


def _clip(speed: float) -> int:
    return max(-TOP_MM_S, min(TOP_MM_S, round(speed)))


# ---------------------------------------------------------------- waits of a Create 1
def happens(event: int, values: Mapping[str, int]) -> bool:
    """Return whether an event of command 158 is there; 256 - n is the opposite of n. An unknown one always is."""
    if event > 128:
        return not happens(256 - event, values)
    if event == 10:
        return any(values.get(each, 0) for each in _CLIFFS)
    if event == 22:
        return values.get("mode", 0) == Mode.PASSIVE
    packet, bits = _EVENTS.get(event, ("", 0))
    return not packet or bool(values.get(packet, 0) & bits)


class Wait:
    """One wait that is under way.

    Parameters
    ----------
    way_mm, angle_deg
        What the robot had driven and turned in all when the wait began.
    """

    def __init__(self, command: Command, now_s: float, way_mm: float, angle_deg: float) -> None:
        self._op, self._began_s = command.op, now_s
        self._way_mm, self._angle_deg = way_mm, angle_deg
        self._amount = int.from_bytes(command.data, "big", signed=command.op in (Op.WAIT_DISTANCE, Op.WAIT_ANGLE))

    def over(self, now_s: float, way_mm: float, angle_deg: float, values: Mapping[str, int]) -> bool:
        """Return whether it has happened."""
        if self._op is Op.WAIT_TIME:
            return now_s - self._began_s >= self._amount / 10.0
        if self._op is Op.WAIT_EVENT:
            return happens(self._amount, values)
        gone = way_mm - self._way_mm if self._op is Op.WAIT_DISTANCE else angle_deg - self._angle_deg
        return gone >= self._amount if self._amount >= 0 else gone <= self._amount
