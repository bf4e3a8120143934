"""The codec of ROS messages against the rosbags library, in both directions and byte orders, and against noise."""

from __future__ import annotations

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fullswarm.drivers.base import Hazard, Twist
from fullswarm.drivers.ros import protocol as p
from fullswarm.drivers.ros import zenoh_wire
from fullswarm.drivers.ros.relay_process import attachment
from fullswarm.emulators.ros.definitions import typestore
from fullswarm.emulators.ros.rosbridge import as_json
from fullswarm.errors import MessageError

STORE = typestore()
SECONDS = st.integers(0, 2**31 - 1)
NANOSECONDS = st.integers(0, 999_999_999)
TEXT = st.text(st.characters(exclude_characters="\0", exclude_categories=["Cs"]), max_size=30)
METRES = st.floats(-1e6, 1e6)
ANGLE = st.floats(-3.1, 3.1)


def make(kind: str, **fields: Any) -> Any:
    return STORE.types[kind](**fields)


def header(seconds: int, nanoseconds: int, frame: str) -> Any:
    stamp = make("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)


def vector(x: float, y: float, z: float, kind: str = "Vector3") -> Any:
    return make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)


def odometry(
    seconds: int, nanoseconds: int, frame: str, child: str, x: float, y: float, yaw: float, v: float, w: float
) -> Any:
    turned = make("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    pose = make("geometry_msgs/msg/Pose", position=vector(x, y, 0.1, "Point"), orientation=turned)
    twist = make(p.TWIST, linear=vector(v, 7.0, 8.0), angular=vector(9.0, 10.0, w))
    numbers = np.arange(36.0)
    return make(
        p.ODOMETRY, header=header(seconds, nanoseconds, frame), child_frame_id=child,
        pose=make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=numbers),
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=numbers),
    )  # fmt: skip


def cdr(message: Any, little: bool) -> bytes:
    return bytes(STORE.serialize_cdr(message, message.__msgtype__, little_endian=little))


def json_of(message: Any) -> bytes:
    return msgspec.json.encode(as_json(message))


@given(SECONDS, NANOSECONDS, TEXT, TEXT, METRES, METRES, ANGLE, METRES, METRES, st.booleans())
def test_odometry_is_read_as_rosbags_writes_it(
    s: int, ns: int, frame: str, child: str, x: float, y: float, yaw: float, v: float, w: float, little: bool
) -> None:
    message = odometry(s, ns, frame, child, x, y, yaw, v, w)
    for found in (p.read_cdr(p.ODOMETRY, cdr(message, little)), p.read_json(p.ODOMETRY, json_of(message))):
        assert isinstance(found, p.Odometry)
        assert found.stamp_s == pytest.approx(s + 1e-9 * ns, abs=1e-6)
        assert (found.pose.x_m, found.pose.y_m, found.twist) == (x, y, Twist(v, w))
        assert found.pose.heading_rad == pytest.approx(yaw, abs=1e-9)


@given(st.floats(width=32), st.lists(st.floats(3.0, 4.25, width=32), max_size=6), TEXT, st.booleans())
def test_a_battery_is_read_as_rosbags_writes_it(share: float, cells: list[float], name: str, little: bool) -> None:
    message = make(
        p.BATTERY, header=header(1, 2, name), voltage=11.1, temperature=math.nan, current=math.nan, charge=math.nan,
        capacity=math.nan, design_capacity=1.8, percentage=share, power_supply_status=1, power_supply_health=1,
        power_supply_technology=3, present=True, cell_voltage=np.array(cells, dtype=np.float32),
        cell_temperature=np.array(cells[:2], dtype=np.float32), location=name, serial_number="",
    )  # fmt: skip
    known = math.isfinite(share) and share >= 0.0
    expected = min(share / 100.0 if share > 1.5 else share, 1.0) if known else None
    for found in (p.read_cdr(p.BATTERY, cdr(message, little)), p.read_json(p.BATTERY, json_of(message))):
        assert isinstance(found, p.Battery)
        assert found.charge == (None if expected is None else pytest.approx(expected, rel=1e-6))


@given(st.lists(st.tuples(st.integers(0, 5), TEXT), max_size=8), TEXT, st.booleans())
def test_hazards_are_read_as_rosbags_writes_them(seen: list[tuple[int, str]], frame: str, little: bool) -> None:
    kind = "irobot_create_msgs/msg/HazardDetection"
    found = [make(kind, header=header(5, 6, name), type=number) for number, name in seen]
    message = make(p.HAZARDS, header=header(3, 4, frame), detections=found)
    expected = Hazard.NONE
    for number, _ in seen:
        expected |= p.HAZARD_OF.get(number, Hazard.NONE)
    assert p.read_cdr(p.HAZARDS, cdr(message, little)) == p.Hazards(expected)
    assert p.read_json(p.HAZARDS, json_of(message)) == p.Hazards(expected)


@given(st.booleans(), st.booleans())
def test_an_estop_is_read_as_rosbags_writes_it(engaged: bool, little: bool) -> None:
    message = make(p.BOOL, data=engaged)
    assert p.read_cdr(p.BOOL, cdr(message, little)) == p.EStop(engaged)
    assert p.read_json(p.BOOL, json_of(message)) == p.EStop(engaged)


RAYS = st.lists(st.floats(0.0, 4.0, width=32) | st.sampled_from([math.inf, -math.inf, math.nan, 0.0]), max_size=400)


