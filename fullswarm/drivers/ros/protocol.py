"""Converts between values and the ROS messages that a base exchanges: CDR of ROS 2, JSON of rosbridge.

Only here are ROS conventions converted; they are nearly ours (REP 103, REP 105): SI units, x forward,
counter-clockwise, the pose of ``nav_msgs/Odometry`` in the frame ``odom``, its twist in the body's frame. CDR is the
plain one (XCDR1) with its header of four bytes, read in both byte orders and written in little endian as all ROS 2
middleware does.

A message that is cut short, too long, or has values that are not finite is a ``MessageError``; what a message does not
know (a battery's charge is NaN, ``null`` in JSON) becomes None.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np

from fullswarm.drivers.base import Hazard, Pose, Twist
from fullswarm.errors import MessageError
from fullswarm.geometry import wrap
from fullswarm.kernels import Array

TWIST, TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
ODOMETRY, BATTERY = "nav_msgs/msg/Odometry", "sensor_msgs/msg/BatteryState"
HAZARDS, BOOL = "irobot_create_msgs/msg/HazardDetectionVector", "std_msgs/msg/Bool"
LASER_SCAN = "sensor_msgs/msg/LaserScan"

LARGEST_BYTES = 64 * 1024
"""No message of these types is longer; a longer one is refused unread."""
MOST_HAZARDS = 64
MOST_RAYS = 4096
LONGEST_SCAN_S = 1.0

HAZARD_OF = {1: Hazard.BUMP, 2: Hazard.CLIFF, 3: Hazard.OVERCURRENT, 4: Hazard.WHEEL_DROP}
"""By ``HazardDetection.type``; 0 (backup limit) and 5 (object near) are reflexes of the base that bar no motion."""


@dataclass(frozen=True, slots=True)
class Odometry:
    """A pose since the robot's own start, and its speed; the stamp is in seconds of the robot's clock, 0: none."""

    stamp_s: float
    pose: Pose
    twist: Twist


@dataclass(frozen=True, slots=True)
class Battery:
    """Its charge, 0 to 1; None: the robot does not know it."""

    charge: float | None


@dataclass(frozen=True, slots=True)
class Hazards:
    """What the base's own sensors report now."""

    hazards: Hazard


@dataclass(frozen=True, slots=True)
class EStop:
    """Whether the robot's emergency stop is engaged."""

    engaged: bool


@dataclass(frozen=True, slots=True, eq=False)
class LaserScan:
    """One turn of a lidar: angles and distances as in ``RangeScan``; the stamp is of its first ray, 0: none."""

    stamp_s: float
    duration_s: float
    angles_rad: Array
    distances_m: Array
    max_m: float


Report = Odometry | Battery | Hazards | EStop | LaserScan


# ---------------------------------------------------------------- CDR
class Reader:
    """Reads the fields of one CDR message, which are aligned to their size from the end of the header.

    Raises
    ------
    MessageError
        It has another header than plain CDR, or ends before its fields.
    """

    def __init__(self, data: bytes) -> None:
        if len(data) < 4 or len(data) > LARGEST_BYTES or data[0] != 0 or data[1] not in (0, 1):
            raise MessageError(f"{len(data)} bytes beginning with {data[:4].hex()} are no plain CDR message")
        self._data, self._order, self._at = data, "<" if data[1] else ">", 4

    def take(self, code: str, count: int = 1) -> tuple[float, ...]:
        """Return `count` numbers of one :mod:`struct` code."""
        size = struct.calcsize(code)
        begin = self._at + (4 - self._at) % size
        self._at = begin + size * count
        if self._at > len(self._data):
            raise MessageError(f"a CDR message of {len(self._data)} bytes ends before its fields")
        return struct.unpack_from(f"{self._order}{count}{code}", self._data, begin)

    def skip_text(self) -> None:
        """Pass a string: its length with the final zero, and its bytes."""
        length = int(self.take("I")[0])
        self._at += length
        if self._at > len(self._data) or (length and self._data[self._at - 1] != 0):
            raise MessageError("a CDR message has a string that does not end")

    def stamp_s(self) -> float:
        """Return the stamp of a header, and pass its frame."""
        seconds, nanoseconds = self.take("i")[0], self.take("I")[0]
        self.skip_text()
        return seconds + 1e-9 * nanoseconds

    def end(self) -> None:
        """Check that nothing follows but padding."""
        if len(self._data) - self._at > 7:
            raise MessageError(f"{len(self._data) - self._at} bytes follow the fields of a CDR message")


def read_cdr(kind: str, data: bytes) -> Report:
    """Return the report in a CDR message of one of the types that a base sends.

    Raises
    ------
    MessageError
        It is not such a message, or its values are not finite.
    """
    reader = Reader(data)
    report = _CDR[kind](reader)
    reader.end()
    return report


