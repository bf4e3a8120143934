"""The stream parser: cuts, noise and damage cost no more than what they hit."""

from __future__ import annotations

import math
import random

from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.drivers.mavlink import codec
from fullswarm.drivers.mavlink.codec import StreamParser, decode, dialect
from tests.unit.mavlink_frames import rover, station


def test_console_text_between_frames_is_skipped() -> None:
    encoder = station()
    stream = b"Init Gyro**\n" + encoder.arm(True) + b"AP_Logger_File: x\n\xfd\xfe" + encoder.drive(0.5, 0.1)
    messages = StreamParser().feed(stream + encoder.heartbeat())
    assert [m.get_type() for m in messages] == ["COMMAND_LONG", "SET_POSITION_TARGET_LOCAL_NED", "HEARTBEAT"]


@given(st.lists(st.integers(0, 60), max_size=30), st.binary(max_size=40))
def test_any_cut_of_the_stream_gives_the_same_messages(cuts: list[int], noise: bytes) -> None:
    encoder = station()
    clean = [encoder.arm(True), encoder.drive(0.3, -0.2), encoder.heartbeat(), encoder.set_mode(4)]
    stream = noise.replace(b"\xfd", b"").replace(b"\xfe", b"").join(clean)
    parser, got, at = StreamParser(), [], 0
    for length in cuts:
        got += parser.feed(stream[at : at + length])
        at += length
    got += parser.feed(stream[at:])
    assert [m.get_type() for m in got] == [
        "COMMAND_LONG", "SET_POSITION_TARGET_LOCAL_NED", "HEARTBEAT", "COMMAND_LONG",
    ]  # fmt: skip


def test_a_damaged_frame_costs_only_itself() -> None:
    encoder = station()
    damaged = bytearray(encoder.drive(0.5, 0.0))
    damaged[15] ^= 0x40
    messages = StreamParser().feed(bytes(damaged) + encoder.arm(False))
    assert [m.get_type() for m in messages] == ["COMMAND_LONG"]


def test_a_stray_marker_does_not_swallow_the_frames_behind_it() -> None:
    encoder = station()
    assert [m.get_type() for m in StreamParser().feed(b"\xfd\xff\x07" + encoder.arm(False))] == ["COMMAND_LONG"]


def test_a_false_header_does_not_swallow_the_frames_behind_it() -> None:
    encoder = station()
    false_header = bytes([0xFD, 40, 0, 0, 9, 1, 1, 0, 0, 0])  # a HEARTBEAT of 40 bytes, says noise
    messages = StreamParser().feed(false_header + encoder.arm(False) + encoder.drive(0.1, 0.0))
    assert [m.get_type() for m in messages] == ["COMMAND_LONG", "SET_POSITION_TARGET_LOCAL_NED"]


def wrongly_accepted(stream: bytes, right: frozenset[bytes]) -> tuple[int, int]:
    """Feed a stream in pieces; return how many wrong frames were taken for right, and how many were tried."""
    parser, wrong = StreamParser(), 0
    for at in range(0, len(stream), 777):
        for message in parser.feed(stream[at : at + 777]):
            decode(message)
            wrong += bytes(message.get_msgbuf()) not in right
    beat = station().heartbeat()
    heard = [m.get_type() for _ in range(40) for m in parser.feed(beat)]
    assert heard.count("HEARTBEAT") >= 24  # what noise at the end announced has swallowed a few at most
    return wrong, wrong + parser.bad_checksums


def few_enough(wrong: int, tried: int) -> bool:
    """Whether 16 bits of checksum explain it: one in 65 536 passes; six standard deviations and three more."""
    expected = tried / 65536
    return wrong <= expected + 6.0 * math.sqrt(expected) + 3.0


def test_500_000_random_bytes_never_raise() -> None:
    generator = random.Random(5)
    noise = bytearray(generator.randbytes(500_000))
    for at in range(0, len(noise) - 10, 40):  # plausible headers of many kinds, or next to nothing would be tried
        noise[at : at + 10] = bytes((0xFD, noise[at] % 60, 0, 0, at % 256, 1, 1, noise[at + 1] % 150, 0, 0))
    wrong, tried = wrongly_accepted(bytes(noise), frozenset())
    assert tried > 5_000
    assert few_enough(wrong, tried)


def test_500_000_bytes_of_damaged_frames_never_raise() -> None:
    generator, encoder = random.Random(7), rover()
    frames = []
    for index in range(6_000):
        make = (
            dialect().MAVLink_local_position_ned_message(index, generator.random(), 1.0, 2.0, 0.1, 0.2, 0.3),
            dialect().MAVLink_attitude_message(index, 0.1, 0.2, generator.random(), 0.0, 0.0, 0.5),
            dialect().MAVLink_heartbeat_message(10, 3, 129, 15, 4, 3),
            dialect().MAVLink_statustext_message(4, b"EKF3 IMU0 is using GPS", 0, 0),
        )
        frames.append(encoder.pack(make[index % 4]))
    stream = bytearray()
    while len(stream) < 500_000:
        frame = bytearray(generator.choice(frames))
        match generator.randrange(5):
            case 0:
                frame[generator.randrange(len(frame))] ^= 1 << generator.randrange(8)
            case 1:
                del frame[generator.randrange(len(frame)) :]
            case 2:
                frame.insert(generator.randrange(len(frame)), generator.randrange(256))
            case 3:
                at = generator.randrange(len(frame))
                frame[at : at + 4] = generator.randbytes(4)
        stream += frame
    wrong, tried = wrongly_accepted(bytes(stream), frozenset(frames))
    assert tried > 2_000
    assert few_enough(wrong, tried)


def test_what_nobody_wants_is_checked_but_not_unpacked() -> None:
    wanted = codec.decoded_ids()
    frame = rover().pack(dialect().MAVLink_vibration_message(0, 0.0, 0.0, 0.0, 0, 0, 0))
    beat = rover().pack(dialect().MAVLink_heartbeat_message(10, 3, 129, 15, 4, 3))
    parser = StreamParser(wanted)
    assert [m.get_type() for m in parser.feed(frame + beat)] == ["HEARTBEAT"]
    assert (parser.skipped_bytes, parser.bad_checksums) == (0, 0)
    assert parser.feed(frame[:-1] + bytes((frame[-1] ^ 1,))) == []
    assert parser.bad_checksums == 1
    assert {0, 30, 32, 77, 147, 193, 230, 253} <= wanted


@settings(max_examples=50)
@given(st.binary(min_size=0, max_size=400))
def test_a_flipped_real_frame_never_raises(noise: bytes) -> None:
    parser = StreamParser()
    for message in parser.feed(b"\xfd\x09\x00\x00" + noise + station().heartbeat() + noise):
        decode(message)
