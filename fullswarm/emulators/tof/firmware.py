"""An I2C bus at the end of a link, its multiplexer, and VL53L1X sensors; shares no code with the driver."""

from __future__ import annotations

import binascii
import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType

Sees = Callable[[float], float]
"""The distance (m) along a ray, by its angle (rad, counter-clockwise from the sensor's axis); infinite: nothing."""
STEP_S = 0.005
BOOT_S = 0.0012
CONE_RAYS = 61
NO_TARGET_MM = 8187
BUDGETS_MS: Mapping[tuple[int, int], int] = MappingProxyType(
    {(0x01CC, 0x01F1): 100, (0x01AE, 0x01E8): 50, (0x01CC, 0x01EA): 100}
)
"""Duration of a measurement, by its two timeouts."""


class Tca9548a:
    """A multiplexer: one byte says which of its eight channels are connected to the bus."""

    def __init__(self) -> None:
        self.channels = 0

    def write(self, data: bytes) -> None:
        """Take the byte of channels."""
        if data:
            self.channels = data[-1]

    def read(self, count: int) -> bytes:
        """Return the byte of channels."""
        return bytes([self.channels] * count)


class Vl53l1x:
    """One sensor: 16 bit register addresses, which count on by themselves.

    Attributes
    ----------
    sees : what is in front of it
    powered : False: its cable is pulled; back with power it has forgotten everything
    stuck : repeats its last measurement
    failed : its laser has failed
    state : 0, or the state that its measurements have instead of a true one
    """

    FIELD_OF_VIEW = ((16, 27.0), (8, 20.0), (4, 15.0))  # degrees, by the side of the region of interest
    OSCILLATOR = 0x1F4

    def __init__(self, sees: Sees) -> None:
        self.sees = sees
        self.powered, self.stuck, self.failed, self.state = True, False, False, 0
        self._power_on(0.0)

    def _power_on(self, now_s: float) -> None:
        self._registers = bytearray(0x200)
        self._at, self._booted_s = 0, now_s + BOOT_S
        self._due_s, self._count, self._waits = math.inf, -1, False
        self._put(0x0001, bytes([0x29]))
        self._put(0x010F, bytes([0xEA, 0xCC, 0x10]))
        self._put(0x00DE, self.OSCILLATOR.to_bytes(2, "big"))
        self._put(0x013E, bytes([0xC6]))

    def power(self, on: bool, now_s: float) -> None:
        """Pull its cable, or put it back."""
        if on and not self.powered:
            self._power_on(now_s)
        self.powered = on

    @property
    def address(self) -> int:
        """Where it answers."""
        return self._registers[0x0001] & 0x7F

    def _put(self, at: int, data: bytes) -> None:
        self._registers[at : at + len(data)] = data

    def _word(self, at: int, size: int = 2) -> int:
        return int.from_bytes(self._registers[at : at + size], "big")

    def write(self, data: bytes, now_s: float) -> None:
        """Take a register's address, and what is to be in it and those after it."""
        self._at = int.from_bytes(data[:2], "big")
        for value in data[2:]:
            at, self._at = self._at % 0x200, self._at + 1
            if at in (0x010F, 0x0110, 0x0111):
                continue  # it cannot be renamed
            self._registers[at] = value
            if at == 0x0086 and value & 1:
                self._waits = False
                self._registers[0x0031] &= 0xFE
            elif at == 0x0087:
                ranges = value == 0x40
                self._count = -1
                self._due_s = now_s + self._period_s() if ranges else math.inf

    def read(self, count: int, now_s: float) -> bytes:
        """Return registers from the address that was written last."""
        self._registers[0x00E5] = 3 if now_s >= self._booted_s else 0
        data = bytes(self._registers[self._at : self._at + count])
        self._at += count
        return data.ljust(count, b"\0")

    def _period_s(self) -> float:
        """Return the time from one measurement to the next; infinite: it was set to what is none."""
        budget_ms = BUDGETS_MS.get((self._word(0x005E), self._word(0x0061)))
        interval_ms = self._word(0x006C, 4) / (1.075 * self.OSCILLATOR)
        return math.inf if budget_ms is None else max(budget_ms, interval_ms) / 1000.0

    def step(self, now_s: float) -> None:
        """Measure when it is time; the next measurement waits until this one is taken."""
        if not self.powered or now_s < self._due_s or self._waits:
            return
        self._due_s = max(self._due_s + self._period_s(), now_s)
        self._waits = True
        self._registers[0x0031] |= 0x01  # active high, as configured by bit 4 of 0x0030
        if self.stuck:
            return
        self._count = 128 if self._count >= 255 else self._count + 1
        raw, mm = self._measure()
        self._put(0x0089, bytes([raw, 0, self._count]))
        self._put(0x0096, mm.to_bytes(2, "big"))

    def _measure(self) -> tuple[int, int]:
        """Return the state's raw number and the distance in mm: the nearest in its field of view."""
        if self.failed:
            return 2, 0
        if self.state:
            return self.state, NO_TARGET_MM
        if self._count == 0:
            return 19, NO_TARGET_MM  # not checked for wrap around
        side = (self._registers[0x0080] & 0x0F) + 1
        width = next(math.radians(degrees) for least, degrees in self.FIELD_OF_VIEW if side >= least)
        reach_m = 1.36 if self._registers[0x004B] == 0x14 else 4.0
        rays = (width * (each / (CONE_RAYS - 1) - 0.5) for each in range(CONE_RAYS))
        nearest_m = min(self.sees(each) for each in rays)
        return (9, round(1000.0 * nearest_m)) if nearest_m <= reach_m else (4, NO_TARGET_MM)


