"""The Open Interface, bytes only: generations, modes, commands to a Create, and the sensor packets that it streams.

Source: iRobot Create, Roomba 500 and Create 2 Open Interface specifications. Integers go high byte first, two's
complement. Encoders of commands raise ``ValueError`` for what the robot would not understand; decoders never raise.
"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

HEADER = 19
LONGEST_STREAM = 255
"""Bytes between the length and the checksum of a frame: the length is one byte."""


@dataclass(frozen=True, slots=True)
class Packet:
    """One row of the packet table; `name` is a field of :class:`Sensors`."""

    id: int
    name: str
    size: int
    signed: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Sensors:
    """The raw values of the packets that arrived; None for those that did not."""

    bumps_drops: int | None = None  # b0 bump right, b1 bump left, b2 drop right, b3 drop left, b4 caster (Create 1)
    wall: int | None = None
    cliff_left: int | None = None
    cliff_front_left: int | None = None
    cliff_front_right: int | None = None
    cliff_right: int | None = None
    virtual_wall: int | None = None
    overcurrents: int | None = None  # b0 side, b2 main, b3 right wheel, b4 left wheel
    dirt: int | None = None
    spare: int | None = None
    ir_omni: int | None = None
    buttons: int | None = None
    distance_mm: int | None = None  # since the last request, as the angle
    angle_deg: int | None = None
    charging_state: int | None = None
    voltage_mv: int | None = None
    current_ma: int | None = None
    temperature_c: int | None = None
    charge_mah: int | None = None
    capacity_mah: int | None = None
    wall_signal: int | None = None
    cliff_left_signal: int | None = None
    cliff_front_left_signal: int | None = None
    cliff_front_right_signal: int | None = None
    cliff_right_signal: int | None = None
    digital_inputs: int | None = None  # Create 1
    analog_input: int | None = None  # Create 1
    chargers: int | None = None  # b0 internal, b1 home base
    mode: int | None = None
    song: int | None = None
    playing: int | None = None
    stream_count: int | None = None
    velocity_mm_s: int | None = None  # 39 to 42: as last requested
    radius_mm: int | None = None
    right_mm_s: int | None = None
    left_mm_s: int | None = None
    encoder_left: int | None = None
    encoder_right: int | None = None
    light_bumper: int | None = None  # b0 left ... b5 right
    light_left: int | None = None
    light_front_left: int | None = None
    light_centre_left: int | None = None
    light_centre_right: int | None = None
    light_front_right: int | None = None
    light_right: int | None = None
    ir_left: int | None = None
    ir_right: int | None = None
    left_wheel_ma: int | None = None
    right_wheel_ma: int | None = None
    main_brush_ma: int | None = None
    side_brush_ma: int | None = None
    stasis: int | None = None  # b0 moving, b1 disabled

    @property
    def bump_left(self) -> bool:
        """The left half of the bumper is pressed."""
        return bool((self.bumps_drops or 0) & 0b10)

    @property
    def bump_right(self) -> bool:
        """The right half of the bumper is pressed."""
        return bool((self.bumps_drops or 0) & 0b01)

    @property
    def wheel_drop(self) -> bool:
        """A wheel or the caster hangs."""
        return bool((self.bumps_drops or 0) & 0b11100)

    @property
    def cliff(self) -> bool:
        """One of the four cliff sensors sees no floor."""
        return bool(self.cliff_left or self.cliff_front_left or self.cliff_front_right or self.cliff_right)

    @property
    def wheel_overcurrent(self) -> bool:
        """A wheel motor draws too much."""
        return bool((self.overcurrents or 0) & 0b11000)

    @property
    def battery(self) -> float | None:
        """Charge over capacity in [0, 1]; None when unknown."""
        if self.charge_mah is None or not self.capacity_mah:
            return None
        return min(self.charge_mah / self.capacity_mah, 1.0)


_SIGNED = {19, 20, 23, 24, 39, 40, 41, 42, 54, 55, 56, 57}
_TWO_BYTES = {19, 20, 22, 23, 25, 26, *range(27, 32), 33, *range(39, 45), *range(46, 52), *range(54, 58)}
PACKETS: dict[int, Packet] = {
    number: Packet(number, name, 2 if number in _TWO_BYTES else 1, number in _SIGNED)
    for number, name in enumerate(Sensors.__dataclass_fields__, start=7)
}
"""Packets 7 to 58 by id. Encoders count as unsigned here: only their differences mean anything."""

_GROUPS = {
    0: range(7, 27), 1: range(7, 17), 2: range(17, 21), 3: range(21, 27), 4: range(27, 35), 5: range(35, 43),
    6: range(7, 43), 100: range(7, 59), 101: range(43, 59), 106: range(46, 52), 107: range(54, 59),
}  # fmt: skip
MEMBERS: dict[int, tuple[Packet, ...]] = {
    **{number: (packet,) for number, packet in PACKETS.items()},
    **{group: tuple(PACKETS[number] for number in numbers) for group, numbers in _GROUPS.items()},
}
"""The packets that an id stands for: itself, or the members of a group in their order."""

SIZES: dict[int, int] = {number: sum(packet.size for packet in packets) for number, packets in MEMBERS.items()}
"""Data bytes of each packet or group id."""


def decode(ids: Sequence[int], data: bytes) -> Sensors | None:
    """Read the raw answer to a query (142, 149) of `ids`; None for an unknown id or a wrong length."""
    values: dict[str, int] = {}
    place = 0
    for number in ids:
        for packet in MEMBERS.get(number, ()):
            raw = data[place : place + packet.size]
            values[packet.name] = int.from_bytes(raw, "big", signed=packet.signed)
            place += packet.size
        if number not in MEMBERS:
            return None
    return Sensors(**values) if place == len(data) else None


def encode(ids: Iterable[int], values: Mapping[str, int]) -> bytes:
    """Write the raw answer to a query of `ids`; what `values` lacks is zero. For emulators and tests.

    Raises
    ------
    ValueError
        An unknown id, or a value that its packet cannot hold.
    """
    answer = bytearray()
    for number in ids:
        if number not in MEMBERS:
            raise ValueError(f"there is no packet {number}")
        for packet in MEMBERS[number]:
            value = values.get(packet.name, 0)
            try:
                answer += value.to_bytes(packet.size, "big", signed=packet.signed)
            except OverflowError as error:
                raise ValueError(f"packet {packet.id} ({packet.name}) cannot hold {value}") from error
    return bytes(answer)


def frame(ids: Sequence[int], values: Mapping[str, int], *, header_in_sum: bool = True) -> bytes:
    """Write one stream frame. Raises ``ValueError`` as :func:`encode`, or when it would be too long."""
    body = b"".join(bytes([number]) + encode([number], values) for number in ids)
    if len(body) > LONGEST_STREAM:
        raise ValueError(f"{len(body)} bytes do not fit into one frame ({LONGEST_STREAM} at most)")
    start = bytes([HEADER, len(body)]) + body
    return start + bytes([-sum(start if header_in_sum else start[1:]) & 0xFF])


def frame_size(ids: Iterable[int]) -> int:
    """Return the bytes of a whole frame with `ids`. Raises ``KeyError`` for an unknown id."""
    return 3 + sum(1 + SIZES[number] for number in ids)


def encoder_delta(new: int, old: int) -> int:
    """Counts from `old` to `new` over the 16-bit wrap, in [-32768, 32767]."""
    return ((new - old + 0x8000) & 0xFFFF) - 0x8000


@dataclass(frozen=True, slots=True)
class Frame:
    """One good frame of the stream."""

    ids: tuple[int, ...]
    sensors: Sensors


class StreamParser:
    """Finds frames in a stream of bytes, whatever else is in it; never raises.

    Parameters
    ----------
    expected
        The ids that were asked for. Given, only frames of exactly these ids count: an 8-bit checksum alone
        lets one false frame in 256 through.
    both_checksums
        Accept the sum without the header as well (Create 1 and Roomba 500 documents print it so).
    """

    def __init__(self, expected: Sequence[int] | None = None, *, both_checksums: bool = False) -> None:
        self._expected = None if expected is None else tuple(expected)
        self._both = both_checksums
        self._buffer = bytearray()
        self.skipped = 0  # bytes that were in no good frame

    def reset(self) -> None:
        """Forget a frame begun."""
        self._buffer.clear()

    def feed(self, data: bytes) -> list[Frame]:
        """Take bytes as they come; return the frames that they complete."""
        self._buffer += data
        found: list[Frame] = []
        start = 0
        while True:
            header = self._buffer.find(HEADER, start)
            end = len(self._buffer) if header < 0 else header
            self.skipped += end - start
            start = end
            if header < 0:
                break
            verdict = self._judge(start)
            if verdict is None:
                break
            if isinstance(verdict, Frame):
                found.append(verdict)
                start += 3 + self._buffer[start + 1]
            else:  # a false header: a true one may follow within what looked like its data
                start += 1
                self.skipped += 1
        del self._buffer[:start]
        return found

    def _judge(self, start: int) -> Frame | bool | None:
        """Return the frame at `start`, False when there is none, None when more bytes must come first."""
        buffer, ids, data = self._buffer, [], bytearray()
        if len(buffer) < start + 2:
            return None
        place = start + 2
        end = place + buffer[start + 1]
        if place == end:
            return False
        while place < end:
            if place >= len(buffer):
                return None
            number = buffer[place]
            size = SIZES.get(number)
            ids.append(number)
            if size is None or place + 1 + size > end or not self._may_begin(ids):
                return False
            data += buffer[place + 1 : place + 1 + size]
            place += 1 + size
        if self._expected is not None and len(ids) != len(self._expected):
            return False
        if len(buffer) <= end:
            return None
        total = sum(buffer[start + 1 : end + 1])
        if (total + HEADER) & 0xFF and not (self._both and not total & 0xFF):
            return False
        sensors = decode(ids, bytes(data))
        return False if sensors is None else Frame(tuple(ids), sensors)

    def _may_begin(self, ids: list[int]) -> bool:
        return self._expected is None or tuple(ids) == self._expected[: len(ids)]


# ---------------------------------------------------------------- commands
PERIOD_S = 0.015
"""Between two stream frames; never poll faster."""

TOP_MM_S = 500
"""Of one wheel."""


class Mode(enum.IntEnum):
    """Packet 35."""

    OFF = 0
    PASSIVE = 1
    SAFE = 2
    FULL = 3


@dataclass(frozen=True, slots=True)
class Generation:
    """What differs between the robots with an Open Interface."""

    name: str
    label: str
    baud: int
    wheel_base_m: float
    radius_m: float
    m_per_count: float | None  # None: no encoders, only distance and angle
    last_packet: int
    songs: int
    both_checksums: bool

    def has_packet(self, number: int) -> bool:
        """Tell whether the robot knows a packet or group id."""
        return number in MEMBERS and MEMBERS[number][-1].id <= self.last_packet

    def budget(self, baud: int) -> int:
        """Bytes that fit into one stream period; a longer frame would be corrupted."""
        return int(baud * PERIOD_S / 10)


CREATE1 = Generation("create1", "Create", 57600, 0.258, 0.17, None, 42, 16, both_checksums=True)
ROOMBA500 = Generation("roomba500", "Roomba 500", 115200, 0.235, 0.175, 0.444565e-3, 58, 5, both_checksums=True)
CREATE2 = Generation("create2", "Create 2", 115200, 0.235, 0.175, 0.444565e-3, 58, 5, both_checksums=False)
GENERATIONS = {each.name: each for each in (CREATE1, ROOMBA500, CREATE2)}


class Op(enum.IntEnum):
    """Command bytes."""

    RESET = 7
    START = 128
    BAUD = 129
    CONTROL = 130
    SAFE = 131
    FULL = 132
    POWER = 133
    SPOT = 134
    CLEAN = 135
    MAX = 136  # Create 1: demo
    DRIVE = 137
    MOTORS = 138
    LEDS = 139
    SONG = 140
    PLAY = 141
    QUERY = 142
    DOCK = 143
    MOTORS_PWM = 144
    DRIVE_DIRECT = 145
    DRIVE_PWM = 146
    DIGITAL_OUTPUTS = 147
    STREAM = 148
    QUERY_LIST = 149
    PAUSE_STREAM = 150
    SEND_IR = 151
    SCRIPT = 152
    PLAY_SCRIPT = 153
    SHOW_SCRIPT = 154
    WAIT_TIME = 155
    WAIT_DISTANCE = 156
    WAIT_ANGLE = 157
    WAIT_EVENT = 158
    SCHEDULING_LEDS = 162
    DIGIT_LEDS_RAW = 163
    DIGIT_LEDS = 164
    BUTTONS = 165
    SCHEDULE = 167
    DAY_TIME = 168
    STOP = 173


BAUD_CODES = dict(
    enumerate((300, 600, 1200, 2400, 4800, 9600, 14400, 19200, 28800, 38400, 57600, 115200))
)  # fmt: skip

_DATA_BYTES = {
    Op.BAUD: 1, Op.DRIVE: 4, Op.MOTORS: 1, Op.LEDS: 3, Op.SONG: 2, Op.PLAY: 1, Op.QUERY: 1, Op.MOTORS_PWM: 3,
    Op.DRIVE_DIRECT: 4, Op.DRIVE_PWM: 4, Op.STREAM: 1, Op.QUERY_LIST: 1, Op.PAUSE_STREAM: 1,
    Op.SCHEDULING_LEDS: 2, Op.DIGIT_LEDS_RAW: 4, Op.DIGIT_LEDS: 4, Op.BUTTONS: 1, Op.SCHEDULE: 15, Op.DAY_TIME: 3,
}  # fmt: skip
_DATA_BYTES_CREATE1 = {
    Op.MAX: 1, Op.DIGITAL_OUTPUTS: 1, Op.SEND_IR: 1, Op.SCRIPT: 1, Op.WAIT_TIME: 1, Op.WAIT_DISTANCE: 2,
    Op.WAIT_ANGLE: 2, Op.WAIT_EVENT: 1,
}  # fmt: skip
_ONLY_CREATE1 = {*_DATA_BYTES_CREATE1, Op.PLAY_SCRIPT, Op.SHOW_SCRIPT} - {Op.MAX}
_NOT_CREATE1 = {
    Op.RESET, Op.POWER, Op.DRIVE_PWM, Op.SCHEDULING_LEDS, Op.DIGIT_LEDS_RAW, Op.DIGIT_LEDS, Op.BUTTONS,
    Op.SCHEDULE, Op.DAY_TIME, Op.STOP,
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Command:
    """One whole command as the robot understands it."""

    op: Op
    data: bytes = b""


class CommandParser:
    """The robot's side: takes bytes one by one and waits, for ever if need be, for a command's data.

    Unknown opcodes are ignored. Never raises.
    """

    def __init__(self, generation: Generation) -> None:
        first = generation is CREATE1
        unknown = _NOT_CREATE1 if first else _ONLY_CREATE1
        sizes = _DATA_BYTES | _DATA_BYTES_CREATE1 if first else _DATA_BYTES
        self._sizes = {int(op): sizes.get(op, 0) for op in Op if op not in unknown}
        self.reset()

    def reset(self) -> None:
        """Forget a command begun."""
        self._op: Op | None = None
        self._data = bytearray()

    def push(self, byte: int) -> Command | None:
        """Take one byte; return the command that it completes."""
        if self._op is not None:
            self._data.append(byte)
        elif byte in self._sizes:
            self._op = Op(byte)
        else:
            return None
        if len(self._data) < self._wanted(self._op):
            return None
        command = Command(self._op, bytes(self._data))
        self.reset()
        return command

    def _wanted(self, op: Op) -> int:
        size = self._sizes[op]
        if op is Op.SONG and len(self._data) >= 2:
            return 2 + 2 * self._data[1]
        if op in (Op.STREAM, Op.QUERY_LIST, Op.SCRIPT) and self._data:
            return 1 + self._data[0]
        return size


def _held(value: int, low: int, high: int, what: str) -> int:
    if not low <= value <= high:
        raise ValueError(f"{what} {value} is outside {low} to {high}")
    return value


def _i16(value: int, low: int, high: int, what: str) -> bytes:
    return _held(value, low, high, what).to_bytes(2, "big", signed=True)


def _u8(value: int, what: str, low: int = 0, high: int = 255) -> int:
    return _held(value, low, high, what) & 0xFF


def simple(op: Op) -> bytes:
    """Write a command without data: START, SAFE, FULL, POWER, SPOT, CLEAN, MAX, DOCK, RESET, STOP, ..."""
    if op in _DATA_BYTES or op in _ONLY_CREATE1 - {Op.PLAY_SCRIPT, Op.SHOW_SCRIPT}:
        raise ValueError(f"{op.name} needs data")
    return bytes([op])


def baud(rate: int) -> bytes:
    """Switch the rate until the next power cycle; wait 100 ms before the next command."""
    for code, known in BAUD_CODES.items():
        if known == rate:
            return bytes([Op.BAUD, code])
    raise ValueError(f"{rate} baud is not one of {', '.join(map(str, BAUD_CODES.values()))}")


def drive(velocity_mm_s: int, radius_mm: int | None) -> bytes:
    """Drive an arc; radius None is straight, positive turns left, -1 and 1 spin clockwise and counter-clockwise."""
    speed = _i16(velocity_mm_s, -TOP_MM_S, TOP_MM_S, "velocity in mm/s")
    radius = b"\x80\x00" if radius_mm is None else _i16(radius_mm, -2000, 2000, "radius in mm")
    return bytes([Op.DRIVE]) + speed + radius


def drive_direct(left_mm_s: int, right_mm_s: int) -> bytes:
    """Drive the wheels. Left comes first here, right first on the wire."""
    right = _i16(right_mm_s, -TOP_MM_S, TOP_MM_S, "right wheel in mm/s")
    return bytes([Op.DRIVE_DIRECT]) + right + _i16(left_mm_s, -TOP_MM_S, TOP_MM_S, "left wheel in mm/s")


def drive_pwm(left: int, right: int) -> bytes:
    """Drive the wheels by duty cycle, -255 to 255 (not Create 1)."""
    return bytes([Op.DRIVE_PWM]) + _i16(right, -255, 255, "right PWM") + _i16(left, -255, 255, "left PWM")


def motors(bits: int) -> bytes:
    """Switch b0 side, b1 vacuum, b2 main, b3 side clockwise, b4 main outward (Create 1: low side drivers)."""
    return bytes([Op.MOTORS, _u8(bits, "motor bits", high=31)])


def motors_pwm(main: int, side: int, vacuum: int) -> bytes:
    """Drive brushes -127 to 127 and vacuum 0 to 127 (Create 1: low side drivers 2, 1, 0, each 0 to 128)."""
    low_high = -127, 128
    return bytes([Op.MOTORS_PWM, _u8(main, "main", *low_high), _u8(side, "side", *low_high),
                  _u8(vacuum, "vacuum", 0, 128)])  # fmt: skip


def leds(bits: int, colour: int, intensity: int) -> bytes:
    """Light b0 debris, b1 spot, b2 dock, b3 check (Create 1: b1 play, b3 advance); power LED green 0 to red 255."""
    return bytes([Op.LEDS, _u8(bits, "LED bits", high=15), _u8(colour, "colour"), _u8(intensity, "intensity")])


def scheduling_leds(weekdays: int, others: int) -> bytes:
    """Light the weekday and scheduling LEDs (Roomba 500)."""
    return bytes([Op.SCHEDULING_LEDS, _u8(weekdays, "weekday bits", high=127), _u8(others, "bits", high=31)])


def digit_leds_raw(digits: Sequence[int]) -> bytes:
    """Light the segments of digits 3, 2, 1, 0 (does not work in the firmware of the Create 2)."""
    _held(len(digits), 4, 4, "number of digits")
    return bytes([Op.DIGIT_LEDS_RAW, *(_u8(each, "segments", high=127) for each in digits)])


def digit_leds(text: str) -> bytes:
    """Show four printable ASCII characters."""
    _held(len(text), 4, 4, "number of characters")
    return bytes([Op.DIGIT_LEDS, *(_u8(ord(each), "character", 32, 126) for each in text)])


def song(number: int, notes: Sequence[tuple[int, int]]) -> bytes:
    """Store up to 16 notes (MIDI 31 to 127, or 0 for a rest; length in 1/64 s)."""
    _held(len(notes), 1, 16, "number of notes")
    data = [Op.SONG, _u8(number, "song", high=15), len(notes)]
    for pitch, length in notes:
        data += [pitch if pitch == 0 else _u8(pitch, "note", 31, 127), _u8(length, "length")]
    return bytes(data)


def play(number: int) -> bytes:
    """Play a stored song."""
    return bytes([Op.PLAY, _u8(number, "song", high=15)])


def _ids(ids: Iterable[int]) -> list[int]:
    known = list(ids)
    for number in known:
        if number not in MEMBERS:
            raise ValueError(f"there is no packet {number}")
    _held(len(known), 0, 255, "number of packets")
    return known


def query(number: int) -> bytes:
    """Ask for one packet or group once; the answer is raw. Pause a stream first."""
    return bytes([Op.QUERY, *_ids([number])])


def query_list(ids: Iterable[int]) -> bytes:
    """Ask for several once; the answer is raw, in the order asked."""
    known = _ids(ids)
    return bytes([Op.QUERY_LIST, len(known), *known])


def stream(ids: Iterable[int]) -> bytes:
    """Ask for a frame each 15 ms; no ids: stop."""
    known = _ids(ids)
    _held(frame_size(known) - 3, 0, LONGEST_STREAM, "bytes in a frame")
    return bytes([Op.STREAM, len(known), *known])


def pause_stream(paused: bool) -> bytes:
    """Pause or resume the stream; the list is kept."""
    return bytes([Op.PAUSE_STREAM, 0 if paused else 1])


def buttons(bits: int) -> bytes:
    """Press buttons for 1/6 s (clean, spot, dock, minute, hour, day, schedule, clock = b0 to b7)."""
    return bytes([Op.BUTTONS, _u8(bits, "buttons")])


def schedule(days: int, times: Sequence[tuple[int, int]]) -> bytes:
    """Set the cleaning schedule: day bits from Sunday, then hour and minute of seven days."""
    _held(len(times), 7, 7, "number of days")
    data = [Op.SCHEDULE, _u8(days, "day bits", high=127)]
    for hour, minute in times:
        data += [_u8(hour, "hour", high=23), _u8(minute, "minute", high=59)]
    return bytes(data)


def day_time(day: int, hour: int, minute: int) -> bytes:
    """Set the clock; day 0 is Sunday."""
    return bytes([Op.DAY_TIME, _u8(day, "day", high=6), _u8(hour, "hour", high=23), _u8(minute, "minute", high=59)])


def demo(number: int) -> bytes:
    """Start one of the Create 1's demos; -1 ends it."""
    return bytes([Op.MAX, _u8(number, "demo", -1, 9)])


