"""Every message of both makes both ways, against the makers' own tables where there are any."""

from __future__ import annotations

import dataclasses
import math
import random
import struct
from typing import Any, get_type_hints

import cantools
import pytest
from hypothesis import given
from hypothesis import strategies as st
from odrive_can.utils import get_dbc_path

from fullswarm.drivers.can import odrive, vesc
from fullswarm.drivers.can.layout import Layout, Table
from fullswarm.drivers.can.odrive import Firmware
from fullswarm.drivers.can.protocol import Frame

FIRMWARES: tuple[Firmware, ...] = ("0.5", "0.6")
DBC = {"0.5": "odrive-cansimple-0.5.6", "0.6": "odrive-cansimple-0.6.10"}
NODE = 3
MILLION = 1_000_000

INTEGERS = {
    "B": (0, 2**8 - 1), "H": (0, 2**16 - 1), "I": (0, 2**32 - 1), "Q": (0, 2**64 - 1),
    "h": (-(2**15), 2**15 - 1), "i": (-(2**31), 2**31 - 1),
}  # fmt: skip


def field(code: str, scale: float, unknown: bool) -> st.SearchStrategy[object]:
    """Return values that a field of this code can carry without loss."""
    if code == "f":
        floats = st.floats(width=32, allow_nan=False, allow_infinity=False)
        return st.none() | floats if unknown else floats
    if code == "s":
        return st.binary(min_size=6, max_size=6)
    whole = st.integers(*INTEGERS[code])
    return whole if scale == 1.0 else whole.map(lambda count: count / scale)


def messages(table: Table[Any]) -> st.SearchStrategy[Any]:
    def of(layout: Layout) -> st.SearchStrategy[Any]:
        codes = [code for code in layout.format.lstrip("<>").replace("6s", "s") if code != "x"]
        scales = layout.scales or (1.0,) * len(codes)
        fields = (field(code, scale, layout.unknown) for code, scale in zip(codes, scales, strict=True))
        return st.builds(layout.kind, *fields)

    return st.one_of([of(layout) for layout in table.by_command.values()])


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_each_odrive_message_round_trips(firmware: Firmware) -> None:
    @given(st.integers(0, odrive.MAX_NODE), messages(odrive.TABLES[firmware]))
    def check(node: int, message: object) -> None:
        frame = odrive.encode(node, message, firmware)
        assert frame.id >> 5 == node
        assert odrive.decode(frame, firmware) == message
        assert not frame.extended

    check()


@given(st.integers(0, 255), messages(vesc.TABLE))
def test_each_vesc_message_round_trips(node: int, message: object) -> None:
    frame = vesc.encode(node, message)
    assert (frame.id & 0xFF, frame.extended) == (node, True)
    assert vesc.decode(frame) == message


def test_all_messages_of_the_protocols_are_there() -> None:
    both = {0x02, 0x07, 0x09, 0x0B, 0x0C, 0x0D, 0x0E, 0x0F, 0x14, 0x16, 0x17, 0x18, 0x19, 0x1A, 0x1B, 0x01, 0x03, 0x06}
    assert both | {0x0A} <= odrive.TABLES["0.5"].by_command.keys()
    assert both | {0x00, 0x15, 0x1C} <= odrive.TABLES["0.6"].by_command.keys()
    assert {0, 1, 2, 3, 4, 10, 11, 12, 13, 9, 14, 15, 16, 27, 58, 17, 18} == vesc.TABLE.by_command.keys()


@pytest.mark.parametrize("table", [*odrive.TABLES.values(), vesc.TABLE])
def test_formats_fit_their_messages(table: Table[Any]) -> None:
    for layout in table.by_command.values():
        size = struct.calcsize(layout.format or "<")
        assert (layout.least or 0) <= size <= 8
        hints = get_type_hints(layout.kind)
        fields = dataclasses.fields(layout.kind)
        codes = [code for code in layout.format.lstrip("<>").replace("6s", "s") if code != "x"]
        assert len(codes) <= len(fields)
        for code, scale, each in zip(codes, layout.scales or (1.0,) * 8, fields, strict=False):
            is_whole = code not in "fs" and scale == 1.0
            assert (hints[each.name] is int) == is_whole, f"{layout.kind.__name__}.{each.name}"


# ---------------------------------------------------------------- the makers' tables
def our_values(message: Any) -> list[Any]:
    """Return the fields that are no bytes of flags."""
    names = (each.name for each in dataclasses.fields(message) if "flags" not in each.name)
    values = (getattr(message, name) for name in names)
    return [int.from_bytes(value, "little") if isinstance(value, bytes) else value for value in values]


