"""The bytes of lidars: what is encoded comes back, damage costs points and never makes wrong ones."""

from __future__ import annotations

import math
import struct
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.drivers.lidar import protocol
from fullswarm.drivers.lidar.protocol import GAP, Answer, Gap, LdParser, Parser, Point, RplidarParser, Turns

PACKET = bytes.fromhex(  # the example of the LD19 development manual
    "542c6808ab7ee000e4dc00e2d900e5d500e3d300e4d000e9cd00e4ca00e2c700e9c500e5c200e5c000e5be823a1a50"
)
distances = st.integers(0, 12_000)
packets = st.builds(
    lambda first, points: protocol.ld_packet(3600, first, first + 8.8, points, 7),
    st.integers(0, 35_999).map(lambda each: each / 100.0),
    st.lists(st.tuples(distances, st.integers(0, 255)), min_size=12, max_size=12),
)


def fed(parser: Parser, data: bytes, cuts: list[int] | None = None) -> list[Point | Gap | Answer]:
    """Feed in pieces that end at `cuts`."""
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts or []), len(data)]
    return [each for low, high in pairwise(edges) for each in parser.feed(data[low:high])]


def test_the_packet_of_the_manual() -> None:
    points = [tuple(each) for each in fed(LdParser(), PACKET)]
    assert len(points) == 12
    assert points[0] == pytest.approx((324.27, 0.224))
    assert points[-1] == pytest.approx((334.7, 0.192))


@given(st.lists(packets, max_size=5), st.lists(st.integers(0, 300), max_size=8), st.binary(max_size=60))
def test_packets_come_back_whatever_the_pieces_and_the_bytes_before(
    sent: list[bytes], cuts: list[int], noise: bytes
) -> None:
    alone = [point for each in sent for point in fed(LdParser(), each)]
    assert len(alone) == 12 * len(sent)
    # A header in the noise swallows nothing, for a wrong checksum sends the search back to the next byte.
    found = fed(LdParser(), noise + b"".join(sent) + bytes(protocol.LD_SIZE), cuts)
    assert found == alone


@given(packets, st.integers(0, 46), st.integers(1, 255))
def test_a_damaged_packet_gives_no_point(packet: bytes, place: int, flip: int) -> None:
    damaged = bytearray(packet)
    damaged[place] ^= flip
    parser = LdParser()
    assert fed(parser, bytes(damaged) + bytes(protocol.LD_SIZE)) == []
    assert parser.damaged > 0 or place < 2


@given(st.sampled_from([LdParser, RplidarParser]), st.lists(st.binary(max_size=600), max_size=12), st.booleans())
def test_no_bytes_break_a_parser_or_fill_it(
    make: type[LdParser | RplidarParser], chunks: list[bytes], scanning: bool
) -> None:
    parser = make()
    if scanning:
        list(parser.feed(protocol.scanning()))
    for chunk in chunks:
        for each in parser.feed(chunk):
            assert not isinstance(each, Point) or (0.0 <= each.angle_deg < 360.0 and each.distance_m >= 0.0)
        assert len(parser._buffer) <= protocol.SURE * protocol.NODE.size


def nodes(count: int, first: int = 0) -> tuple[bytes, list[Point]]:
    """Nodes each degree from `first` on."""
    points = [Point(float(place % 360), 0.5 + 0.25 * (place % 7)) for place in range(first, first + count)]
    return b"".join(protocol.node(*each, first=each.angle_deg == 0.0) for each in points), points


@given(st.integers(20, 400), st.integers(0, 359), st.lists(st.integers(0, 2500), max_size=8))
def test_nodes_come_back_after_an_answer(count: int, first: int, cuts: list[int]) -> None:
    sent, points = nodes(count, first)
    health = protocol.answer(protocol.HEALTH, b"\0\1\2")
    found = fed(RplidarParser(), b"RP LIDAR\xa5" + health + protocol.scanning() + sent, cuts)
    sure = points[protocol.SURE : -protocol.SURE]  # those between others
    assert found == [Answer(protocol.HEALTH, b"\0\1\2"), *sure]


@given(st.integers(17, 200), st.binary(min_size=1, max_size=40), st.integers(0, 4))
@settings(max_examples=300, deadline=None)
def test_what_is_put_between_nodes_makes_a_gap_and_no_turn_of_points_that_were_not_sent(
    place: int, noise: bytes, lost: int
) -> None:
    before, points = nodes(place)
    after, more = nodes(800, place)
    parser, turns = RplidarParser(), Turns()
    list(parser.feed(protocol.scanning()))
    made, clean = [], True
    for each in fed(parser, before + noise + after[lost:]):
        if isinstance(each, Gap):
            turns.clear()
            clean = False
        elif isinstance(each, Point) and (done := turns.add(each, 0.0)):
            made.append(done[0])
    # Noise that looks like nodes in their place cannot be told from nodes, and lost bytes may be noticed late.
    strange = [point for turn in made for point in turn if point not in points and point not in more]
    assert not strange or clean
    assert parser.damaged > 0 or clean


def test_a_node_out_of_place_is_a_gap() -> None:
    sent, _ = nodes(40)
    wrong = protocol.node(200.0, 1.0, first=False)
    parser = RplidarParser()
    found = fed(parser, protocol.scanning() + sent + wrong + sent)
    assert found.count(GAP) == parser.damaged == 1
    assert Point(200.0, 1.0) not in found


def test_commands_are_those_of_the_protocol() -> None:
    assert protocol.motor(660) == bytes.fromhex("a5f0029402c1")
    assert protocol.scanning() == bytes.fromhex("a55a0500004081")
    assert protocol.answer(protocol.INFO, bytes(20))[:7] == bytes.fromhex("a55a1400000004")


# ---------------------------------------------------------------- turns
def turns_of(angles: list[float], period_s: float = 0.001) -> list[tuple[list[Point], float]]:
    turns = Turns()
    found = [turns.add(Point(angle % 360.0, 1.0), period_s * place) for place, angle in enumerate(angles)]
    return [each for each in found if each is not None]


def test_a_turn_ends_where_the_angle_begins_anew() -> None:
    made = turns_of([float(each) for each in range(100, 1100)])
    assert [len(points) for points, _ in made] == [360, 360]  # the first one began in the middle
    assert [duration_s for _, duration_s in made] == pytest.approx([0.36, 0.36])


def test_a_turn_with_a_wide_gap_is_not_complete() -> None:
    def without(low: int, high: int) -> list[float]:
        return [float(each) for each in range(720) if not low <= each % 360 < high]

    assert len(turns_of(without(50, 80))) == 1
    assert turns_of(without(50, 90)) == []
    assert turns_of(without(340, 360)) == turns_of(without(340, 360))
    assert turns_of([*map(float, range(300)), *map(float, range(200, 361))]) == []  # nearly a turn was lost


@given(st.lists(st.floats(0.0, 359.99), max_size=400))
def test_any_points_make_turns_of_those_points(angles: list[float]) -> None:
    for points, duration_s in turns_of(angles):
        assert len(points) > 60
        assert math.isfinite(duration_s)


def test_a_turn_is_bounded() -> None:
    turns = Turns()
    for _ in range(3 * protocol.MOST_POINTS):
        assert turns.add(Point(10.0, 1.0), 0.0) is None
    assert len(turns._points) <= protocol.MOST_POINTS


def test_the_size_of_a_packet() -> None:
    assert struct.calcsize("<2sHH") + 36 + 4 + 1 == protocol.LD_SIZE == 47
