from __future__ import annotations

import builtins
import math
import os
import random
import subprocess
import sys
from functools import partial
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fullswarm.drivers.base import Limits, Pose
from fullswarm.drivers.mavlink import codec, protocol
from fullswarm.drivers.mavlink.autopilot import unsupported
from fullswarm.drivers.mavlink.codec import Encoder, StationEncoder, StreamParser, decode, dialect
from fullswarm.drivers.mavlink.link import parse_url
from fullswarm.drivers.mavlink.px4 import AUTOPILOTS
from fullswarm.drivers.mavlink.requests import CommandQueue, EnsureParameter
from fullswarm.drivers.mavlink.vehicle import Odometer, Vehicle
from fullswarm.errors import ConfigError, MissingExtra

number = st.floats(-1e4, 1e4, width=32)
angle = st.floats(-math.pi, math.pi)


def station() -> StationEncoder:
    return StationEncoder(255, 190, 1)


def rover() -> Encoder:
    return Encoder(1, 1)


def only(data: bytes) -> Any:
    (message,) = StreamParser().feed(data)
    return message


def body(data: bytes) -> Any:
    received = decode(only(data))
    assert received is not None
    assert (received.system, received.component) == (1, 1)
    return received.body


# ---------------------------------------------------------------- frames of reference
@given(number, number, number)
def test_world_and_body_frames_are_their_own_inverse(a: float, b: float, c: float) -> None:
    assert protocol.enu_from_ned(*protocol.enu_from_ned(a, b, c)) == (a, b, c)
    assert protocol.flu_from_frd(*protocol.flu_from_frd(a, b, c)) == (a, b, c)


@given(angle)
def test_heading_is_its_own_inverse(yaw: float) -> None:
    back = protocol.heading_from_yaw(protocol.heading_from_yaw(yaw))
    assert math.isclose(math.cos(back - yaw), 1.0, abs_tol=1e-12)
    assert -math.pi <= back <= math.pi


def test_compass_directions() -> None:
    assert protocol.heading_from_yaw(0.0) == pytest.approx(math.pi / 2)  # north is +y
    assert protocol.heading_from_yaw(math.pi / 2) == pytest.approx(0.0)  # east is +x
    assert protocol.enu_from_ned(1.0, 2.0, 3.0) == (2.0, 1.0, -3.0)


@given(angle, st.floats(-5, 5))
def test_forward_speed_is_signed(heading: float, speed: float) -> None:
    vx, vy = speed * math.cos(heading), speed * math.sin(heading)
    assert protocol.forward_speed(vx, vy, heading) == pytest.approx(speed, abs=1e-9)


# ---------------------------------------------------------------- what we send
@given(st.floats(-3, 3, width=32), st.floats(-2, 2, width=32))
def test_setpoint_masks_frame_and_signs(speed: float, turn: float) -> None:
    message = only(station().drive(speed, turn))
    spin = speed == 0.0 and turn != 0.0
    assert message.type_mask == (1535 if spin else 1511)
    assert message.coordinate_frame == 8
    assert (message.vx, message.vy, message.yaw_rate) == (speed, 0.0, -turn)
    assert (message.target_system, message.target_component) == (1, 1)
    assert (message.get_srcSystem(), message.get_srcComponent()) == (255, 190)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e30])
def test_non_finite_is_refused_before_packing(bad: float) -> None:
    with pytest.raises(ValueError, match="finite"):
        station().drive(bad, 0.0)
    with pytest.raises(ValueError, match="finite"):
        station().drive(0.0, bad)
    with pytest.raises(ValueError, match="finite"):
        station().command(511, math.nan)
    with pytest.raises(ValueError, match="FS_GCS_ENABLE"):
        station().set_parameter("FS_GCS_ENABLE", math.nan)


def test_commands_on_the_wire() -> None:
    encoder = station()
    mode = only(encoder.set_mode(protocol.Mode.GUIDED, confirmation=2))
    assert (mode.command, mode.param1, mode.param2, mode.confirmation) == (176, 1.0, 15.0, 2)
    arm, disarm = only(encoder.arm(True)), only(encoder.arm(False))
    assert (arm.command, arm.param1, arm.param2) == (400, 1.0, 0.0)  # never by force
    assert (disarm.param1, disarm.param2) == (0.0, 0.0)
    rate = only(encoder.message_interval(32, 20.0))
    assert (rate.command, rate.param1, rate.param2, rate.param3) == (511, 32.0, 50000.0, 0.0)
    beat = only(encoder.heartbeat())
    assert (beat.type, beat.autopilot) == (6, 8)
    parameter = only(encoder.set_parameter("FS_GCS_ENABLE", 1.0, protocol.PARAM_INT8))
    assert (parameter.param_id, parameter.param_value, parameter.param_type) == ("FS_GCS_ENABLE", 1.0, 2)
    assert only(encoder.read_parameter("WP_SPEED")).param_index == -1


