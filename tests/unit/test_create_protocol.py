"""The Open Interface's bytes: commands, packets, frames, and what noise does to them."""

from __future__ import annotations

import math
import random
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.drivers.base import Twist
from fullswarm.drivers.create_oi import protocol
from fullswarm.drivers.create_oi.odometry import Odometry
from fullswarm.drivers.create_oi.protocol import (
    CREATE1,
    CREATE2,
    ROOMBA500,
    Command,
    CommandParser,
    Op,
    Sensors,
    StreamParser,
)
from fullswarm.drivers.create_oi.senses import stream_ids, wheel_speeds

SHEET = bytes([19, 5, 29, 2, 25, 13, 0, 163])
SHEET_OLD_SUM = SHEET[:-1] + bytes([182])
IDS = (7, 9, 10, 11, 12, 19, 35, 43, 44)

names = st.sampled_from(IDS)
values = st.fixed_dictionaries(
    {
        protocol.PACKETS[number].name: st.integers(*((-32768, 32767) if protocol.PACKETS[number].signed else (0, 255)))
        for number in IDS
    }
)


def heard(data: bytes, generation: protocol.Generation = CREATE2) -> list[Command]:
    parser = CommandParser(generation)
    return [command for byte in data if (command := parser.push(byte)) is not None]


# ---------------------------------------------------------------- the packet table
def test_the_groups_have_the_sizes_of_the_specification() -> None:
    wanted = {0: 26, 1: 10, 2: 6, 3: 10, 4: 14, 5: 12, 6: 52, 100: 80, 101: 28, 106: 12, 107: 9}
    assert {group: protocol.SIZES[group] for group in wanted} == wanted


@pytest.mark.parametrize(
    ("number", "name"),
    [(7, "bumps_drops"), (20, "angle_deg"), (26, "capacity_mah"), (35, "mode"), (42, "left_mm_s"),
     (43, "encoder_left"), (45, "light_bumper"), (52, "ir_left"), (58, "stasis")],
)  # fmt: skip
def test_packets_have_their_numbers(number: int, name: str) -> None:
    assert protocol.PACKETS[number].name == name


def test_a_generation_knows_its_packets() -> None:
    assert CREATE1.has_packet(42)
    assert CREATE1.has_packet(6)
    assert not CREATE1.has_packet(43)
    assert not CREATE1.has_packet(100)
    assert CREATE2.has_packet(100)
    assert not CREATE2.has_packet(59)


@given(values)
def test_an_answer_comes_back_as_it_was_written(written: dict[str, int]) -> None:
    read = protocol.decode(IDS, protocol.encode(IDS, written))
    assert read == Sensors(**written)


def test_an_answer_of_the_wrong_length_or_id_is_none() -> None:
    assert protocol.decode([100], bytes(79)) is None
    assert protocol.decode([100], bytes(80)) is not None
    assert protocol.decode([7], bytes(2)) is None
    assert protocol.decode([99], bytes(1)) is None


def test_sensors_read_their_bits() -> None:
    seen = Sensors(bumps_drops=0b1001, overcurrents=0b01000, cliff_right=1, charge_mah=50, capacity_mah=200)
    assert (seen.bump_right, seen.bump_left, seen.wheel_drop) == (True, False, True)
    assert seen.wheel_overcurrent
    assert seen.cliff
    assert seen.battery == 0.25
    assert not Sensors(overcurrents=0b101).wheel_overcurrent  # brushes
    assert Sensors(charge_mah=1, capacity_mah=0).battery is None


# ---------------------------------------------------------------- the stream
def test_the_example_of_the_specification() -> None:
    (frame,) = StreamParser().feed(SHEET)
    assert frame.ids == (29, 13)
    assert frame.sensors == Sensors(cliff_front_left_signal=537, virtual_wall=0)


def test_the_older_sum_counts_only_where_the_generation_has_it() -> None:
    assert not StreamParser().feed(SHEET_OLD_SUM)
    assert len(StreamParser(both_checksums=True).feed(SHEET_OLD_SUM + SHEET)) == 2
    assert not CREATE2.both_checksums
    assert CREATE1.both_checksums
    assert ROOMBA500.both_checksums


