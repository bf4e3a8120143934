from __future__ import annotations

import math
import struct

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from fullswarm.drivers.base import Pose, Twist
from fullswarm.drivers.can import odrive, settings, vesc
from fullswarm.drivers.can.kinematics import Odometry, WheelTrack, body_twist, wheel_speeds
from fullswarm.drivers.can.odrive import MAX_TURN_S, AxisState, Firmware, OdriveCodec
from fullswarm.drivers.can.protocol import Beat, Frame, Mode, Motion, Power, Version, Want, Wheel, WheelCodec
from fullswarm.drivers.can.vesc import VescCodec
from fullswarm.errors import ConfigError

ODRIVE = "can+odrive://here?interface=virtual&left=1&right=2&wheel_radius=0.05&base=0.3"
VESC = "can+vesc://here?interface=virtual&left=1&right=2&wheel_radius=0.05&base=0.3&gear=10&pole_pairs=7"

speeds = st.floats(-5.0, 5.0)
nodes = st.integers(0, 63)
wheels = st.builds(Wheel, st.floats(0.01, 0.5), st.floats(0.1, 100.0), st.integers(1, 30), st.sampled_from([-1, 1]))
frames = st.builds(Frame, st.integers(0, (1 << 29) - 1), st.booleans(), st.binary(max_size=64), st.booleans())


def codecs(node: int = 1, wheel: Wheel | None = None) -> list[WheelCodec]:
    wheel = wheel or Wheel(0.05, 10.0, 7)
    return [OdriveCodec(node, wheel, "0.5"), OdriveCodec(node, wheel, "0.6"), VescCodec(node, wheel)]


# ---------------------------------------------------------------- examples from the makers' documents
def test_vesc_51_amperes_to_23() -> None:
    assert vesc.encode(23, vesc.SetCurrent(51.0)) == Frame(0x117, True, bytes.fromhex("0000C738"))


def test_vesc_erpm_ping_and_brake() -> None:
    assert vesc.encode(23, vesc.SetErpm(-4000)) == Frame(0x317, True, struct.pack(">i", -4000))
    assert vesc.encode(23, vesc.Ping(253)) == Frame(0x1117, True, b"\xfd")
    assert vesc.encode(1, vesc.SetBrake(5.0)) == Frame(0x201, True, bytes.fromhex("00001388"))


@pytest.mark.parametrize(
    ("got", "identifier", "data"),
    [
        (odrive.encode(3, odrive.SetState(AxisState.CLOSED_LOOP)), 0x067, "08000000"),
        (odrive.encode(3, odrive.SetMode()), 0x06B, "0200000001000000"),
        (odrive.encode(3, odrive.SetVelocity(1.0)), 0x06D, "0000803F00000000"),
        (odrive.encode(3, odrive.ClearErrors()), 0x078, "00"),
        (odrive.encode(3, odrive.Estop()), 0x062, ""),
        (odrive.encode(63, odrive.Heartbeat(0x800, 1)), 0x7E1, "0008000001000000"),
    ],
)
def test_odrive_frames(got: Frame, identifier: int, data: str) -> None:
    assert got == Frame(identifier, extended=False, data=bytes.fromhex(data))


def test_odrive_start_clears_before_it_configures_and_moves_nothing() -> None:
    commands = [frame.id & 0x1F for frame in OdriveCodec(1, Wheel(0.05), "0.5").start()]
    assert commands == [0x18, 0x0B, 0x0D]


def test_odrive_activation_never_clears_errors() -> None:
    engaged = OdriveCodec(1, Wheel(0.05)).engage()
    assert odrive.encode(1, odrive.ClearErrors()) not in engaged
    assert engaged[-2:] == (
        odrive.encode(1, odrive.SetVelocity(0.0)),
        odrive.encode(1, odrive.SetState(AxisState.CLOSED_LOOP)),
    )