@given(SECONDS, NANOSECONDS, TEXT, RAYS, st.booleans())
def test_a_scan_is_read_as_rosbags_writes_it(
    seconds: int, nanoseconds: int, frame: str, rays: list[float], little: bool
) -> None:
    message = make(
        p.LASER_SCAN, header=header(seconds, nanoseconds, frame), angle_min=-1.5, angle_max=1.5, angle_increment=0.01,
        time_increment=0.0005, scan_time=0.2, range_min=0.125, range_max=3.5, ranges=np.array(rays, np.float32),
        intensities=np.ones(len(rays), np.float32),
    )  # fmt: skip
    expected = [
        0.125 if each == -math.inf else each if each == math.inf or 0.125 <= each <= 3.5 else math.nan for each in rays
    ]
    of_cdr, of_json = p.read_cdr(p.LASER_SCAN, cdr(message, little)), p.read_json(p.LASER_SCAN, json_of(message))
    assert isinstance(of_cdr, p.LaserScan)
    assert isinstance(of_json, p.LaserScan)
    for found in (of_cdr, of_json):
        assert found.stamp_s == pytest.approx(seconds + 1e-9 * nanoseconds)
        assert found.max_m == 3.5
        assert found.angles_rad == pytest.approx([-1.5 + 0.01 * each for each in range(len(rays))], abs=1e-4)
        assert found.duration_s == pytest.approx(0.0005 * (len(rays) - 1) if len(rays) > 1 else 0.2, abs=1e-6)
    np.testing.assert_allclose(of_cdr.distances_m, expected)
    # JSON has no infinity: rosbridge writes null.
    unknown = [math.nan if math.isinf(each) else value for each, value in zip(rays, expected, strict=True)]
    np.testing.assert_allclose(of_json.distances_m, unknown)


def test_a_scan_without_a_range_or_of_too_many_rays_is_refused() -> None:
    for first, step, most, rays in ((math.nan, 0.01, 3.5, 10), (0.0, 0.01, 0.0, 10), (0.0, 1.0, 3.5, 100)):
        with pytest.raises(MessageError):
            p.laser_scan(1.0, first, step, 0.0, 0.1, 0.1, most, np.ones(rays))
    long = make(
        p.LASER_SCAN, header=header(1, 0, ""), angle_min=0.0, angle_max=1.0, angle_increment=1e-5, time_increment=0.0,
        scan_time=0.1, range_min=0.1, range_max=3.5, ranges=np.ones(p.MOST_RAYS + 1, np.float32),
        intensities=np.zeros(0, np.float32),
    )  # fmt: skip
    for read, data in ((p.read_cdr, cdr(long, True)), (p.read_json, json_of(long))):
        with pytest.raises(MessageError):
            read(p.LASER_SCAN, data)


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.none() | st.floats(0.0, 2e9))
def test_a_command_is_what_rosbags_reads_and_writes(v: float, w: float, stamp_s: float | None) -> None:
    kind = p.TWIST if stamp_s is None else p.TWIST_STAMPED
    data = p.twist_cdr(Twist(v, w), stamp_s)
    message = STORE.deserialize_cdr(data, kind)
    twist = message if stamp_s is None else message.twist
    assert (twist.linear.x, twist.angular.z) == (v, w)
    assert (twist.linear.y, twist.linear.z, twist.angular.x, twist.angular.y) == (0.0,) * 4
    if stamp_s is not None:
        assert message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec == pytest.approx(stamp_s, abs=1e-6)
    assert bytes(STORE.serialize_cdr(message, kind)) == data


def test_type_hashes_are_those_of_the_definitions() -> None:
    assert {kind: STORE.hash_rihs01(kind) for kind in zenoh_wire.HASHES} == zenoh_wire.HASHES


def test_an_attachment_is_what_zenohs_own_serializer_writes() -> None:
    import zenoh

    gid = bytes(range(16))
    written = zenoh.ext.z_serialize((zenoh.ext.Int64(7), zenoh.ext.Int64(-5), gid))
    assert attachment(7, -5, gid) == written.to_bytes()


# ---------------------------------------------------------------- what is no such message
KINDS = (p.ODOMETRY, p.BATTERY, p.HAZARDS, p.BOOL, p.LASER_SCAN)
GOOD = {p.ODOMETRY: cdr(odometry(1, 2, "odom", "base", 1.0, 2.0, 0.5, 0.1, 0.2), True)}


@given(st.sampled_from(KINDS), st.binary(max_size=900), st.sampled_from([b"", b"\0\1\0\0", b"\0\0\0\0"]))
def test_noise_is_refused_or_read_but_raises_nothing_else(kind: str, noise: bytes, head: bytes) -> None:
    for read, data in ((p.read_cdr, head + noise), (p.read_json, noise)):
        try:
            found = read(kind, data)
        except MessageError:
            continue
        if isinstance(found, p.Odometry):
            assert math.isfinite(found.pose.x_m)


@given(st.integers(0, len(GOOD[p.ODOMETRY]) - 8))
def test_a_message_that_is_cut_short_is_refused(size: int) -> None:
    with pytest.raises(MessageError):
        p.read_cdr(p.ODOMETRY, GOOD[p.ODOMETRY][:size])


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_odometry_that_is_not_finite_or_has_no_orientation_is_refused(value: float) -> None:
    with pytest.raises(MessageError, match="not finite"):
        p.read_cdr(p.ODOMETRY, cdr(odometry(1, 2, "", "", value, 0.0, 0.0, 0.0, 0.0), True))
    with pytest.raises(MessageError, match="quaternion"):
        p.odometry(0.0, 0.0, 0.0, (0.0, 0.0, 0.0, 0.0), 0.0, 0.0)


def test_what_follows_a_message_is_refused() -> None:
    with pytest.raises(MessageError, match="follow"):
        p.read_cdr(p.BOOL, b"\0\1\0\0\1" + bytes(8))
