"""What a Create tells: the packet table, typed sensors, stream frames. Bytes only; nothing here raises on any bytes.

Source: iRobot Create, Roomba 500 and Create 2 Open Interface specifications.
"""

from __future__ import annotations

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
