"""What lidars send: time in, bytes out. No port, no thread.

All turn clockwise ten times a second; the points of a packet are measured at the time at which it is sent.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence

import numpy as np

from fullswarm.drivers.lidar import protocol
from fullswarm.emulators.base import Firmware
from fullswarm.kernels import Array

TURN_DEG_S = 3600
LATE_S = 0.2
"""A computer that stood still for longer sends no packets for that time."""
Measure = Callable[[Array], Array]
"""Distances in m (inf: nothing) in directions in rad, counter-clockwise from the sensor's zero."""


class LidarFirmware(Firmware):
    """A lidar that sends `points` measurements at once, `rate_per_s` of them in a second.

    Attributes
    ----------
    covered : it measures nothing
    """

    def __init__(self, measure: Measure, max_m: float, points: int, rate_per_s: float, sign: float) -> None:
        self._measure, self._max_m, self._points, self._sign = measure, max_m, points, sign
        self._step_deg, self._period_s = TURN_DEG_S / rate_per_s, points / rate_per_s
        self._angle_deg, self._due_s = 0.0, -math.inf
        self._out: list[bytes] = []
        self.covered = False

    @property
    def next_due_s(self) -> float:
        """When the next packet is due."""
        return self._due_s

    def receive(self, data: bytes, now_s: float, port: int, /) -> None:
        """Ignore it."""

    def step(self, now_s: float) -> bool:
        """Send the packets that are due."""
        if now_s - self._due_s > LATE_S:
            self._due_s = now_s
        while self._due_s <= now_s:
            self._due_s += self._period_s
            if self.turning:
                angles_deg = self._angle_deg + self._step_deg * np.arange(self._points)
                distances_m = self._measure(self._sign * np.radians(angles_deg))
                distances_m[~(distances_m <= self._max_m) | self.covered] = 0.0
                self._out.append(self.packet(angles_deg.tolist(), distances_m.tolist()))
                self._angle_deg = (self._angle_deg + self._step_deg * self._points) % 360.0
        return False

    @property
    def turning(self) -> bool:
        """It measures."""
        return True

    @abstractmethod
    def packet(self, angles_deg: list[float], distances_m: list[float]) -> bytes:
        """Return the bytes of some measurements; angles go on beyond 360 degrees."""
        ...

    def take(self, port: int, /) -> Sequence[bytes]:
        """Return the packets that are due."""
        del port
        out, self._out = self._out, []
        return out

    def hung_up(self, port: int, /) -> None:
        """Go on: it does not notice."""


class LdFirmware(LidarFirmware):
    """An LD06 or LD19."""

    def __init__(self, measure: Measure, max_m: float, sign: float) -> None:
        super().__init__(measure, max_m, protocol.LD_POINTS, protocol.LD_POINTS_PER_S, sign)
        self._sent = 0

    def packet(self, angles_deg: list[float], distances_m: list[float]) -> bytes:
        """Return one packet."""
        self._sent += 1
        points = [(round(1000.0 * each), 200 if each else 0) for each in distances_m]
        ms = round(1000.0 * self._sent * self._period_s) % 30000
        return protocol.ld_packet(TURN_DEG_S, angles_deg[0], angles_deg[-1], points, ms)


class RplidarFirmware(LidarFirmware):
    """An RPLIDAR A2: scans when asked to, while its motor turns.

    Attributes
    ----------
    health : 0: good, 1: warning, 2: defect
    resets : how often it was reset
    """

    def __init__(self, measure: Measure, max_m: float, sign: float) -> None:
        super().__init__(measure, max_m, 32, 4000.0, sign)
        self.health, self.resets = 0, 0
        self._scanning, self._pwm = False, 0
        self._buffer = b""

    @property
    def turning(self) -> bool:
        """It scans, and its motor turns."""
        return self._scanning and self._pwm > 0

    def receive(self, data: bytes, now_s: float, port: int, /) -> None:
        """Carry out commands."""
        del now_s, port
        self._buffer = (self._buffer + data)[-64:]
        while (start := self._buffer.find(protocol.SYNC)) >= 0 and len(self._buffer) >= start + 2:
            code = self._buffer[start + 1]
            length = 2
            if code & 0x80:
                length = 4 + self._buffer[start + 2] if len(self._buffer) > start + 2 else 64
            if len(self._buffer) < start + length:
                break
            self._carry_out(self._buffer[start : start + length])
            self._buffer = self._buffer[start + length :]

    def _carry_out(self, command: bytes) -> None:
        if command == protocol.STOP:
            self._scanning = False
        elif command == protocol.RESET:
            self._scanning, self.resets = False, self.resets + 1
            self._out.append(b"RP LIDAR System.\r\n")
        elif command == protocol.GET_INFO:
            self._out.append(protocol.answer(protocol.INFO, bytes([0x28, 29, 1, 7]) + bytes(16)))
        elif command == protocol.GET_HEALTH:
            self._out.append(protocol.answer(protocol.HEALTH, bytes([self.health, 0x01, 0x80])))
        elif command == protocol.SCAN and self.health < protocol.HEALTH_ERROR:
            self._scanning = True
            self._out.append(protocol.scanning())
        elif command[:2] == protocol.motor(0)[:2] and command == protocol.command(command[1], command[3:-1]):
            self._pwm = int.from_bytes(command[3:-1], "little")

    def packet(self, angles_deg: list[float], distances_m: list[float]) -> bytes:
        """Return some nodes."""
        return b"".join(
            protocol.node(angle % 360.0, distance, first=angle % 360.0 < self._step_deg)
            for angle, distance in zip(angles_deg, distances_m, strict=True)
        )