class I2cBridge:
    """The bus: sensors behind channels of a multiplexer, or, without a channel, on the bus itself."""

    def __init__(self, sensors: Mapping[int | None, Sequence[Vl53l1x]], mux: int) -> None:
        self.sensors, self.mux_address = sensors, mux
        self.mux = Tca9548a() if any(each is not None for each in sensors) else None
        self.next_due_s = 0.0
        self._in, self._out = bytearray(), bytearray()

    def receive(self, data: bytes, now_s: float, _port: int) -> None:
        """Take frames, and make their transfers."""
        self._in += data
        while (at := self._in.find(b"\xa7\x49")) >= 0 and len(self._in) >= at + 6:
            del self._in[:at]
            end = 6 + self._in[4]
            if len(self._in) < end + 4:
                return
            frame, given = bytes(self._in[:end]), int.from_bytes(self._in[end : end + 4], "little")
            if binascii.crc32(frame) != given:
                del self._in[:1]
                continue
            del self._in[: end + 4]
            answer = self._transfer(frame[3], frame[6:], frame[5], now_s)
            reply = b"\xa7\x52" + bytes([frame[2], answer is None, len(answer or b"")]) + (answer or b"")
            self._out += reply + binascii.crc32(reply).to_bytes(4, "little")

    def _transfer(self, address: int, data: bytes, count: int, now_s: float) -> bytes | None:
        """Return what is read; None: nothing has acknowledged."""
        if self.mux is not None and address == self.mux_address:
            self.mux.write(data)
            return self.mux.read(count)
        heard = [
            each for channel, sensors in self.sensors.items() for each in sensors
            if (channel is None or (self.mux is not None and self.mux.channels >> channel & 1))
            and each.powered and each.address == address
        ]  # fmt: skip
        if not heard:
            return None
        for each in heard:
            each.write(data, now_s)
        answers = [each.read(count, now_s) for each in heard]
        # Two that answer at once pull the line low wherever one of them does.
        return _wired_and(answers)

    def hung_up(self, _port: int) -> None:
        """Nothing: a bus does not notice, but what was half a frame is none any more."""
        self._in.clear()

    def step(self, now_s: float) -> bool:
        """Let the sensors measure."""
        self.next_due_s = now_s + STEP_S
        for sensors in self.sensors.values():
            for each in sensors:
                each.step(now_s)
        return False

    def take(self, _port: int) -> Sequence[bytes]:
        """Return the replies."""
        out, self._out = bytes(self._out), bytearray()
        return (out,) if out else ()


def _wired_and(answers: Sequence[bytes]) -> bytes:
    found = answers[0]
    for each in answers[1:]:
        found = bytes(a & b for a, b in zip(found, each, strict=True))
    return found
