"""The bytes that lidars send; shares no code with the driver's own codec."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

Sees = Callable[[float], float]
"""The distance (m) along a ray, by its angle (rad, counter-clockwise from the lidar's x axis); infinite: nothing."""
STEP_S = 0.02


class Ld19:
    """Turns ten times a second and measures 450 points in each turn, from when it has power."""

    turn_s, points = 0.1, 450

    def __init__(self, sees: Sees) -> None:
        self.sees, self.turns = sees, True
        self.next_due_s = 0.0
        self._at, self._out = 0, bytearray()

    def receive(self, data: bytes, _now_s: float, _port: int) -> None:
        """Nothing: it takes no commands."""

    def hung_up(self, _port: int) -> None:
        """Nothing: it does not notice."""

    def step(self, now_s: float) -> bool:
        """Measure what has passed by since the last step."""
        self.next_due_s = max(self.next_due_s + STEP_S, now_s)
        if self.turns:
            for _ in range(max(1, round(self.points * STEP_S / self.turn_s / 12))):
                self._out += self._packet(now_s)
        return False

    def _packet(self, now_s: float) -> bytes:
        degrees = [(self._at + each) % self.points * 360.0 / self.points for each in range(12)]
        self._at = (self._at + 12) % self.points
        body = bytearray([0x54, 0x2C])
        body += round(360.0 / self.turn_s).to_bytes(2, "little") + round(100.0 * degrees[0]).to_bytes(2, "little")
        for each in degrees:
            away_m = self.sees(-math.radians(each))
            body += (round(1000.0 * away_m) if away_m <= 12.0 else 0).to_bytes(2, "little") + b"\xc8"
        body += round(100.0 * degrees[-1]).to_bytes(2, "little") + (round(1000.0 * now_s) % 30_000).to_bytes(
            2, "little"
        )
        return bytes(body) + bytes([self._sum(bytes(body))])

    @staticmethod
    def _sum(body: bytes) -> int:
        """Return the remainder of the message divided by x⁸ + x⁶ + x³ + x² + 1, bit by bit."""
        left = 0
        for byte in body:
            for bit in range(7, -1, -1):
                carry = (left >> 7) ^ ((byte >> bit) & 1)
                left = ((left << 1) & 0xFF) ^ (0x4D if carry else 0)
        return left

    def take(self, _port: int) -> Sequence[bytes]:
        """Return what it sends."""
        out, self._out = bytes(self._out), bytearray()
        return (out,) if out else ()


class RplidarA1:
    """Turns 5.5 times a second while it scans, and measures 360 points in each turn."""

    turn_s, points = 0.18, 360

    def __init__(self, sees: Sees) -> None:
        self.sees, self.turns = sees, True
        self.next_due_s = 0.0
        self.scans = False
        self._at, self._in, self._out = 0, bytearray(), bytearray()

    def receive(self, data: bytes, _now_s: float, _port: int) -> None:
        """Take requests: SCAN and STOP; others are passed over."""
        self._in += data
        while len(self._in) >= 2:
            if self._in[0] != 0xA5:
                del self._in[0]
                continue
            command = self._in[1]
            size = 2 if command < 0x80 else 3 + self._in[2] + 1 if len(self._in) > 2 else 99
            if len(self._in) < size:
                return
            del self._in[:size]
            if command == 0x25:
                self.scans = False
                self._out.clear()
            elif command == 0x20:
                self.scans, self._at = True, 100  # it is somewhere in its turn
                self._out += bytes.fromhex("A5 5A 05 00 00 40 81")

    def hung_up(self, _port: int) -> None:
        """Nothing: it does not notice."""

    def step(self, now_s: float) -> bool:
        """Measure what has passed by since the last step."""
        self.next_due_s = max(self.next_due_s + STEP_S, now_s)
        if not (self.scans and self.turns):
            return False
        for _ in range(round(self.points * STEP_S / self.turn_s)):
            degrees = self._at * 360.0 / self.points
            away_m = self.sees(-math.radians(degrees))
            angle, distance = round(64.0 * degrees), round(4000.0 * away_m) if away_m <= 12.0 else 0
            first = 1 if self._at == 0 else 0
            head = 47 << 2 | (1 - first) << 1 | first
            self._out += bytes([head, (angle & 0x7F) << 1 | 1, angle >> 7, distance & 0xFF, distance >> 8])
            self._at = (self._at + 1) % self.points
        return False

    def take(self, _port: int) -> Sequence[bytes]:
        """Return what it sends."""
        out, self._out = bytes(self._out), bytearray()
        return (out,) if out else ()