@pytest.mark.parametrize(
    ("firmware", "bits", "names", "estop"),
    [
        ("0.5", 0x840, "MOTOR_FAILED, WATCHDOG_TIMER_EXPIRED", False),
        ("0.5", 0x4000, "ESTOP_REQUESTED", True),
        ("0.6", 0x2000000, "ESTOP_REQUESTED", True),
        ("0.6", 0x8000, "VELOCITY_LIMIT_VIOLATION", False),
        ("0.6", 0x80000000, "error bit 0x80000000", False),
        ("0.6", 0, "", False),
        ("0.6", 0x4000, "INVERTER_OVER_TEMP (or, with firmware=0.5 in its URL, ESTOP_REQUESTED)", True),
        ("0.5", 0x2000000, "error bit 0x2000000 (or, with firmware=0.6 in its URL, ESTOP_REQUESTED)", True),
    ],
)
def test_odrive_error_names(firmware: Firmware, bits: int, names: str, estop: bool) -> None:
    report = OdriveCodec(5, Wheel(0.05), firmware).decode(odrive.encode(5, odrive.Heartbeat(bits, 1)))
    assert report == Beat(Mode.IDLE, "IDLE", names, estop)


def test_an_odrive_that_told_its_version_means_what_it_says() -> None:
    codec = OdriveCodec(5, Wheel(0.05), "0.6")
    codec.decode(odrive.encode(5, odrive.Version(0, 4, 4, 58, 0, 6, 10, 0)))
    report = codec.decode(odrive.encode(5, odrive.Heartbeat(0x4000, 1)))
    assert report == Beat(Mode.IDLE, "IDLE", "INVERTER_OVER_TEMP", estop=False)


@pytest.mark.parametrize(
    ("state", "mode"), [(1, Mode.IDLE), (8, Mode.DRIVING), (3, Mode.BUSY), (11, Mode.BUSY), (200, Mode.BUSY)]
)
def test_odrive_states(state: int, mode: Mode) -> None:
    report = OdriveCodec(5, Wheel(0.05)).decode(odrive.encode(5, odrive.Heartbeat(0, state)))
    assert isinstance(report, Beat)
    assert report.mode is mode
    assert report.state


def test_odrive_version_is_told_by_06_only() -> None:
    frame = odrive.encode(5, odrive.Version(2, 4, 4, 58, 0, 6, 10))
    assert OdriveCodec(5, Wheel(0.05), "0.6").decode(frame) == Version("ODrive 0.6.10")
    assert OdriveCodec(5, Wheel(0.05), "0.5").decode(frame) is None


# ---------------------------------------------------------------- round trips
@given(wheels, speeds)
def test_wheel_units_round_trip(wheel: Wheel, speed: float) -> None:
    assert wheel.metres(wheel.turns(speed)) == pytest.approx(speed, abs=1e-12)
    assert wheel.speed_of_erpm(wheel.erpm(speed)) == pytest.approx(speed, abs=1e-12)
    assert wheel.erpm(speed) == pytest.approx(wheel.turns(speed) * 60 * wheel.pole_pairs)


def test_one_wheel_turn_per_second() -> None:
    wheel = Wheel(0.05, gear=10.0, pole_pairs=7, sign=-1)
    around_m = 2 * math.pi * 0.05
    assert wheel.turns(around_m) == pytest.approx(-10.0)
    assert wheel.erpm(around_m) == pytest.approx(-4200.0)


@given(nodes, wheels, speeds)
def test_odrive_velocity_round_trip(node: int, wheel: Wheel, speed: float) -> None:
    codec = OdriveCodec(node, wheel)
    (frame,) = codec.drive(speed)
    turn_s, torque = struct.unpack("<ff", frame.data)
    assert (frame.id, torque) == (node << 5 | 0x0D, 0.0)
    assert wheel.metres(turn_s) == codec.quantised(speed)
    assert codec.quantised(speed) == pytest.approx(speed, rel=1e-6, abs=1e-30)