def test_frames_are_mavlink_2_and_numbered() -> None:
    encoder = station()
    frames = [encoder.heartbeat() for _ in range(258)]
    assert {frame[0] for frame in frames} == {0xFD}
    assert [frame[4] for frame in frames] == [index % 256 for index in range(258)]


def test_an_external_pose_is_ned_in_the_one_pair_of_frames_that_is_heard() -> None:
    fix = protocol.Fix(5_000_000, 3.0, 4.0, 0.0, 0.01, 0.04, 258)  # 3 m east, 4 m north, pointing east
    message = only(station().odometry(fix, velocity=0.0))
    assert (message.frame_id, message.child_frame_id, message.time_usec) == (20, 12, 5_000_000)
    assert (message.x, message.y, message.z) == (4.0, 3.0, 0.0)
    assert message.q == pytest.approx([math.cos(math.pi / 4), 0.0, 0.0, math.sin(math.pi / 4)])  # yaw 90 degrees
    assert (message.vx, message.vy, message.vz) == (0.0, 0.0, 0.0)  # ArduPilot's filter would choke on NaN
    assert [message.pose_covariance[index] for index in (0, 6, 11, 15, 18, 20)] == pytest.approx(
        [0.01] * 3 + [0.04] * 3
    )
    assert sum(message.pose_covariance) == pytest.approx(0.15)
    assert message.reset_counter == 2
    with pytest.raises(ValueError, match="finite"):
        station().odometry(protocol.Fix(0, math.nan, 0.0, 0.0, 1.0, 1.0), velocity=0.0)
    origin = only(station().set_origin(protocol.Origin(-33.8568, 151.2153, 12.5)))
    assert (origin.target_system, origin.latitude, origin.longitude, origin.altitude) == (
        1, -338568000, 1512153000, 12500,
    )  # fmt: skip


# ---------------------------------------------------------------- what we read
@given(number, number, number, st.floats(-3, 3, width=32))
def test_local_position_arrives_in_enu(north: float, east: float, down: float, v: float) -> None:
    message = dialect().MAVLink_local_position_ned_message(7, north, east, down, v, 2 * v, 0.0)
    got = body(rover().pack(message))
    assert (got.boot_ms, got.x_m, got.y_m, got.z_m) == (7, east, north, -down)
    assert (got.vx_m_s, got.vy_m_s) == (pytest.approx(2 * v), v)


def test_attitude_arrives_in_flu() -> None:
    got = body(rover().pack(dialect().MAVLink_attitude_message(9, 0.1, 0.2, math.pi, 0.3, 0.4, 0.5)))
    assert got.heading_rad == pytest.approx(-math.pi / 2, abs=1e-6)  # south
    assert (got.roll_rad, got.pitch_rad) == (pytest.approx(0.1), pytest.approx(-0.2))
    assert (got.roll_rad_s, got.pitch_rad_s, got.turn_rad_s) == (
        pytest.approx(0.3),
        pytest.approx(-0.4),
        pytest.approx(-0.5),
    )


def test_a_non_finite_measurement_is_no_measurement() -> None:
    message = dialect().MAVLink_local_position_ned_message(7, math.nan, 0, 0, 0, 0, 0)
    assert decode(only(rover().pack(message))) is None


@pytest.mark.parametrize(
    ("flags", "good"), [(831, True), (31, True), (15, False), (31 | 128, False), (31 | 1024, False), (0, False)]
)
def test_ekf_flags(flags: int, good: bool) -> None:
    assert body(rover().pack(dialect().MAVLink_ekf_status_report_message(flags, 0, 0, 0, 0, 0))).good is good


def test_heartbeat_armed_is_bit_128_only() -> None:
    def beat(base: int) -> Any:
        return body(rover().pack(dialect().MAVLink_heartbeat_message(10, 3, base, 15, 4, 3)))

    assert [beat(base).armed for base in (65, 9, 137, 129)] == [False, False, True, True]
    assert beat(9).custom_mode == protocol.Mode.GUIDED


