"""A million bytes of noise, and of a damaged stream, into each parser: no exception, and few false frames.

A frame has an 8-bit checksum, so of the places in noise that look like one, 1 in 256 passes (2 in 256 where both
checksums count). No parser of this protocol can do better on the sum alone; the bounds below are that expectation
plus five standard deviations. The parser that a driver uses also knows which ids it has asked for: between two false
frames of its list in noise lie some 256 ** (3 + ids) bytes.
"""

from __future__ import annotations

import math
import random

import pytest

from fullswarm.drivers.create_oi import protocol
from fullswarm.drivers.create_oi.protocol import (
    CREATE1,
    CREATE2,
    HEADER,
    CommandParser,
    Generation,
    Mode,
    Op,
    Sensors,
    StreamParser,
)
from fullswarm.drivers.create_oi.senses import stream_ids
from fullswarm.emulators.create_oi.firmware import Firmware
from fullswarm.simulation.bodies import FreeBody

COUNT = 1_000_000
IDS = stream_ids(CREATE2, CREATE2.baud)


def at_most(expected: float) -> float:
    return expected + 5.0 * math.sqrt(expected)


def pieces(data: bytes, seed: int) -> list[bytes]:
    """Cut as a port would: anywhere."""
    luck, start, cut = random.Random(seed), 0, []
    while start < len(data):
        size = luck.choice((1, 3, 17, 64, 512))
        cut.append(data[start : start + size])
        start += size
    return cut


@pytest.mark.parametrize("both", [False, True])
def test_noise_makes_no_more_frames_than_its_checksum_lets_through(both: bool) -> None:
    noise = random.Random(3).randbytes(COUNT)
    parser, frames = StreamParser(both_checksums=both), 0
    for piece in pieces(noise, 4):
        frames += len(parser.feed(piece))
    # Far fewer in fact: lengths and ids have to fit as well.
    assert frames <= at_most(noise.count(HEADER) * (2 if both else 1) / 256)
    parser.feed(bytes(300))
    assert len(parser.feed(protocol.frame(IDS, {"mode": 2}))) == 1  # and it hears on


@pytest.mark.parametrize("both", [False, True])
def test_of_well_formed_nonsense_one_in_256_passes(both: bool) -> None:
    """Header, length and ids as asked for, the rest noise: only the sum is left to tell."""
    luck, parser = random.Random(13), StreamParser(IDS, both_checksums=both)
    good = protocol.frame(IDS, {})
    fixed = [0, 1]
    place = 2
    for each in IDS:
        fixed.append(place)
        place += 1 + protocol.SIZES[each]
    tried = COUNT // len(good)
    frames = 0
    for _ in range(tried):
        noise = bytearray(luck.randbytes(len(good)))
        for each in fixed:
            noise[each] = good[each]
        frames += len(parser.feed(bytes(noise)))
    expected = tried * (2 if both else 1) / 256
    assert 2 * expected - at_most(expected) < frames <= at_most(expected)


def test_noise_makes_no_frame_of_the_list_that_was_asked_for() -> None:
    parser = StreamParser(IDS, both_checksums=True)
    noise = random.Random(5).randbytes(COUNT)
    assert sum(len(parser.feed(piece)) for piece in pieces(noise, 6)) == 0
    assert parser.skipped > COUNT - 300


def truth(luck: random.Random) -> dict[str, int]:
    return {"encoder_left": luck.randrange(65536), "encoder_right": luck.randrange(65536), "mode": 2,
            "charge_mah": luck.randrange(65536), "left_mm_s": luck.randrange(-500, 501)}  # fmt: skip


def damaged(luck: random.Random, good: bytes) -> bytes:
    """Return a frame as a bad wire might: bytes replaced, lost, doubled, put in."""
    bad = bytearray(good)
    for _ in range(luck.choice((1, 2, 2, 5))):
        place, kind = luck.randrange(len(bad)), luck.randrange(4)
        if kind == 0:
            bad[place] = luck.randrange(256)
        elif kind == 1 and len(bad) > 1:
            del bad[place]
        elif kind == 2:
            bad.insert(place, luck.randrange(256))
        else:
            bad[place] ^= 1 << luck.randrange(8)
    return bytes(bad)


def test_a_damaged_stream_gives_true_frames_and_few_false_ones() -> None:
    luck, parser = random.Random(7), StreamParser(IDS)
    sent: list[Sensors] = []
    bytes_sent = whole = hurt = true = false = 0
    while bytes_sent < COUNT:
        values = truth(luck)
        frame = protocol.frame(IDS, values)
        told = Sensors(**{protocol.PACKETS[each].name: values.get(protocol.PACKETS[each].name, 0) for each in IDS})
        sent = [told, *sent[:1]]  # the one before may have been held back
        if luck.random() < 0.5:
            frame = damaged(luck, frame)
            hurt += 1
        else:
            whole += 1
        bytes_sent += len(frame)
        for found in parser.feed(frame):
            true += found.sensors in sent
            false += found.sensors not in sent
    assert false <= at_most(hurt / 256)
    # A damaged frame may take the next one with it while the parser waits for the rest of it, but no more.
    assert true > whole - hurt


def test_a_single_wrong_bit_never_passes() -> None:
    good = protocol.frame(IDS, {"encoder_left": 12345, "mode": 2})
    for bit in range(8 * len(good)):
        bad = bytearray(good)
        bad[bit // 8] ^= 1 << bit % 8
        assert not StreamParser(IDS).feed(bytes(bad))


@pytest.mark.parametrize("generation", [CREATE1, CREATE2])
def test_a_million_bytes_of_commands(generation: Generation) -> None:
    parser, commands = CommandParser(generation), 0
    for byte in random.Random(9).randbytes(COUNT):
        if (command := parser.push(byte)) is not None:
            commands += 1
            assert len(command.data) <= 2 + 2 * 255
    assert commands > 1000
    for _ in range(600):  # however long the last command was
        parser.push(0)
    assert parser.push(Op.START) is not None


@pytest.mark.parametrize("generation", [CREATE1, CREATE2])
def test_a_robot_survives_whatever_it_is_told(generation: Generation) -> None:
    luck, robot = random.Random(11), Firmware(generation, FreeBody())
    asleep = 0
    for step in range(2000):
        said = robot.receive(bytes([Op.START, Op.SAFE]) + luck.randbytes(100), 0.015 * step)
        said += robot.step(0.015 * step)
        assert isinstance(said, bytes)
        asleep += robot.asleep
        if robot.asleep:
            robot.brc(0.015 * step)
    robot.reboot(31.0)
    robot.step(33.0)
    robot.receive(bytes([Op.START, Op.SAFE]), 33.0)
    assert robot.mode is Mode.SAFE
    assert asleep > 0 or generation is CREATE1