@given(nodes, wheels, speeds, st.floats(-1000.0, 1000.0))
def test_odrive_motion_round_trip(node: int, wheel: Wheel, speed: float, distance: float) -> None:
    assume(abs(wheel.turns(speed)) < MAX_TURN_S)
    report = OdriveCodec(node, wheel).decode(
        odrive.encode(node, odrive.Encoder(wheel.turns(distance), wheel.turns(speed)))
    )
    assert isinstance(report, Motion)
    assert report.speed_m_s == pytest.approx(speed, rel=1e-6, abs=1e-30)
    assert report.distance_m == pytest.approx(distance, rel=1e-6, abs=1e-30)


@given(nodes, wheels, speeds)
def test_vesc_speed_round_trip(node: int, wheel: Wheel, speed: float) -> None:
    assume(abs(wheel.erpm(speed)) < vesc.MAX_ERPM)
    codec = VescCodec(node, wheel)
    (frame,) = codec.drive(speed)
    (value,) = struct.unpack(">i", frame.data)
    if abs(round(wheel.erpm(speed))) < 900:
        assert frame == vesc.encode(node, vesc.SetBrake(codec.brake_a))
        assert codec.quantised(speed) == 0.0
    else:
        assert frame == vesc.encode(node, vesc.SetErpm(value))
        assert codec.quantised(speed) == pytest.approx(wheel.speed_of_erpm(value))
        assert abs(wheel.erpm(speed) - value) <= 0.5
        assert codec.decode(vesc.encode(node, vesc.Status1(value, 0.0, 0.0))) == Motion(codec.quantised(speed), None)


@given(nodes, wheels, st.integers(-(2**31), 2**31 - 1))
def test_vesc_tachometer(node: int, wheel: Wheel, counts: int) -> None:
    report = VescCodec(node, wheel).decode(vesc.encode(node, vesc.Status5(counts, 24.0)))
    assert isinstance(report, Motion)
    assert report.distance_m is not None
    assert wheel.turns(report.distance_m) * wheel.pole_pairs * 6 == pytest.approx(counts, abs=1e-5)


def test_vesc_pong_is_for_us_and_from_our_wheel() -> None:
    codec = VescCodec(7, Wheel(0.05), host=253)
    assert codec.decode(vesc.encode(253, vesc.Pong(7))) == Beat(Mode.UNKNOWN)
    assert codec.decode(vesc.encode(253, vesc.Pong(8))) is None
    assert codec.decode(vesc.encode(252, vesc.Pong(7))) is None
    assert codec.malformed == 0


# ---------------------------------------------------------------- what the bus may throw at us
@given(st.lists(frames, max_size=20), nodes)
def test_no_frame_makes_a_codec_raise(received: list[Frame], node: int) -> None:
    for codec in codecs(node):
        for frame in received:
            _check_report(codec.decode(frame))


@given(st.integers(0, 31), st.binary(max_size=12), st.booleans())
def test_no_payload_makes_a_codec_raise(command: int, data: bytes, remote: bool) -> None:
    for codec in codecs():
        extended = isinstance(codec, VescCodec)
        for identifier in (command << 8 | 1, command << 8 | 253) if extended else (1 << 5 | command,):
            _check_report(codec.decode(Frame(identifier, extended, data, remote)))


def _check_report(report: object) -> None:
    assert report is None or isinstance(report, (Beat, Motion, Version, Power))
    if isinstance(report, Motion):
        for value in (report.speed_m_s, report.distance_m):
            assert value is None or math.isfinite(value)