@given(values, st.binary(max_size=40), st.lists(st.integers(1, 7), max_size=40), st.booleans())
def test_frames_are_found_behind_garbage_however_they_are_cut(
    written: dict[str, int], garbage: bytes, cuts: list[int], header_in_sum: bool
) -> None:
    good = protocol.frame(IDS, written, header_in_sum=header_in_sum)
    parser = StreamParser(IDS, both_checksums=True)
    data = garbage + good + good + bytes(300)  # a false header may wait for 255 bytes
    found = []
    for cut in cuts:
        found += parser.feed(data[:cut])
        data = data[cut:]
    found += parser.feed(data)
    assert [frame.sensors for frame in found[-2:]] == [Sensors(**written)] * 2


def test_a_header_within_a_false_frame_is_found() -> None:
    false_header = bytes([19, 9, 29, 2])  # claims nine bytes and so swallows the start of the true frame
    assert len(StreamParser().feed(false_header + SHEET + bytes(8))) == 1


@pytest.mark.parametrize("damage", range(len(SHEET)))
def test_one_wrong_byte_loses_one_frame_only(damage: int) -> None:
    bad = bytearray(SHEET)
    bad[damage] ^= 0x40
    assert len(StreamParser().feed(bytes(bad) + SHEET * 40)) == 40


def test_unknown_ids_and_lengths_that_do_not_fit_are_refused() -> None:
    def sealed(*body: int) -> bytes:
        start = bytes([19, len(body), *body])
        return start + bytes([-sum(start) & 0xFF])

    assert StreamParser().feed(sealed(7, 1))
    assert not StreamParser().feed(sealed(99, 1))  # no such packet
    assert not StreamParser().feed(sealed(7, 1, 29, 2))  # 29 has two bytes
    assert not StreamParser().feed(bytes([19, 0, 237]))  # nothing in it
    assert not StreamParser([7, 8]).feed(sealed(7, 1))
    assert not StreamParser([7]).feed(sealed(7, 1, 8, 1))
    assert not StreamParser([7]).feed(sealed(8, 1))
    assert StreamParser([7]).feed(sealed(7, 1))


def test_noise_is_survived_and_nearly_all_of_it_skipped() -> None:
    noise = random.Random(7).randbytes(100_000)
    parser, strict = StreamParser(both_checksums=True), StreamParser(IDS)
    for start in range(0, len(noise), 97):
        parser.feed(noise[start : start + 97])
        assert not strict.feed(noise[start : start + 97])
    assert strict.skipped > 99_000
    strict.feed(bytes(300))
    assert len(strict.feed(protocol.frame(IDS, {"mode": 2}))) == 1


def test_headers_alone_do_not_choke_the_parser() -> None:
    parser = StreamParser()
    assert not parser.feed(bytes([19]) * 100_000)
    assert parser.skipped > 99_000


@given(st.integers(0, 0xFFFF), st.integers(-32768, 32767))
def test_encoder_differences_cross_the_wrap_both_ways(old: int, delta: int) -> None:
    assert protocol.encoder_delta((old + delta) & 0xFFFF, old) == delta


@pytest.mark.parametrize("generation", [CREATE1, ROOMBA500, CREATE2])
@pytest.mark.parametrize("baud", [19200, 57600, 115200])
def test_the_stream_fits_into_its_period_and_holds_what_safety_needs(
    generation: protocol.Generation, baud: int
) -> None:
    ids = stream_ids(generation, baud)
    assert protocol.frame_size(ids) <= generation.budget(baud)
    assert all(generation.has_packet(number) for number in ids)
    assert {7, 9, 10, 11, 12, 35} <= set(ids)
    assert ({43, 44} if generation is not CREATE1 else {19, 20}) <= set(ids)


# ---------------------------------------------------------------- commands
@given(st.integers(-500, 500), st.integers(-500, 500))
def test_drive_direct_puts_right_first(left: int, right: int) -> None:
    (command,) = heard(protocol.drive_direct(left, right))
    assert command.op is Op.DRIVE_DIRECT
    assert int.from_bytes(command.data[:2], "big", signed=True) == right
    assert int.from_bytes(command.data[2:], "big", signed=True) == left


