"""The bytes of LD06, LD19 and RPLIDAR, and the turns that their points make up. Pure: no port, no clock.

LDROBOT (LD06 and LD19 development manuals): packets of 47 bytes, little-endian: 0x54, 0x2C, speed (°/s), first angle
(0.01°), 12 times distance (mm) and intensity, last angle, time (ms), CRC-8 with the polynomial 0x4D. They come by
themselves. Slamtec (RPLIDAR interface protocol): commands 0xA5 and a code, answers 0xA5 0x5A with length, mode and
type, then nodes of 5 bytes: flags and quality, angle (1/64°), distance (1/4 mm). Both count angles clockwise, seen
from above, and report the distance 0 where nothing was measured.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Iterator, Sequence
from functools import reduce
from operator import xor
from typing import NamedTuple, Protocol


class Point(NamedTuple):
    """One measurement: degrees clockwise from the sensor's zero, [0, 360), and m; 0: nothing was measured."""

    angle_deg: float
    distance_m: float


class Gap(NamedTuple):
    """Bytes were lost or damaged here: points before and after it do not belong together."""


GAP = Gap()


class Answer(NamedTuple):
    """What an RPLIDAR has answered to a command."""

    kind: int
    payload: bytes


class Parser(Protocol):
    """Turns bytes into points. Its buffer never holds more than one packet or answer and the bytes just fed.

    Attributes
    ----------
    damaged : packets or nodes that were dropped: checksum or check bits are wrong
    """

    damaged: int

    def feed(self, data: bytes) -> Iterator[Point | Gap | Answer]:
        """Take bytes; yield what is complete."""
        ...


# ---------------------------------------------------------------- LDROBOT
LD_HEADER = b"\x54\x2c"
LD_POINTS = 12
LD_BODY = struct.Struct("<2sHH" + "HB" * LD_POINTS + "HH")
LD_SIZE = LD_BODY.size + 1
LD_POINTS_PER_S = 4500
WIDEST_PACKET_DEG = 20.0
"""More than 12 points cover at the highest speed, 13 turns a second: a checksum of 8 bits alone lets 1 of 256 pass."""


def _crc_table() -> bytes:
    table = bytearray()
    for value in range(256):
        for _ in range(8):
            value = (value << 1) ^ (0x4D if value & 0x80 else 0)
            value &= 0xFF
        table.append(value)
    return bytes(table)


_CRC = _crc_table()


def ld_crc(data: bytes) -> int:
    """Return the checksum of a packet's bytes before it."""
    crc = 0
    for each in data:
        crc = _CRC[crc ^ each]
    return crc


def ld_packet(speed_deg_s: int, first_deg: float, last_deg: float, points: Sequence[tuple[int, int]], ms: int) -> bytes:
    """Return a packet; `points`: 12 times mm and intensity."""
    numbers = [number for point in points for number in point]
    first, last = (round(100.0 * each) % 36000 for each in (first_deg, last_deg))
    body = LD_BODY.pack(LD_HEADER, speed_deg_s, first, *numbers, last, ms)
    return body + bytes([ld_crc(body)])


class LdParser:
    """Finds packets in the bytes of an LD06 or LD19. A packet with a wrong checksum is searched for another header."""

    def __init__(self) -> None:
        self.damaged = 0
        self._buffer = b""

    def feed(self, data: bytes) -> Iterator[Point | Gap | Answer]:
        """Take bytes; yield the points of the packets that are complete."""
        buffer, at = self._buffer + data, 0
        while True:
            start = buffer.find(LD_HEADER, at)
            if start < 0:
                at = len(buffer) - buffer.endswith(LD_HEADER[:1])
                break
            if len(buffer) - start < LD_SIZE:
                at = start
                break
            packet = buffer[start : start + LD_SIZE]
            points = self._points(packet) if ld_crc(packet[:-1]) == packet[-1] else None
            if points is None:
                self.damaged += 1
                at = start + 1
            else:
                at = start + LD_SIZE
                yield from points
        self._buffer = buffer[max(at, 0) :]

    @staticmethod
    def _points(packet: bytes) -> list[Point] | None:
        _, _, first, *numbers, last, _ = LD_BODY.unpack_from(packet)
        covered_deg = (last - first) % 36000 / 100.0
        if first >= 36000 or last >= 36000 or covered_deg > WIDEST_PACKET_DEG:
            return None
        step_deg = covered_deg / (LD_POINTS - 1)
        return [Point((first / 100.0 + step_deg * place) % 360.0, mm / 1000.0) for place, mm in enumerate(numbers[::2])]


# ---------------------------------------------------------------- Slamtec
SYNC, ANSWER = b"\xa5", b"\xa5\x5a"
STOP, RESET, SCAN = SYNC + b"\x25", SYNC + b"\x40", SYNC + b"\x20"
GET_INFO, GET_HEALTH = SYNC + b"\x50", SYNC + b"\x52"
PWM = 660
"""The manufacturer's usual value, about 10 turns a second of an A2 or A3."""
INFO, HEALTH, NODES = 0x04, 0x06, 0x81
HEALTH_ERROR = 2
DESCRIPTOR = struct.Struct("<2sIB")
LONGEST_ANSWER = 64
NODE = struct.Struct("<BHH")
SURE = 16
"""So many nodes before a point and after it must fit each other: a node has only two check bits."""
BACK_DEG, AHEAD_DEG = 3.0, 20.0
"""From one node to the next the angle changes by less than this, backwards and forwards."""


def command(code: int, payload: bytes) -> bytes:
    """Return a command with a payload and its checksum."""
    body = SYNC + bytes([code, len(payload)]) + payload
    return body + bytes([reduce(xor, body)])