@pytest.mark.parametrize(
    ("codec", "frame"),
    [
        (OdriveCodec(1, Wheel(0.05)), Frame(0x21, False, b"1234")),
        (OdriveCodec(1, Wheel(0.05)), Frame(0x21, False, bytes(9))),
        (OdriveCodec(1, Wheel(0.05)), Frame(0x29, False, b"1234567")),
        (OdriveCodec(1, Wheel(0.05)), Frame(0x29, False, struct.pack("<ff", math.nan, 0.0))),
        (OdriveCodec(1, Wheel(0.05)), Frame(0x29, False, struct.pack("<ff", 0.0, math.inf))),
        (OdriveCodec(1, Wheel(0.05)), Frame(0x29, False, struct.pack("<ff", 0.0, math.nan))),
        (VescCodec(1, Wheel(0.05)), Frame(0x901, True, b"1234")),
        (VescCodec(1, Wheel(0.05)), Frame(0x1B01, True, b"12345")),
        (VescCodec(1, Wheel(0.05)), Frame(0x12FD, True, b"")),
        (VescCodec(1, Wheel(0.05)), vesc.encode(1, vesc.Status1(2**31 - 1, 0.0, 0.0))),
    ],
)
def test_malformed_is_counted(codec: WheelCodec, frame: Frame) -> None:
    assert codec.decode(frame) is None
    assert codec.malformed == 1


@given(speeds)
def test_a_codec_does_not_listen_to_itself(speed: float) -> None:
    """`udp_multicast` hands back what was sent."""
    for codec in codecs():
        sent = codec.start() + codec.engage() + codec.drive(speed) + codec.release() + codec.keep_alive()
        for frame in sent + codec.poll(Want.MOTION | Want.BEAT | Want.POWER | Want.VERSION):
            assert codec.decode(frame) is None
        assert codec.malformed == 0


def test_other_nodes_and_other_formats_are_not_ours() -> None:
    codec = OdriveCodec(1, Wheel(0.05))
    assert codec.decode(odrive.encode(2, odrive.Heartbeat(0, 1))) is None
    assert codec.decode(Frame(0x21, True, bytes(8))) is None
    assert VescCodec(1, Wheel(0.05)).decode(Frame(0x101, False, bytes(8))) is None
    assert codec.malformed == 0


# ---------------------------------------------------------------- two wheels, one body
@given(st.floats(allow_nan=False, allow_infinity=False), st.floats(allow_nan=False, allow_infinity=False))
def test_saturation_keeps_the_curvature(linear: float, angular: float) -> None:
    left, right = wheel_speeds(Twist(linear, angular), 0.3, 0.5)
    assert max(abs(left), abs(right)) <= 0.5 * (1 + 1e-12)
    applied = body_twist(left, right, 0.3)
    cross = applied.linear_m_s * angular - applied.angular_rad_s * linear
    assert abs(cross) <= 1e-9 * max(1.0, math.hypot(linear, angular))
    assert applied.linear_m_s * linear >= 0.0 or abs(linear) < 1e-9 * abs(angular)


@given(st.floats(-0.2, 0.2), st.floats(-1.0, 1.0))
def test_within_the_limit_nothing_is_changed(linear: float, angular: float) -> None:
    twist = body_twist(*wheel_speeds(Twist(linear, angular), 0.3, 0.5), 0.3)
    assert (twist.linear_m_s, twist.angular_rad_s) == pytest.approx((linear, angular), abs=1e-12)


@given(st.floats(-0.3, 0.3), st.floats(-1.0, 1.0).filter(lambda w: abs(w) > 1e-3))
def test_odometry_follows_an_arc(linear: float, angular: float) -> None:
    odometry = Odometry(0.3, 3.0)
    left, right = wheel_speeds(Twist(linear, angular), 0.3, 10.0)
    for step in range(201):
        for side, speed in enumerate((left, right)):
            odometry.update(side, Motion(speed, 7.0 + speed * step * 0.01), step * 0.01)
    turned = angular * 2.0
    radius = linear / angular
    assert odometry.pose.heading_rad == pytest.approx(math.remainder(turned, math.tau), abs=1e-9)
    assert odometry.pose.x_m == pytest.approx(radius * math.sin(turned), abs=1e-4)
    assert odometry.pose.y_m == pytest.approx(radius * (1 - math.cos(turned)), abs=1e-4)
    assert odometry.twist.linear_m_s == pytest.approx(linear)


