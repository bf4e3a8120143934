"""Reads the byte streams of lidars: LDROBOT LD06 and LD19, Slamtec RPLIDAR A1 to A3 and S1 (standard scan).

LDROBOT (*LD19 development manual*, 4): packets of twelve points, ``54 2C``, speed (degrees/s), first angle, points
(distance in mm, intensity), last angle (0.01 degrees), time, CRC-8. Slamtec (*RPLIDAR interface protocol*, "SCAN"):
after a descriptor, nodes of five bytes: start bit, quality, angle (1/64 degree), distance (1/4 mm). Both count angles
clockwise seen from above, and state 0 for a distance that was not measured. Here angles are counter-clockwise and such
a distance is NaN.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import numpy as np

from fullswarm.kernels import Array

MOST_POINTS = 4096
"""Of one turn: what never turns on is no lidar, and fills no memory."""
FEWEST_POINTS = 30
"""A turn of fewer is the rest of one that was cut."""


class Turn(NamedTuple):
    """One turn: angles (k,) rad, counter-clockwise from the lidar's own x axis, and distances (k,) m, NaN: none."""

    angles_rad: Array
    distances_m: Array


class Codec(Protocol):
    """One kind of lidar. `bad`: bytes that were no part of a packet, since the beginning."""

    baud: int
    bad: int

    def begin(self) -> bytes:
        """Forget all that was received; return what makes the lidar measure."""
        ...

    def end(self) -> bytes:
        """Return what makes it stand still."""
        ...

    def take(self, data: bytes) -> Sequence[Turn]:
        """Take bytes; return the turns that are complete now."""
        ...


class Turning:
    """Collects points until the lidar has turned once; the first, which began somewhere, is left out."""

    def __init__(self) -> None:
        self._points: list[tuple[float, float]] = []  # clockwise degrees, m
        self._whole = False

    def forget(self) -> None:
        """Begin anew."""
        self._points, self._whole = [], False

    def add(self, degrees: float, distance_m: float) -> None:
        """Add a point of this turn."""
        if len(self._points) < MOST_POINTS:
            self._points.append((degrees, distance_m))

    def turn(self) -> Turn | None:
        """Begin the next turn; return the one that has ended."""
        points, whole = self._points, self._whole
        self._points, self._whole = [], True
        if not whole or not FEWEST_POINTS <= len(points) < MOST_POINTS:
            return None
        clockwise, distances_m = np.array(points).T
        return Turn(np.radians(-clockwise), np.where(distances_m > 0.0, distances_m, math.nan))


# ---------------------------------------------------------------- LDROBOT
LD_HEAD, LD_POINTS = b"\x54\x2c", 12
_LD = struct.Struct("<2sHH36sHHB")
_LD_POINT = struct.Struct("<HB")
POLYNOMIAL = 0x4D


def _table() -> tuple[int, ...]:
    found = []
    for byte in range(256):
        value = byte
        for _ in range(8):
            value = (value << 1) ^ (POLYNOMIAL if value & 0x80 else 0)
        found.append(value & 0xFF)
    return tuple(found)


_CRC = _table()


def crc8(data: bytes) -> int:
    """Return the CRC-8 of LDROBOT: polynomial 0x4D, begun with 0."""
    value = 0
    for byte in data:
        value = _CRC[value ^ byte]
    return value


class LdCodec:
    """LD06, LD19: they measure as soon as they have power, and take nothing."""

    baud = 230_400

    def __init__(self) -> None:
        self.bad = 0
        self._rest, self._turning = bytearray(), Turning()
        self._last_deg = -1.0

    def begin(self) -> bytes:
        """Forget all that was received."""
        self._rest.clear()
        self._turning.forget()
        self._last_deg = -1.0
        return b""

    def end(self) -> bytes:
        """Return nothing."""
        return b""

    def take(self, data: bytes) -> Sequence[Turn]:
        """Take bytes; return the turns that are complete now."""
        rest = self._rest
        found: list[Turn] = []
        rest += data
        while len(rest) >= _LD.size:
            packet = bytes(rest[: _LD.size])
            if not packet.startswith(LD_HEAD) or crc8(packet[:-1]) != packet[-1]:
                self.bad += 1
                del rest[0]
                continue
            del rest[: _LD.size]
            found += self._packet(packet)
        return found

    def _packet(self, packet: bytes) -> Sequence[Turn]:
        _, _, first, points, last, _, _ = _LD.unpack(packet)
        if first >= 36_000 or last >= 36_000:
            self.bad += len(packet)
            return ()
        step = ((last - first) % 36_000) / (LD_POINTS - 1)
        found: list[Turn] = []
        for number, (mm, _) in enumerate(_LD_POINT.iter_unpack(points)):
            degrees = ((first + number * step) % 36_000) / 100.0
            # Less than half a turn backwards is no turn: points of two packets overlap by rounding.
            if degrees < self._last_deg - 180.0 and (turn := self._turning.turn()) is not None:
                found.append(turn)
            self._last_deg = degrees
            self._turning.add(degrees, mm / 1000.0)
        return found


# ---------------------------------------------------------------- Slamtec
STOP, SCAN, MOTOR = b"\xa5\x25", b"\xa5\x20", b"\xa5\xf0\x02\x94\x02\xc1"
"""The motor's speed is for A2 and A3; an A1, whose motor runs with the port's DTR line low, ignores it."""
DESCRIPTOR = bytes.fromhex("a55a0500004081")
_NODE = 5


class RplidarCodec:
    """RPLIDAR A1, A2, A3, S1."""

    def __init__(self, baud: int = 115_200) -> None:
        self.baud, self.bad = baud, 0
        self._rest, self._turning = bytearray(), Turning()
        self._scans = False

    def begin(self) -> bytes:
        """Forget all that was received; return what makes it scan."""
        self._rest.clear()
        self._turning.forget()
        self._scans = False
        return STOP + MOTOR + SCAN

    def end(self) -> bytes:
        """Return what stops it and its motor."""
        return STOP + b"\xa5\xf0\x02\x00\x00\x57"

    def take(self, data: bytes) -> Sequence[Turn]:
        """Take bytes; return the turns that are complete now."""
        rest = self._rest
        found: list[Turn] = []
        rest += data
        if not self._scans:
            at = rest.find(DESCRIPTOR)
            if at < 0:
                self.bad += max(0, len(rest) - len(DESCRIPTOR))
                del rest[: -len(DESCRIPTOR)]
                return ()
            del rest[: at + len(DESCRIPTOR)]
            self._scans = True
        at = 0
        while len(rest) - at >= _NODE:
            head, low, high = rest[at], rest[at + 1], rest[at + 2]
            starts = head & 1
            if starts == (head >> 1) & 1 or not low & 1:
                self.bad += 1
                at += 1
                continue
            degrees = (low >> 1 | high << 7) / 64.0
            distance_m = (rest[at + 3] | rest[at + 4] << 8) / 4000.0
            at += _NODE
            if degrees > 361.0:
                self.bad += _NODE
                continue
            if starts and (turn := self._turning.turn()) is not None:
                found.append(turn)
            self._turning.add(degrees, distance_m)
        del rest[:at]
        return found