def their_values(theirs: Any, data: bytes) -> list[Any]:
    """Return the signals that are no flags, in the order of their bits."""
    values = theirs.decode(data, decode_choices=False)
    names = (signal.name for signal in sorted(theirs.signals, key=lambda signal: signal.start))
    return [values[name] for name in names if "Flag" not in name]


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_odrive_agrees_with_the_makers_dbc(firmware: Firmware) -> None:
    """Values by the order of their bits; a flag of the DBC is a bit of our flag bytes."""
    database = cantools.database.load_file(get_dbc_path(DBC[firmware]))
    assert isinstance(database, cantools.database.Database)
    chance = random.Random(5)
    compared = set()
    for command, layout in odrive.TABLES[firmware].by_command.items():
        if firmware == "0.5" and command == 0x02:
            continue  # the DBC of 0.5.6 forgot the e-stop
        theirs = database.get_message_by_frame_id(NODE << 5 | command)
        if any(signal.is_multiplexer for signal in theirs.signals):
            continue  # parameter frames: only ids, no values of ours
        for _ in range(50):
            data = b"".join(
                struct.pack("<f", chance.uniform(-1e3, 1e3)) if code == "f" else chance.randbytes(struct.calcsize(code))
                for code in layout.format.lstrip("<").replace("6s", "BBBBBB")
            ).ljust(8, b"\0")
            ours = odrive.decode(Frame(NODE << 5 | command, False, data), firmware)
            mine, in_order = our_values(ours), their_values(theirs, data)
            if command == 0x03 and firmware == "0.5":
                mine = [value & 0xFFFFFFFF for value in mine]  # the DBC knows half of the word
            if isinstance(ours, odrive.EncoderCount):
                mine = [value % 2**32 for value in mine]  # and forgot the sign here
            assert mine[: len(in_order)] == pytest.approx(in_order), layout.kind.__name__
        compared.add(command)
    assert len(compared) >= len(odrive.TABLES[firmware].by_command) - 2


@pytest.mark.parametrize(
    ("message", "data"),
    [
        (vesc.SetDuty(-0.5), "ffff3cb0"),
        (vesc.SetPosition(90.0), "055d4a80"),
        (vesc.SetRelativeCurrent(1.0), "000186a0"),
        (vesc.SetHandbrake(2.5), "000009c4"),
        (vesc.Status4(35.0, -10.0, 1.5, 180.0), "015eff9c000f2328"),
        (vesc.Status6(1.5, 3.3, 0.0, -1.0), "05dc0ce40000fc18"),
        (vesc.Status2(1.25, 0.5), "000030d400001388"),
        (vesc.Status5(-1, 24.3), "ffffffff00f30000"),
    ],
)
def test_vesc_bytes(message: object, data: str) -> None:
    assert vesc.encode(7, message).data.hex() == data


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="does not fit"):
        odrive.encode(1, odrive.SetVelocity(1e39))
    with pytest.raises(ValueError, match="does not fit"):
        vesc.encode(1, vesc.SetCurrent(1e9))
    with pytest.raises(KeyError):
        odrive.encode(1, odrive.Version(2, 0, 0, 0, 0, 6, 10), "0.5")


def test_missing_temperatures_are_none() -> None:
    frame = Frame(1 << 5 | 0x15, False, struct.pack("<ff", 35.0, math.nan))
    assert odrive.decode(frame) == odrive.Temperature(35.0, None)
    assert odrive.decode(dataclasses.replace(frame, data=struct.pack("<ff", math.inf, 0.0))) is None


# ---------------------------------------------------------------- a million of each
def random_frames(count: int, seed: int) -> list[tuple[int, bytes]]:
    chance = random.Random(seed)
    pool = chance.randbytes(count + 16)
    return [(chance.getrandbits(5), pool[at : at + (at * 7) % 10]) for at in range(count)]


def finite(layout: Layout, data: bytes) -> bool:
    """Tell, without the codec's code, whether all floats of the data are finite (or NaN where that is allowed)."""
    at, codes = 0, layout.format.lstrip("<").replace("6s", "BBBBBB")
    for code in codes:
        if code == "f":
            word = int.from_bytes(data[at : at + 4].ljust(4, b"\0"), "little")
            if word >> 23 & 0xFF == 0xFF and not (layout.unknown and word & 0x7FFFFF):
                return False
        at += struct.calcsize(code)
    return True


@pytest.mark.slow
@pytest.mark.parametrize("firmware", FIRMWARES)
def test_a_million_frames_odrive(firmware: Firmware) -> None:
    fuzz_odrive(firmware, MILLION)


@pytest.mark.parametrize("firmware", FIRMWARES)
def test_some_frames_odrive(firmware: Firmware) -> None:
    fuzz_odrive(firmware, 20_000)


def fuzz_odrive(firmware: Firmware, count: int) -> None:
    table = odrive.TABLES[firmware].by_command
    accepted = 0
    for command, data in random_frames(count, 1):
        message = odrive.decode(Frame(NODE << 5 | command, False, data), firmware)
        layout = table.get(command)
        size = struct.calcsize(layout.format or "<") if layout else 0
        least = size if layout is None or layout.least is None else layout.least
        right = layout is not None and least <= len(data) <= 8 and finite(layout, data[:size])
        assert (message is not None) == right, (command, data, message)
        accepted += right
    assert accepted > count // 10


@pytest.mark.slow
def test_a_million_frames_vesc() -> None:
    fuzz_vesc(MILLION)


def test_some_frames_vesc() -> None:
    fuzz_vesc(20_000)


def fuzz_vesc(count: int) -> None:
    lengths = dict.fromkeys(vesc.ORDERS, (4, 4)) | dict.fromkeys((9, 14, 15, 16, 58), (8, 8)) | {
        27: (6, 8), 17: (1, 8), 18: (1, 8),
    }  # fmt: skip
    accepted = 0
    for command, data in random_frames(count, 2):
        least, most = lengths.get(command, (9, 0))
        message = vesc.decode(Frame(command << 8 | NODE, True, data))
        assert (message is not None) == (least <= len(data) <= most)
        accepted += message is not None
    assert accepted > count // 20