def create1_byte(op: Op, value: int) -> bytes:
    """Write DIGITAL_OUTPUTS (bits), SEND_IR (byte), WAIT_TIME (1/10 s) or WAIT_EVENT (1 to 22, negative: inverse)."""
    ranges = {
        Op.DIGITAL_OUTPUTS: (0, 7), Op.SEND_IR: (0, 255), Op.WAIT_TIME: (0, 255), Op.WAIT_EVENT: (-22, 22),
    }  # fmt: skip
    if op not in ranges or (op is Op.WAIT_EVENT and value == 0):
        raise ValueError(f"{op.name} {value} is no command with one byte of the Create 1")
    return bytes([op, _u8(value, op.name, *ranges[op])])


def wait_distance(distance_mm: int) -> bytes:
    """Create 1: ignore commands until it has gone that far (negative: backwards)."""
    return bytes([Op.WAIT_DISTANCE]) + _i16(distance_mm, -32768, 32767, "distance in mm")


def wait_angle(angle_deg: int) -> bytes:
    """Create 1: ignore commands until it has turned so far, counter-clockwise positive."""
    return bytes([Op.WAIT_ANGLE]) + _i16(angle_deg, -32768, 32767, "angle in degrees")


def script(commands: bytes) -> bytes:
    """Create 1: store up to 100 bytes of commands; PLAY_SCRIPT runs them."""
    _held(len(commands), 0, 100, "bytes of script")
    return bytes([Op.SCRIPT, len(commands)]) + commands