def test_commands_of_the_sheet() -> None:
    assert protocol.drive_direct(0, -1) == bytes([145, 255, 255, 0, 0])
    assert protocol.drive(-200, 500) == bytes([137, 255, 56, 1, 244])
    assert protocol.drive(100, None) == bytes([137, 0, 100, 0x80, 0])
    assert protocol.drive(100, -1) == bytes([137, 0, 100, 255, 255])
    assert protocol.stream([29, 13]) == bytes([148, 2, 29, 13])
    assert protocol.stream([]) == bytes([148, 0])
    assert protocol.query_list([29, 13]) == bytes([149, 2, 29, 13])
    assert protocol.baud(57600) == bytes([129, 10])
    assert protocol.pause_stream(True) == bytes([150, 0])
    assert protocol.song(1, [(60, 32), (0, 8)]) == bytes([140, 1, 2, 60, 32, 0, 8])
    assert protocol.digit_leds("AB 1") == bytes([164, 65, 66, 32, 49])
    assert protocol.create1_byte(Op.WAIT_EVENT, -5) == bytes([158, 251])
    assert protocol.demo(-1) == bytes([136, 255])


ALL = [
    protocol.simple(Op.START), protocol.simple(Op.SAFE), protocol.simple(Op.FULL), protocol.simple(Op.DOCK),
    protocol.drive(1, 2), protocol.drive_direct(1, 2), protocol.motors(3), protocol.motors_pwm(1, -2, 3),
    protocol.leds(1, 2, 3), protocol.song(0, [(60, 1)] * 16), protocol.play(0), protocol.query(7),
    protocol.query_list([7, 8]), protocol.stream([7, 8, 9]), protocol.pause_stream(False), protocol.baud(19200),
]  # fmt: skip
NOT_CREATE1 = [
    protocol.drive_pwm(-255, 255), protocol.scheduling_leds(1, 2), protocol.digit_leds_raw([1, 2, 3, 4]),
    protocol.digit_leds("1234"), protocol.buttons(1), protocol.schedule(1, [(1, 2)] * 7),
    protocol.day_time(1, 2, 3), protocol.simple(Op.STOP), protocol.simple(Op.RESET), protocol.simple(Op.POWER),
    protocol.simple(Op.CLEAN), protocol.simple(Op.MAX), protocol.simple(Op.SPOT),
]  # fmt: skip
ONLY_CREATE1 = [
    protocol.demo(3), protocol.create1_byte(Op.SEND_IR, 9), protocol.create1_byte(Op.WAIT_TIME, 9),
    protocol.create1_byte(Op.DIGITAL_OUTPUTS, 7), protocol.wait_distance(-9), protocol.wait_angle(9),
    protocol.script(b"123"), protocol.simple(Op.PLAY_SCRIPT), protocol.simple(Op.SHOW_SCRIPT),
]  # fmt: skip


@given(st.lists(st.sampled_from(ALL + NOT_CREATE1), max_size=20))
def test_commands_are_heard_one_by_one(told: list[bytes]) -> None:
    commands = heard(b"".join(told))
    assert [bytes([command.op]) + command.data for command in commands] == told


@given(st.lists(st.sampled_from(ALL + ONLY_CREATE1), max_size=20))
def test_commands_of_a_create1_are_heard_one_by_one(told: list[bytes]) -> None:
    commands = heard(b"".join(told), CREATE1)
    assert [bytes([command.op]) + command.data for command in commands] == told


def test_missing_data_is_waited_for_and_unknown_opcodes_are_ignored() -> None:
    parser = CommandParser(CREATE2)
    assert [parser.push(byte) for byte in (145, 0, 0, 0)] == [None] * 4
    assert parser.push(128) == Command(Op.DRIVE_DIRECT, bytes([0, 0, 0, 128]))  # eaten as data
    assert parser.push(250) is None
    assert parser.push(147) is None  # not on this generation
    assert parser.push(128) == Command(Op.START)


REFUSED: list[Callable[[], bytes]] = [
    lambda: protocol.drive_direct(501, 0),
    lambda: protocol.drive(100, 2001),
    lambda: protocol.drive_pwm(256, 0),
    lambda: protocol.song(0, []),
    lambda: protocol.song(0, [(60, 1)] * 17),
    lambda: protocol.song(0, [(30, 1)]),
    lambda: protocol.stream([59]),
    lambda: protocol.stream([100] * 4),
    lambda: protocol.digit_leds("12345"),
    lambda: protocol.baud(9601),
    lambda: protocol.simple(Op.DRIVE),
    lambda: protocol.create1_byte(Op.WAIT_EVENT, 0),
    lambda: protocol.script(bytes(101)),
    lambda: protocol.encode([7], {"bumps_drops": 256}),
    lambda: protocol.encode([99], {}),
]


@pytest.mark.parametrize("wrong", REFUSED)
def test_what_a_robot_would_not_understand_is_refused(wrong: Callable[[], bytes]) -> None:
    with pytest.raises(ValueError, match=r"outside|no packet|not one of|needs data|no command|cannot hold"):
        wrong()