def test_battery_unknowns_are_none() -> None:
    cells = [12600] + [65535] * 9
    full = body(rover().pack(dialect().MAVLink_battery_status_message(0, 0, 0, 0, cells, 250, 0, 0, 87)))
    assert (full.voltage_v, full.current_a, full.remaining) == (12.6, 2.5, 0.87)
    empty = body(rover().pack(dialect().MAVLink_battery_status_message(0, 0, 0, 0, [65535] * 10, -1, 0, 0, -1)))
    assert (empty.voltage_v, empty.current_a, empty.remaining) == (None, None, None)


def test_version_ack_and_parameter() -> None:
    assert decode(only(rover().pack(dialect().MAVLink_command_ack_message(400, 4, 0, 0, 255, 190)))) == (
        protocol.Received(1, 1, protocol.Ack(400, 4, 255, 190))
    )
    got = body(rover().pack(dialect().MAVLink_param_value_message(b"WP_SPEED", 3.0, 9, 1, 0)))
    assert got == protocol.Parameter("WP_SPEED", 3.0)
    zeros = [0] * 8
    version = dialect().MAVLink_autopilot_version_message(0, 0x040603FF, 0, 0, 0, zeros, zeros, zeros, 0, 0, 0)
    assert str(body(rover().pack(version))) == "4.6.3"


