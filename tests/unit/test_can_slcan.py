"""Frames as lines of text, and the adapter that reads them."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.drivers.can import slcan
from fullswarm.drivers.can.protocol import Frame
from fullswarm.emulators.can.firmware import Adapter

MILLION = 1_000_000

sound = st.builds(
    lambda extended, number, data, remote: Frame(
        number if extended else number & 0x7FF, extended, b"" if remote else data, remote
    ),
    st.booleans(), st.integers(0, (1 << 29) - 1), st.binary(max_size=8), st.booleans(),
)  # fmt: skip


@given(st.lists(sound, max_size=20), st.lists(st.integers(1, 40), min_size=1))
def test_lines_round_trip_however_they_are_cut(sent: list[Frame], cuts: list[int]) -> None:
    stream = b"".join(map(slcan.encode, sent))
    lines, heard, at = slcan.Lines(), [], 0
    while at < len(stream):
        cut = cuts[at % len(cuts)]
        heard += [slcan.decode(line) for line in lines.feed(stream[at : at + cut])]
        at += cut
    assert heard == sent


@pytest.mark.parametrize(
    "line",
    [
        b"", b"t", b"t123", b"t1239", b"t12310", b"t123100 ", b"t1231000", b"t+120", b"t 120", b"t1_20", b"t8000",
        b"T200000000", b"T1234567", b"r123100", b"R0000012311", b"t123100\n", b"x0000012300", b"d1230", b"t123\xb20",
    ],
)  # fmt: skip
def test_what_is_no_frame(line: bytes) -> None:
    assert slcan.decode(line) is None


@pytest.mark.slow
def test_a_million_bytes_slcan() -> None:
    fuzz_slcan(MILLION)


def test_some_bytes_slcan() -> None:
    fuzz_slcan(30_000)


def fuzz_slcan(count: int) -> None:
    """Frames as lines, half of them mangled in one place: what is taken for a frame must be exactly its line."""
    chance = random.Random(3)
    lines, fed, accepted, refused = slcan.Lines(), 0, 0, 0
    while fed < count:
        text = bytearray(slcan.encode(random_frame(chance)))
        if chance.random() < 0.5:
            at = chance.randrange(len(text))
            text[at : at + chance.randrange(3)] = chance.randbytes(chance.randrange(3))
        fed += len(text)
        for line in lines.feed(bytes(text)):
            frame = slcan.decode(line)
            accepted, refused = accepted + (frame is not None), refused + (frame is None)
            assert frame is None or same_line(frame, line), (frame, line)
    assert accepted > count // 100
    assert refused > count // 200
    assert lines.feed(b"\rt1230\r")[-1] == b"t1230"  # in step again


def random_frame(chance: random.Random) -> Frame:
    extended, remote = chance.random() < 0.5, chance.random() < 0.2
    data = b"" if remote else chance.randbytes(chance.randrange(9))
    return Frame(chance.getrandbits(29 if extended else 11), extended, data, remote)


def same_line(frame: Frame, line: bytes) -> bool:
    again, head = slcan.encode(frame)[:-1], 9 if frame.extended else 4
    if frame.remote:  # it has a length, but no data
        return again[:1] == line[:1] and again[:head].upper() == line[:head].upper() and len(line) == head + 1
    return again[:1] == line[:1] and again.upper() == line.upper()


@given(st.binary(max_size=300))
def test_no_bytes_make_an_adapter_raise_or_send(data: bytes) -> None:
    adapter = Adapter(250_000)
    assert adapter.receive(data.replace(b"S", b"s"))[1] == []
    assert not adapter.is_open


def test_an_adapter_answers_as_a_lawicel() -> None:
    adapter = Adapter(250_000)
    frame = Frame(0x29, False, b"12345678")
    for command, answer in [
        (b"C", b"\r"), (b"O", b"\a"), (b"t1230", b"\a"), (b"S5", b"\r"), (b"Z0", b"\r"), (b"Z1", b"\a"),
        (b"V", b"V1013\r"), (b"N", b"NA123\r"), (b"O", b"\r"), (b"S6", b"\a"), (b"F", b"F00\r"), (b"t1230", b"z\r"),
        (b"T000001230", b"Z\r"),
        (b"r1238", b"z\r"), (b"R000001230", b"Z\r"), (b"t123", b"\a"), (b"C", b"\r"),
    ]:  # fmt: skip
        assert adapter.receive(command + b"\r")[0] == answer, command
    assert adapter.deliver(frame) == b""
    assert adapter.receive(b"O\rt0292ABCD\r") == (b"\rz\r", [Frame(0x29, False, b"\xab\xcd")])
    assert adapter.deliver(frame) == b"t02983132333435363738\r"
    assert slcan.Lines().feed(b"x" * 1000 + b"\rt0010\r") == [b"t0010"]


def test_an_adapter_with_the_wrong_bitrate_hears_nobody() -> None:
    adapter = Adapter(250_000)
    assert adapter.receive(b"S6\rO\rt1230\r") == (b"\r\rz\r", [])
    assert adapter.deliver(Frame(1, False)) == b""