# ---------------------------------------------------------------- wheels and odometry
speeds = st.floats(-10.0, 10.0)


@given(speeds, speeds)
def test_wheels_keep_the_curvature_within_their_limits(linear: float, angular: float) -> None:
    left, right = wheel_speeds(Twist(linear, angular), 0.235)
    assert max(abs(left), abs(right)) <= 500
    half = angular * 0.235 / 2.0
    wish_left, wish_right = linear - half, linear + half
    scale = min(1.0, 0.5 / max(abs(wish_left), abs(wish_right), 1e-9))
    assert abs(left - 1000.0 * scale * wish_left) <= 0.51
    assert abs(right - 1000.0 * scale * wish_right) <= 0.51


@given(speeds, speeds, st.floats(1.0, 50.0))
def test_wheels_in_steps_are_the_nearest_steps_within_their_limits(linear: float, angular: float, step: float) -> None:
    told, free = wheel_speeds(Twist(linear, angular), 0.235, step), wheel_speeds(Twist(linear, angular), 0.235)
    reach = min(1.0, 500.0 // step * step / (max(map(abs, free)) or 1))  # both shrink alike
    for mm_s, wish in zip(told, free, strict=True):
        assert abs(mm_s) <= 500
        assert abs(mm_s - round(mm_s / step) * step) <= 0.5  # a step, in whole mm/s
        assert abs(mm_s - wish * reach) <= step / 2.0 + 1.1  # two roundings to whole mm/s


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_wheels_refuse_what_is_not_finite(wrong: float) -> None:
    with pytest.raises(ValueError, match="not a velocity"):
        wheel_speeds(Twist(wrong, 0.0), 0.235)
    with pytest.raises(ValueError, match="not a velocity"):
        wheel_speeds(Twist(0.0, wrong), 0.235)
    assert wheel_speeds(Twist(1e300, 0.0), 0.235) == (500, 500)


def counts(left: int, right: int) -> Sensors:
    return Sensors(encoder_left=left & 0xFFFF, encoder_right=right & 0xFFFF)


def test_odometry_leaves_out_impossible_jumps_and_goes_on_from_there() -> None:
    odometry = Odometry(CREATE2)
    for step in range(11):
        odometry.update(counts(65530 + 10 * step, 65530 + 10 * step), 0.015 * step)
    assert odometry.pose.x_m == pytest.approx(100 * 0.444565e-3)
    odometry.update(counts(30000, 95), 0.165)
    assert odometry.jumps == 1
    odometry.update(counts(30010, 105), 0.180)
    assert odometry.pose.x_m == pytest.approx(110 * 0.444565e-3)
    assert odometry.pose.heading_rad == 0.0


def test_odometry_follows_an_arc_to_its_chord() -> None:
    odometry = Odometry(CREATE2)
    for step in range(101):
        odometry.update(counts(10 * step, 30 * step), 0.03 * step)
    per_m, base_m = 0.444565e-3, 0.235
    turned, way = 2000 * per_m / base_m, 2000 * per_m
    assert odometry.pose.heading_rad == pytest.approx(math.remainder(turned, math.tau))
    assert odometry.pose.x_m == pytest.approx(way / turned * math.sin(turned), abs=1e-4)
    assert odometry.pose.y_m == pytest.approx(way / turned * (1.0 - math.cos(turned)), abs=1e-4)
    assert odometry.twist.linear_m_s == pytest.approx(20 * per_m / 0.03, rel=1e-6)
    assert odometry.twist.angular_rad_s == pytest.approx(20 * per_m / base_m / 0.03, rel=1e-6)


def test_odometry_of_a_create1_takes_distance_and_angle() -> None:
    odometry = Odometry(CREATE1)
    odometry.update(Sensors(distance_mm=999, angle_deg=90), 0.0)  # from before: since when is unknown
    for step in range(1, 91):
        odometry.update(Sensors(distance_mm=0, angle_deg=1), 0.015 * step)
    for step in range(91, 191):
        odometry.update(Sensors(distance_mm=5, angle_deg=0), 0.015 * step)
    assert odometry.pose.heading_rad == pytest.approx(math.pi / 2)
    assert odometry.pose.y_m == pytest.approx(0.5)
    assert odometry.pose.x_m == pytest.approx(0.0, abs=1e-9)
    assert odometry.twist.linear_m_s == pytest.approx(5 / 15, rel=0.01)