def test_one_wheel_alone_does_not_move_the_pose() -> None:
    odometry = Odometry(0.3, 3.0)
    assert not any(odometry.update(0, Motion(0.1, 0.01 * step), 0.01 * step) for step in range(50))
    assert odometry.pose == Pose(0.0, 0.0, 0.0)


def test_a_restarted_controller_does_not_move_the_robot() -> None:
    track = WheelTrack(limit_m_s=2.0)
    for step in range(101):
        track.update(Motion(0.5, 40.0 + 0.005 * step), 0.01 * step)
    assert track.travelled_m == pytest.approx(0.5)
    lost = track.lost
    track.update(Motion(0.0, 0.0), 1.01)
    assert (lost, track.lost) == (False, True)
    track.update(Motion(0.5, 0.005), 1.02)
    assert track.travelled_m == pytest.approx(0.505)


def test_speed_bridges_the_counts_and_the_count_corrects() -> None:
    track = WheelTrack(limit_m_s=2.0)
    track.update(Motion(0.5, 0.0), 0.0)
    for step in range(1, 10):
        track.update(Motion(0.5, None), 0.02 * step)
    assert track.travelled_m == pytest.approx(0.09)
    track.update(Motion(None, 0.11), 0.2)
    assert track.travelled_m == pytest.approx(0.11)


# ---------------------------------------------------------------- the URL
def test_all_that_is_wrong_is_said_at_once() -> None:
    with pytest.raises(ConfigError) as caught:
        settings.parse("can+odrive://?left=1&rihgt=2&wheel_radius=-1&interface=pcan")
    text = str(caught.value)
    for part in ("did you mean 'right'?", "wheel_radius", "base", "interface", "channel is missing"):
        assert part in text


@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("can+odrve://x?left=1", "did you mean 'can+odrive'?"),
        (ODRIVE + "&left=3", "'left' is given twice"),
        (ODRIVE.replace("right=2", "right=1"), "same node 1"),
        (ODRIVE.replace("right=2", "right=64"), "up to 63"),
        (ODRIVE + "&min_erpm=900", "no option 'min_erpm'"),
        (ODRIVE + "&speed=inf", "speed"),
        (VESC.replace("&pole_pairs=7", ""), "pole_pairs"),
        (VESC.replace("gear=10", "gear=1"), "lower s_pid_min_erpm"),
        (VESC + "&host=2", "our own address"),
        (VESC + "&volts_full=30", "volts_empty and volts_full go together"),
        (ODRIVE + "&volts_empty=30&volts_full=30", "volts_empty is not below volts_full"),
    ],
)
def test_impossible_urls(url: str, text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        settings.parse(url)
    assert text in str(caught.value)


def test_settings_of_both_makes() -> None:
    base = settings.parse(ODRIVE + "&right_sign=-1&speed=0.6&watchdog=0.5")
    assert (base.channel, base.bus.interface, base.bus.bitrate) == ("here", "virtual", 250_000)
    assert [codec.wheel.sign for codec in base.codecs()] == [1, -1]
    assert (base.description().watchdog_s, base.warning) == (0.5, "")
    assert base.description().limits.turn_rad_s == pytest.approx(4.0)
    assert settings.parse(ODRIVE).description().watchdog_s is None
    assert "no CANSimple message switches it on" in settings.parse(ODRIVE).warning
    assert settings.parse(VESC + "&watchdog=0.4").description().watchdog_s == 0.4
    assert settings.parse(VESC).warning == ""
    assert settings.parse(ODRIVE + "&speed=5").wheel_limit_m_s == pytest.approx(2 * math.tau * 0.05)
    slcan = settings.parse(VESC.replace("here", "/dev/ttyACM0").replace("virtual", "slcan"))
    assert (slcan.channel, slcan.bus.bitrate, slcan.description().watchdog_s) == ("/dev/ttyACM0", 500_000, 1.0)
