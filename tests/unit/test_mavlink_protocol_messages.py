"""What we send and what we read, and the frames of reference between."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.drivers.mavlink import protocol
from fullswarm.drivers.mavlink.codec import decode, dialect
from tests.unit.mavlink_frames import angle, body, number, only, rover, station


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
