"""Registers of the VL53L1X: what is written to start it, and what its results mean.

After ST's *VL53L1X Ultra Lite Driver* (STSW-IMG009, UM2510), which these sequences and tables are taken from; the
register map itself is not published. Registers have 16 bit addresses and are big-endian. Distances are in mm.

Why no library does this: ``adafruit-circuitpython-vl53l1x`` brings Blinka, 7 MB and a C extension, waits in its
constructor for as long as the sensor does not answer, sets the centre of a narrowed region of interest to another
place than ST does, and does not tell a sensor that sees nothing from one that has failed; ``VL53L1X`` has no wheels, so
it cannot be put into a release. ``smbus2``, which makes the transfers, is one module of Python.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

MODEL = bytes.fromhex("eacc")
MODEL_ID, BOOTED, READY, RESULT, INTERVAL, CLOCK, ROI_CENTRE = 0x010F, 0x00E5, 0x0031, 0x0089, 0x006C, 0x00DE, 0x013E
CLEAR, START, STOP = (0x0086, b"\x01"), (0x0087, b"\x40"), (0x0087, b"\x00")
RESULT_BYTES = 15
CONFIGURATION = (
    0x002D,
    bytes.fromhex(
        "000000"
        "0102000208000810010100000000ff00"
        "0f0000000000200b0000020a21000005"
        "00000000c8000038ff010008000001cc"
        "0f01f10d0168008008b8000000000f89"
        "00000000000000010f0d0e0e000002c7"
        "ff9b000000010000"
    ),
)
"""Of registers 0x2D to 0x87: interrupt active high, on each new measurement; stopped."""
WARMING: Sequence[tuple[int, bytes]] = (STOP, CLEAR, CONFIGURATION, START)
"""It may still measure for an agent that was killed, with a result that was never taken."""
WARMED: Sequence[tuple[int, bytes]] = (CLEAR, STOP, (0x0008, b"\x09"), (0x000B, b"\x00"))
"""After the first measurement, whose calibration of the receivers is kept from then on."""
FIELD_OF_VIEW_RAD: Mapping[int, float] = MappingProxyType(
    {16: math.radians(27.0), 8: math.radians(20.0), 4: math.radians(15.0)}
)
"""Diagonal, by the side of the region of interest: as a cone it holds all that the sensor sees."""


@dataclass(frozen=True, slots=True)
class Mode:
    """A distance mode.

    Attributes
    ----------
    max_m : how far it measures at best
    nothing_m : what a measurement without a target is: infinite where the range hardly depends on light, otherwise NaN
    budget_ms : duration of a measurement
    registers : what sets it
    """

    max_m: float
    nothing_m: float
    budget_ms: int
    registers: Sequence[tuple[int, bytes]]


def _mode(max_m: float, nothing_m: float, budget_ms: int, texts: str, times: tuple[int, int]) -> Mode:
    places = (0x004B, 0x0060, 0x0063, 0x0069, 0x0078, 0x007A)
    registers = [(place, bytes.fromhex(text)) for place, text in zip(places, texts.split(), strict=True)]
    first, second = (struct.pack(">H", each) for each in times)
    return Mode(max_m, nothing_m, budget_ms, (*registers, (0x005E, first), (0x0061, second)))


SHORT = _mode(1.3, math.inf, 50, "14 07 05 38 0705 0606", (0x01AE, 0x01E8))
LONG = _mode(4.0, math.nan, 100, "0a 0f 0d b8 0f0d 0e0e", (0x01CC, 0x01EA))
SPARE_MS = 2
"""Between two measurements: the interval must not be shorter than a measurement."""

VALID, BELOW, SIGNAL, BOUNDS = 9, 8, 4, 5
MEASURED_NOTHING = frozenset({6, 7, 19, 18, 12, 13, 22, 23})
"""Sigma too large, wrapped around, not checked for that (the first), not synchronised (the first), cross talk, ...: of
such a measurement nothing follows. All other states mean that the sensor has failed."""


def read_from(register: int) -> bytes:
    """Return what is written to read from a register on."""
    return struct.pack(">H", register)


def write_to(register: int, data: bytes) -> bytes:
    """Return what is written to set registers."""
    return struct.pack(">H", register) + data


def measuring(mode: Mode, roi: int, clock: bytes, centre: bytes) -> Sequence[tuple[int, bytes]]:
    """Return what makes a sensor that is warm measure again and again.

    Parameters
    ----------
    clock : two bytes of `CLOCK`
    centre : byte of `ROI_CENTRE`, where this sensor's own optical centre is
    """
    ticks = int((int.from_bytes(clock, "big") & 0x3FF) * (mode.budget_ms + SPARE_MS) * 1.075)
    side = roi - 1
    region = (0x007F, (b"\xc7" if roi > 10 else centre) + bytes([side << 4 | side]))
    return (*mode.registers, region, (INTERVAL, struct.pack(">I", ticks)), CLEAR, START)


@dataclass(frozen=True, slots=True)
class Result:
    """One measurement: its number, modulo 256, and the distance as in ``RangeScan``; None: the sensor has failed."""

    number: int
    distance_m: float | None


def decode(block: bytes, mode: Mode, max_m: float) -> Result:
    """Return what `RESULT_BYTES` from `RESULT` on say.

    A target nearer than the sensor's own offset is at 0. Neither enough light nor a phase in bounds: there is no target
    in the mode's range.
    """
    state, number = block[0] & 0x1F, block[2]
    distance_m = int.from_bytes(block[13:15], "big") / 1000.0
    if state == VALID:
        return Result(number, distance_m if distance_m <= max_m else math.inf)
    if state == BELOW:
        return Result(number, 0.0)
    if state in (SIGNAL, BOUNDS):
        return Result(number, mode.nothing_m)
    return Result(number, math.nan if state in MEASURED_NOTHING else None)