def test_text_chunks_are_joined_and_a_lost_one_shows() -> None:
    long = "".join(chr(65 + index % 26) for index in range(120))
    parts = [protocol.StatusText(4, long[at : at + 50], 7, at // 50) for at in (0, 50, 100)]
    assembler = protocol.TextAssembler()
    assert [assembler.add(part) for part in parts] == [None, None, long]
    assert [assembler.add(part) for part in (parts[0], parts[2])] == [None, f"{long[:50]}…{long[100:]}"]
    assert assembler.add(protocol.StatusText(4, "whole")) == "whole"


# ---------------------------------------------------------------- the stream parser
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


# ---------------------------------------------------------------- the extra
def test_pymavlink_is_not_imported_with_the_package() -> None:
    code = "import sys, fullswarm.drivers.mavlink.driver; sys.exit('pymavlink' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_mavlink_2_is_set_before_pymavlink_is_imported() -> None:
    """Without it a mavutil in the same process drops its signing at the first frame and believes anybody."""
    code = """
import builtins, os, sys
from fullswarm.drivers.mavlink.codec import dialect
real, seen = builtins.__import__, []
def watched(name, *rest, **named):
    if name.startswith("pymavlink"):
        seen.append(os.environ.get("MAVLINK20"))
    return real(name, *rest, **named)
builtins.__import__ = watched
dialect()
from pymavlink import mavutil
assert seen and set(seen) == {"1"}, seen
assert mavutil.mavlink20() and mavutil.mavlink.WIRE_PROTOCOL_VERSION == "2.0"
"""
    environment = {name: value for name, value in os.environ.items() if name != "MAVLINK20"}
    subprocess.run([sys.executable, "-W", "ignore", "-c", code], check=True, env=environment)


def test_a_missing_extra_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("pymavlink"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    with pytest.raises(MissingExtra, match=r"pip install 'fullswarm\[mavlink\]'"):
        codec.dialect.__wrapped__()


# ---------------------------------------------------------------- URL, requests, odometry
def test_urls() -> None:
    address, options = parse_url("mavlink+serial:///dev/ttyACM0?baud=57600&sysid=3")
    assert (address.device, address.baud, options) == ("/dev/ttyACM0", 57600, {"sysid": "3"})
    address, _ = parse_url("mavlink+udp://127.0.0.1:14550")
    assert (address.scheme, address.host, address.port) == ("mavlink+udp", "127.0.0.1", 14550)


@pytest.mark.parametrize(
    "url",
    [
        "mavlink+udp://127.0.0.1", "mavlink+tpc://h:1", "mavlink+serial://", "mavlink+tcp://h:99999",
        "mavlink+serial:///dev/x?baud=fast", "mavlink+udp://h:1?sysid=1&sysid=2",
    ],
)  # fmt: skip
def test_wrong_urls(url: str) -> None:
    with pytest.raises(ConfigError):
        parse_url(url)


def test_a_command_is_sent_four_times_with_growing_confirmation() -> None:
    queue, encoder = CommandQueue(), station()
    results: list[int | None] = []
    queue.ask(511, lambda confirmation: encoder.message_interval(32, 20.0, confirmation), results.append)
    sent = [only(frame) for step in range(60) for frame in queue.tick(step * 0.05)]
    assert [message.confirmation for message in sent] == [0, 1, 2, 3]
    assert results == [None]
    assert queue.idle


def test_an_ack_settles_the_first_question_of_its_kind_only() -> None:
    queue, encoder = CommandQueue(), station()
    results: list[int | None] = []
    for message in (32, 30):
        queue.ask(511, partial(encoder.message_interval, message, 20.0), results.append)
    queue.on_ack(protocol.Ack(511, 0))  # before anything was sent: somebody else's
    assert results == []
    assert len(queue.tick(0.0)) == 1
    queue.on_ack(protocol.Ack(400, 0))
    queue.on_ack(protocol.Ack(511, protocol.Result.IN_PROGRESS))
    assert results == []
    queue.on_ack(protocol.Ack(511, 2))
    assert results == [2]
    assert only(queue.tick(0.0)[0]).param1 == 30.0


def test_a_parameter_counts_only_when_read_back_after_the_echo() -> None:
    ensure, encoder = EnsureParameter("FS_GCS_ENABLE", 1.0, frozenset((1.0, 2.0)), 2), station()
    assert only(ensure.tick(0.0, encoder)[0]).get_type() == "PARAM_REQUEST_READ"
    assert ensure.tick(0.5, encoder) == []
    ensure.receive(protocol.Parameter("WP_SPEED", 1.0))
    ensure.receive(protocol.Parameter("FS_GCS_ENABLE", 0.0))
    assert only(ensure.tick(0.6, encoder)[0]).get_type() == "PARAM_SET"
    ensure.receive(protocol.Parameter("FS_GCS_ENABLE", 1.0))  # the echo
    assert not ensure.confirmed
    assert only(ensure.tick(0.7, encoder)[0]).get_type() == "PARAM_REQUEST_READ"
    ensure.receive(protocol.Parameter("FS_GCS_ENABLE", 1.0))
    assert ensure.confirmed


@given(number, number, angle)
def test_odometry_starts_at_zero_and_survives_a_new_origin(x: float, y: float, heading: float) -> None:
    odometer = Odometer()
    odometer.update(Pose(x, y, heading))
    assert odometer.pose == Pose(0.0, 0.0, 0.0)
    odometer.update(Pose(x + 2 * math.cos(heading), y + 2 * math.sin(heading), heading))
    assert odometer.pose.x_m == pytest.approx(2.0, abs=1e-6)
    assert odometer.pose.y_m == pytest.approx(0.0, abs=1e-6)
    odometer.rebase()
    odometer.update(Pose(0.0, 0.0, 1.0))
    assert odometer.pose.x_m == pytest.approx(2.0, abs=1e-6)


@pytest.mark.parametrize(("later_ms", "restarted"), [(4500, False), (5001, False), (100, True)])
def test_boot_time_going_backwards_is_a_restart(later_ms: int, restarted: bool) -> None:
    vehicle = Vehicle()
    for boot_ms in (5000, later_ms):
        vehicle.receive(protocol.Attitude(boot_ms, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 1.0)
    assert vehicle.rebooted is restarted


@pytest.mark.parametrize(
    ("autopilot", "kind", "allowed"),
    [(3, 10, True), (3, 11, True), (3, 2, False), (12, 10, True), (12, 2, False), (0, 10, False)],
)
def test_only_rovers_of_the_two_autopilots_are_driven(autopilot: int, kind: int, allowed: bool) -> None:
    assert (unsupported(protocol.Heartbeat(kind, autopilot, 1, 0, 4), AUTOPILOTS) == "") is allowed


def test_url_options() -> None:
    from fullswarm.drivers.mavlink.driver import MavlinkDriver

    driver = MavlinkDriver("mavlink+tcp://127.0.0.1:5760?speed=0.4&radius=0.2")
    assert driver.description.limits == Limits(0.4, 2.0, 1.0, 2.0)
    assert driver.description.radius_m == 0.2
    for query in ("speed=0", "speed=nan", "turn=x", "sysid=0", "sysid=255", "ekf=maybe", "speeed=1"):
        with pytest.raises(ConfigError):
            MavlinkDriver(f"mavlink+tcp://127.0.0.1:5760?{query}")