def _read_odometry(reader: Reader) -> Odometry:
    stamp_s = reader.stamp_s()
    reader.skip_text()
    x, y, _, *quaternion = reader.take("d", 7)
    reader.take("d", 36)
    forward, _, _, _, _, turn = reader.take("d", 6)
    reader.take("d", 36)
    return odometry(stamp_s, x, y, tuple(quaternion), forward, turn)


def odometry(
    stamp_s: float, x: float, y: float, quaternion: tuple[float, ...], forward: float, turn: float
) -> Odometry:
    """Return a report of checked values; `quaternion` is x, y, z, w."""
    if not all(map(math.isfinite, (stamp_s, x, y, forward, turn, *quaternion))):
        raise MessageError("an odometry message has values that are not finite")
    qx, qy, qz, qw = quaternion
    if not 0.9 <= math.hypot(*quaternion) <= 1.1:
        raise MessageError("an odometry message has an orientation that is no unit quaternion")
    heading = math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))
    return Odometry(stamp_s, Pose(x, y, wrap(heading)), Twist(forward, turn))


def _read_battery(reader: Reader) -> Battery:
    reader.stamp_s()
    *_, percentage = reader.take("f", 7)
    reader.take("B", 4)
    for _ in range(2):
        reader.take("f", int(reader.take("I")[0]))
    reader.skip_text()
    reader.skip_text()
    return battery(percentage)


def battery(percentage: float | None) -> Battery:
    """Return the charge; some bases (TurtleBot 3) report 0 to 100 where the message says 0 to 1."""
    if percentage is None or not math.isfinite(percentage) or percentage < 0.0:
        return Battery(None)
    return Battery(min(percentage / 100.0 if percentage > 1.5 else percentage, 1.0))


def _read_hazards(reader: Reader) -> Hazards:
    reader.stamp_s()
    count = int(reader.take("I")[0])
    if count > MOST_HAZARDS:
        raise MessageError(f"a message of {count} hazards is none of a base")
    found = Hazard.NONE
    for _ in range(count):
        reader.stamp_s()
        found |= HAZARD_OF.get(int(reader.take("B")[0]), Hazard.NONE)
    return Hazards(found)


def _read_scan(reader: Reader) -> LaserScan:
    stamp_s = reader.stamp_s()
    first, _, step, ray_s, scan_s, least, most = reader.take("f", 7)
    count = int(reader.take("I")[0])
    if count > MOST_RAYS:
        raise MessageError(f"a scan of {count} rays is none of a lidar")
    found = np.array(reader.take("f", count))
    reader.take("f", min(int(reader.take("I")[0]), MOST_RAYS))
    return laser_scan(stamp_s, first, step, ray_s, scan_s, least, most, found)


def laser_scan(
    stamp_s: float, first: float, step: float, ray_s: float, scan_s: float, least_m: float, most_m: float,
    distances_m: Array,
) -> LaserScan:  # fmt: skip
    """Return a scan of checked values.

    REP 117: infinite is nothing within the range, minus infinite something too near to measure, which is taken to be at
    the least range. What else is outside the range is no measurement, as sensor_msgs says: 0 of a TurtleBot 3, too.
    """
    if not all(map(math.isfinite, (stamp_s, first, step))) or not 0.0 <= least_m < most_m < math.inf:
        raise MessageError("a scan has values that are not finite, or no range")
    if abs(step) * len(distances_m) > 2.0 * math.tau:
        raise MessageError(f"a scan of {len(distances_m)} rays {step:g} rad apart turns more than twice")
    turn_s = max(ray_s * (len(distances_m) - 1), 0.0) or scan_s
    measured: Array = np.where(distances_m == -math.inf, least_m, distances_m)
    inside = (measured >= least_m) & (measured <= most_m) | (measured == math.inf)
    return LaserScan(
        stamp_s, min(max(turn_s, 0.0), LONGEST_SCAN_S) if math.isfinite(turn_s) else 0.0,
        first + step * np.arange(len(distances_m), dtype=np.float64), np.where(inside, measured, math.nan), most_m,
    )  # fmt: skip


def _read_estop(reader: Reader) -> EStop:
    engaged = reader.take("B")[0]
    if engaged not in (0, 1):
        raise MessageError(f"a boolean is {engaged:g}")
    return EStop(bool(engaged))


_CDR: dict[str, Callable[[Reader], Report]] = {
    ODOMETRY: _read_odometry,
    BATTERY: _read_battery,
    HAZARDS: _read_hazards,
    BOOL: _read_estop,
    LASER_SCAN: _read_scan,
}


