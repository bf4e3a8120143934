"""Bytes of lidars into turns: against the emulated ones, which share no code with it, and against noise."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.drivers.lidar.protocol import MOST_POINTS, Codec, LdCodec, RplidarCodec, Turn, crc8
from fullswarm.drivers.lidar.settings import KINDS, parse_url
from fullswarm.emulators.lidar.emulator import FIRMWARE
from fullswarm.errors import ConfigError

CODECS: dict[str, type[LdCodec] | type[RplidarCodec]] = {"ld19": LdCodec, "rplidar": RplidarCodec}


def room(angle_rad: float) -> float:
    """A round room of 2 m with a pillar to the left, and nothing at all behind."""
    angle = math.remainder(angle_rad, math.tau)
    return 0.8 if abs(angle - math.pi / 2.0) < 0.1 else math.inf if abs(angle) > 3.0 else 2.0


def stream(kind: str, seconds: float) -> tuple[Codec, bytes]:
    """Return a codec, and what a lidar sends that has taken its requests."""
    codec, lidar = CODECS[kind](), FIRMWARE[kind](room)
    lidar.receive(codec.begin(), 0.0, 0)
    sent, now_s = b"".join(lidar.take(0)), 0.0
    while now_s < seconds:
        lidar.step(now_s)
        sent += b"".join(lidar.take(0))
        now_s += 0.02
    return codec, sent


def check(turn: Turn) -> None:
    angles = np.array([math.remainder(each, math.tau) for each in turn.angles_rad])
    for angle, away_m in zip(angles, turn.distances_m, strict=True):
        expected = room(angle)
        edge = min(abs(abs(angle - math.pi / 2.0) - 0.1), abs(abs(angle) - 3.0)) < 0.02
        if not edge:
            assert math.isnan(away_m) if math.isinf(expected) else away_m == pytest.approx(expected, abs=0.001)


@pytest.mark.parametrize("kind", CODECS)
def test_turns_are_what_the_lidar_saw_however_the_bytes_are_cut(kind: str) -> None:
    codec, sent = stream(kind, 1.5)
    turns: list[Turn] = []
    pieces, at = random.Random(3), 0
    while at < len(sent):
        size = pieces.randrange(1, 90)
        turns += codec.take(sent[at : at + size])
        at += size
    assert codec.bad == 0
    assert len(turns) >= (1.5 / FIRMWARE[kind].turn_s) // 1 - 3
    for turn in turns:
        assert len(turn.angles_rad) == pytest.approx(FIRMWARE[kind].points, abs=12)
        check(turn)


@pytest.mark.parametrize("kind", CODECS)
@given(data=st.data())
@settings(max_examples=25, deadline=None)
def test_noise_in_the_stream_costs_points_and_nothing_else(kind: str, data: st.DataObject) -> None:
    codec, sent = stream(kind, 0.8)
    mangled = bytearray(sent)
    for _ in range(data.draw(st.integers(0, 20))):
        at = data.draw(st.integers(20, len(mangled) - 1))
        mangled[at : at + data.draw(st.integers(0, 3))] = data.draw(st.binary(max_size=40))
    for turn in codec.take(bytes(mangled)):
        assert len(turn.angles_rad) < MOST_POINTS
        assert np.isfinite(turn.angles_rad).all()
        assert not (turn.distances_m < 0.0).any()
        if kind == "ld19":  # each packet has a sum; nodes of an RPLIDAR have two bits
            check(turn)


@pytest.mark.parametrize("kind", CODECS)
@given(st.lists(st.binary(max_size=400), max_size=30))
@settings(max_examples=40, deadline=None)
def test_garbage_fills_no_memory_and_raises_nothing(kind: str, chunks: list[bytes]) -> None:
    codec = CODECS[kind]()
    codec.begin()
    for chunk in chunks:
        codec.take(chunk)
        assert len(codec._rest) < 1000


def test_one_that_never_turns_on_fills_no_memory() -> None:
    codec, lidar = RplidarCodec(), FIRMWARE["rplidar"](room)
    lidar.receive(codec.begin(), 0.0, 0)
    codec.take(b"".join(lidar.take(0)))
    node = bytes([47 << 2 | 2, 1, 0, 0, 8])
    for _ in range(20):
        assert codec.take(500 * node) == []
    assert len(codec._turning._points) == MOST_POINTS


def test_the_sum_is_that_of_the_makers_table() -> None:
    assert [crc8(bytes([each])) for each in range(5)] == [0x00, 0x4D, 0x9A, 0xD7, 0x79]


def test_urls() -> None:
    found = parse_url("rplidar:///dev/ttyUSB0?baud=256000&at=0.1,-0.02,1.571&flipped=1&max=8&least=0&name=top")
    assert (found.path, found.baud, found.at.heading_rad, found.flipped) == ("/dev/ttyUSB0", 256_000, 1.571, True)
    assert (found.max_m, found.least, found.name, found.kind) == (8.0, 0.0, "top", KINDS["rplidar"])
    found = parse_url("ld19://10.0.0.5:4001")
    assert (found.where, found.kind.codec(0).baud) == ("tcp 10.0.0.5:4001", 230_400)
    for url, what in (
        ("ld20:///dev/x", "no lidar 'ld20'"), ("ld19://", "no port"), ("ld19:///dev/x?bad=1", "unknown option 'bad'"),
        ("ld19:///dev/x?at=1,2", "no place"), ("ld19:///dev/x?max=-1", "max '-1'"), ("ld19://host/dev/x", "an address"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=what):
            parse_url(url)