def motor(pwm: int) -> bytes:
    """Return the command that drives the motor of an A2 or A3; other models ignore it."""
    return command(0xF0, struct.pack("<H", pwm))


def answer(kind: int, payload: bytes) -> bytes:
    """Return an answer as an RPLIDAR sends it."""
    return DESCRIPTOR.pack(ANSWER, len(payload), kind) + payload


def scanning() -> bytes:
    """Return what an RPLIDAR sends before its nodes."""
    return DESCRIPTOR.pack(ANSWER, NODE.size | 1 << 30, NODES)


def node(angle_deg: float, distance_m: float, *, first: bool, quality: int = 15) -> bytes:
    """Return one node; `first`: of a turn."""
    flags = quality << 2 | (1 if first else 2)
    return NODE.pack(flags, (round(64.0 * angle_deg) % (360 * 64)) << 1 | 1, round(4000.0 * distance_m))


def _point(buffer: bytes, at: int) -> Point | None:
    flags, angle, distance = NODE.unpack_from(buffer, at)
    angle_deg = (angle >> 1) / 64.0
    if flags & 1 == flags >> 1 & 1 or not angle & 1 or angle_deg >= 360.0 + BACK_DEG:
        return None
    return Point(angle_deg % 360.0, distance / 4000.0)


def _follows(before: Point, after: Point) -> bool:
    return -BACK_DEG < (after.angle_deg - before.angle_deg + 180.0) % 360.0 - 180.0 < AHEAD_DEG


class RplidarParser:
    """Finds answers, and nodes after the answer that announces them, in the bytes of an RPLIDAR.

    What is put between nodes may join with parts of them and look like one. Therefore points are held back until
    :data:`SURE` more have come, and the first of them after a gap are dropped.
    """

    def __init__(self) -> None:
        self.damaged = 0
        self.scanning = False
        self._buffer = b""
        self._last: Point | None = None  # None: where a node begins is not known
        self._held: deque[Point] = deque()
        self._dropped = 0  # since the gap

    def feed(self, data: bytes) -> Iterator[Point | Gap | Answer]:
        """Take bytes; yield answers, points, and a gap where it has lost its place."""
        self._buffer += data
        if not self.scanning:
            yield from self._answers()
        if self.scanning:
            yield from self._nodes()

    def _answers(self) -> Iterator[Answer]:
        buffer, at = self._buffer, 0
        while not self.scanning:
            start = buffer.find(ANSWER, at)
            if start < 0:
                at = len(buffer) - buffer.endswith(SYNC)
                break
            at = start
            if len(buffer) - at < DESCRIPTOR.size:
                break
            _, length, kind = DESCRIPTOR.unpack_from(buffer, at)
            size = DESCRIPTOR.size + (length & 0x3FFFFFFF)
            if kind == NODES and size == DESCRIPTOR.size + NODE.size:
                at += DESCRIPTOR.size
                self.scanning, self._last = True, None
            elif size > DESCRIPTOR.size + LONGEST_ANSWER:
                at += 1
            elif len(buffer) - at < size:
                break
            else:
                yield Answer(kind, buffer[at + DESCRIPTOR.size : at + size])
                at += size
        self._buffer = buffer[at:]

    def _nodes(self) -> Iterator[Point | Gap]:
        buffer, at = self._buffer, 0
        while len(buffer) - at >= NODE.size:
            if self._last is None:
                if len(buffer) - at < SURE * NODE.size:
                    break
                if not self._sure(buffer, at):
                    at += 1
                    continue
            point = _point(buffer, at)
            if point is None or (self._last is not None and not _follows(self._last, point)):
                self.damaged += 1
                self._last = None
                self._held.clear()
                self._dropped = 0
                yield GAP
                continue
            self._last = point
            at += NODE.size
            if self._dropped < SURE:
                self._dropped += 1
                continue
            self._held.append(point)
            if len(self._held) > SURE:
                yield self._held.popleft()
        self._buffer = buffer[at:]

    @staticmethod
    def _sure(buffer: bytes, at: int) -> bool:
        before: Point | None = None
        for place in range(at, at + SURE * NODE.size, NODE.size):
            point = _point(buffer, place)
            if point is None or (before is not None and not _follows(before, point)):
                return False
            before = point
        return True


# ---------------------------------------------------------------- turns
MOST_POINTS = 8192
MISSING_DEG, WIDEST_STEP_DEG = 36.0, 5.0
"""A turn with steps wider than this that sum up to more than a tenth of it is not complete."""


class Turns:
    """Collects points until the angle begins anew."""

    def __init__(self) -> None:
        self._points: list[Point] = []
        self._began_s = -math.inf

    def clear(self) -> None:
        """Forget the turn under way."""
        self._points.clear()

    def add(self, point: Point, now_s: float) -> tuple[list[Point], float] | None:
        """Take a point; return the turn that it ends, if that is complete, and how long it took to arrive, in s."""
        points, done = self._points, None
        if points and points[-1].angle_deg - point.angle_deg > 180.0:
            done = (points, now_s - self._began_s) if _complete(points) else None
            points = self._points = []
        elif points and (points[-1].angle_deg - point.angle_deg > BACK_DEG or len(points) >= MOST_POINTS):
            points.clear()  # most of a turn was lost
        if not points:
            self._began_s = now_s
        points.append(point)
        return done


def _complete(points: Sequence[Point]) -> bool:
    angles = [point.angle_deg for point in points]
    steps = [after - before for before, after in zip(angles, [*angles[1:], angles[0] + 360.0], strict=True)]
    return sum(step for step in steps if step > WIDEST_STEP_DEG) <= MISSING_DEG