def twist_cdr(twist: Twist, stamp_s: float | None = None) -> bytes:
    """Return ``Twist``, or ``TwistStamped`` if there is a stamp (s of the robot's clock; 0: none), in CDR."""
    body = struct.pack("<6d", twist.linear_m_s, 0.0, 0.0, 0.0, 0.0, twist.angular_rad_s)
    if stamp_s is None:
        return b"\0\1\0\0" + body
    # An empty frame: a length of 1 and the final zero, then three bytes up to the next multiple of eight.
    return b"\0\1\0\0" + struct.pack("<iII4x", *split_s(stamp_s), 1) + body


def split_s(stamp_s: float) -> tuple[int, int]:
    """Return whole seconds and nanoseconds."""
    seconds = math.floor(stamp_s)
    return seconds, min(int((stamp_s - seconds) * 1e9), 999_999_999)


# ---------------------------------------------------------------- JSON of rosbridge
class _Stamp(msgspec.Struct):
    sec: int = 0
    nanosec: int = 0


class _Header(msgspec.Struct):
    stamp: _Stamp = msgspec.field(default_factory=_Stamp)


class _Vector(msgspec.Struct):
    x: float
    y: float
    z: float


class _Quaternion(_Vector):
    w: float


class _PoseFields(msgspec.Struct):
    position: _Vector
    orientation: _Quaternion


class _TwistFields(msgspec.Struct):
    linear: _Vector
    angular: _Vector


class _WithPose(msgspec.Struct):
    pose: _PoseFields


class _WithTwist(msgspec.Struct):
    twist: _TwistFields


class _OdometryFields(msgspec.Struct):
    header: _Header
    pose: _WithPose
    twist: _WithTwist


class _BatteryFields(msgspec.Struct):
    percentage: float | None = None


class _HazardFields(msgspec.Struct):
    type: int


class _HazardsFields(msgspec.Struct):
    detections: list[_HazardFields]


class _BoolFields(msgspec.Struct):
    data: bool


class _ScanFields(msgspec.Struct):
    header: _Header
    angle_min: float
    angle_increment: float
    range_min: float
    range_max: float
    ranges: Annotated[list[float | None], msgspec.Meta(max_length=MOST_RAYS)]
    time_increment: float = 0.0
    scan_time: float = 0.0


_JSON = {
    ODOMETRY: _OdometryFields, BATTERY: _BatteryFields, HAZARDS: _HazardsFields, BOOL: _BoolFields,
    LASER_SCAN: _ScanFields,
}  # fmt: skip


def read_json(kind: str, data: bytes) -> Report:
    """Return the report in the ``msg`` of a rosbridge message.

    Raises
    ------
    MessageError
        It is not such a message, or its values are not finite.
    """
    try:
        fields = msgspec.json.decode(data, type=_JSON[kind])
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise MessageError(f"no {kind} in JSON: {error}") from error
    if isinstance(fields, _OdometryFields):
        pose, twist, stamp = fields.pose.pose, fields.twist.twist, fields.header.stamp
        at, turned = pose.position, pose.orientation
        return odometry(
            stamp.sec + 1e-9 * stamp.nanosec, at.x, at.y, (turned.x, turned.y, turned.z, turned.w),
            twist.linear.x, twist.angular.z,
        )  # fmt: skip
    if isinstance(fields, _BatteryFields):
        return battery(fields.percentage)
    if isinstance(fields, _HazardsFields):
        found = Hazard.NONE
        for each in fields.detections[:MOST_HAZARDS]:
            found |= HAZARD_OF.get(each.type, Hazard.NONE)
        return Hazards(found)
    if isinstance(fields, _ScanFields):
        stamp = fields.header.stamp
        # JSON has no infinity: what is null was not measured, or nothing was there. So nothing follows of it.
        found_m = np.array([math.nan if each is None else each for each in fields.ranges])
        return laser_scan(
            stamp.sec + 1e-9 * stamp.nanosec, fields.angle_min, fields.angle_increment, fields.time_increment,
            fields.scan_time, fields.range_min, fields.range_max, found_m,
        )  # fmt: skip
    return EStop(fields.data)


def twist_json(twist: Twist, stamp_s: float | None = None) -> dict[str, object]:
    """Return the ``msg`` of ``Twist``, or of ``TwistStamped`` if there is a stamp (s of the robot's clock; 0: none).

    Without a stamp of its own rosbridge puts its present time in.
    """
    fields: dict[str, object] = {
        "linear": {"x": twist.linear_m_s, "y": 0.0, "z": 0.0},
        "angular": {"x": 0.0, "y": 0.0, "z": twist.angular_rad_s},
    }
    if stamp_s is None:
        return fields
    if stamp_s == 0.0:
        return {"header": {"frame_id": ""}, "twist": fields}
    seconds, nanoseconds = split_s(stamp_s)
    return {"header": {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": ""}, "twist": fields}
