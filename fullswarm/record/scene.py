"""What viewers draw of a swarm, in Foxglove's schemas: frames, bodies, names, obstacles, logs, pictures.

Foxglove, Lichtblick and Rerun know these schemas; the messages themselves are recorded beside them.
"""

from __future__ import annotations

import colorsys
import math
import zlib
from collections.abc import Iterator
from typing import Any, NamedTuple

from foxglove.messages import (
    ArrowPrimitive,
    Color,
    CompressedImage,
    CubePrimitive,
    CylinderPrimitive,
    Duration,
    FrameTransform,
    FrameTransforms,
    LaserScan,
    Log,
    LogLevel,
    Pose,
    Quaternion,
    SceneEntity,
    SceneUpdate,
    TextPrimitive,
    Timestamp,
    Vector3,
)

from fullswarm.maps.scans import unpack
from fullswarm.messages import CameraPicture, Message, RangeReport, RobotStates, SeenObstacles, SensorScan
from fullswarm.recent import Recent
from fullswarm.record.recording import Schema

WORLD = "world"
TF, SCENE, LOG = "/tf", "/scene", "/log"
BODY_M, NAME_M, WALL_M = 0.1, 0.15, 0.3
"""Heights of a body, of the letters of its name and of an obstacle: the swarm's world is flat."""
MOST_BODIES, MOST_HOSTS = 2000, 1000
LASTS_S = 3
"""A body is drawn so long after the last scene that has it."""
SILENT_S = 10.0
"""A robot that has sent no state for so long is drawn no more."""
FRAMES_S = 0.05
"""Frames of so much time are one message: each robot sends its state on its own, up to 20 times a second."""
OLDEST_SCAN_S = 1.0
"""A scan is stamped no earlier than this before its arrival, whatever its robot states."""
GREY = Color(r=0.5, g=0.5, b=0.55, a=0.9)
WHITE = Color(r=1.0, g=1.0, b=1.0, a=1.0)
LEVELS = {"debug": LogLevel.Debug, "info": LogLevel.Info, "warning": LogLevel.Warning, "error": LogLevel.Error}


class Drawn(NamedTuple):
    """A message for viewers."""

    topic: str
    schema: Schema
    data: bytes


class Scene:
    """Keeps what was received last of robots and obstacles, and draws it."""

    def __init__(self) -> None:
        self._radius_m: Recent[str, tuple[float, float]] = Recent(MOST_BODIES)  # by robot: radius, when it came
        self._obstacles: Recent[str, SeenObstacles] = Recent(MOST_HOSTS)
        self._frames: list[FrameTransform] = []  # not drawn yet
        self._frames_since_s = 0.0

    def take(self, message: Message, now_s: float, time_ns: int) -> Iterator[Drawn]:
        """Take in a message; yield what is to be drawn now."""
        if isinstance(message, RobotStates):
            if now_s - self._frames_since_s >= FRAMES_S:
                yield from self.frames()
            self._add_frames(message, now_s, time_ns)
        elif isinstance(message, SeenObstacles):
            self._obstacles[message.host] = message
        elif isinstance(message, CameraPicture):
            yield _drawn(f"/camera/{message.camera}", _picture(message, time_ns))
        elif isinstance(message, RangeReport):
            for scan in message.scans:
                at_ns = time_ns - round(1e9 * min(max(message.stamp_s - scan.stamp_s, 0.0), OLDEST_SCAN_S))
                yield _drawn(f"/scan/{message.robot}/{scan.sensor}", _scan(message.robot, scan, at_ns))

    def whole(self, now_s: float, time_ns: int) -> Drawn:
        """Return all bodies and obstacles: a viewer may start anywhere."""
        when = _time(time_ns)
        entities = [
            _body(robot, radius_m, when)
            for robot, (radius_m, since_s) in self._radius_m.items()
            if now_s - since_s < SILENT_S
        ]
        boxes = {row for each in self._obstacles.values() for row in each.rows}
        entities.append(_entity("obstacles", WORLD, when, cubes=[_cube(row) for row in sorted(boxes)]))
        return _drawn(SCENE, SceneUpdate(entities=entities))

    def frames(self) -> Iterator[Drawn]:
        """Yield the frames that have not been drawn yet, if any."""
        frames, self._frames = self._frames, []
        if frames:
            yield _drawn(TF, FrameTransforms(transforms=frames))

    def _add_frames(self, states: RobotStates, now_s: float, time_ns: int) -> None:
        if not self._frames:
            self._frames_since_s = now_s
        when = _time(time_ns)
        for row, robot in enumerate(states.robots):
            self._radius_m[robot] = states.radius_m[row], now_s
            place = Vector3(x=states.x_m[row], y=states.y_m[row], z=0.0)
            self._frames.append(
                FrameTransform(
                    timestamp=when, parent_frame_id=WORLD, child_frame_id=robot, translation=place,
                    rotation=_turned(states.heading_rad[row]),
                )
            )  # fmt: skip


def log_line(process: str, line: str, time_ns: int) -> Drawn:
    """Return a line of a process's log."""
    level = line.partition("[")[2].partition("]")[0].strip()  # 2026-11-27 09:00:00 [warning  ] …
    entry = Log(
        timestamp=_time(time_ns), level=LEVELS.get(level, LogLevel.Unknown), message=line, name=process, file="", line=0
    )
    return _drawn(LOG, entry)


def _drawn(topic: str, message: Any) -> Drawn:
    kind = type(message)
    schema = _schemas.get(kind)
    if schema is None:
        found = kind.get_schema()
        schema = _schemas[kind] = Schema(found.name, found.encoding, bytes(found.data), "protobuf")
    return Drawn(topic, schema, message.encode())


_schemas: dict[type, Schema] = {}


def _time(time_ns: int) -> Timestamp:
    return Timestamp(time_ns // 1_000_000_000, time_ns % 1_000_000_000)


def _turned(angle_rad: float) -> Quaternion:
    return Quaternion(x=0.0, y=0.0, z=math.sin(0.5 * angle_rad), w=math.cos(0.5 * angle_rad))


def _at(x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0, angle_rad: float = 0.0) -> Pose:
    return Pose(position=Vector3(x=x_m, y=y_m, z=z_m), orientation=_turned(angle_rad))


def _entity(name: str, frame: str, when: Timestamp, **shapes: Any) -> SceneEntity:
    return SceneEntity(
        timestamp=when, frame_id=frame, id=name, lifetime=Duration(LASTS_S, 0), frame_locked=True, **shapes
    )  # fmt: skip


def _body(robot: str, radius_m: float, when: Timestamp) -> SceneEntity:
    hue = zlib.crc32(robot.encode()) % 360 / 360.0  # the same in each run
    red, green, blue = colorsys.hsv_to_rgb(hue, 0.6, 0.9)
    disc = CylinderPrimitive(
        pose=_at(z_m=0.5 * BODY_M), size=Vector3(x=2.0 * radius_m, y=2.0 * radius_m, z=BODY_M), bottom_scale=1.0,
        top_scale=1.0, color=Color(r=red, g=green, b=blue, a=0.9),
    )  # fmt: skip
    ahead = ArrowPrimitive(
        pose=_at(z_m=BODY_M), shaft_length=0.7 * radius_m, shaft_diameter=0.2 * radius_m, head_length=0.4 * radius_m,
        head_diameter=0.5 * radius_m, color=WHITE,
    )  # fmt: skip
    name = TextPrimitive(
        pose=_at(z_m=BODY_M + NAME_M), billboard=True, font_size=NAME_M, scale_invariant=False, color=WHITE, text=robot
    )  # fmt: skip
    return _entity(f"robot {robot}", robot, when, cylinders=[disc], arrows=[ahead], texts=[name])


def _cube(row: tuple[float, ...]) -> CubePrimitive:
    """Draw an obstacle, corner radius included: centre x, y, half sizes x, y, yaw, corner radius."""
    x_m, y_m, half_x_m, half_y_m, yaw_rad, corner_m = row
    size = Vector3(x=2.0 * (half_x_m + corner_m), y=2.0 * (half_y_m + corner_m), z=WALL_M)
    return CubePrimitive(pose=_at(x_m, y_m, 0.5 * WALL_M, yaw_rad), size=size, color=GREY)


def _picture(message: CameraPicture, time_ns: int) -> CompressedImage:
    return CompressedImage(timestamp=_time(time_ns), frame_id=WORLD, data=message.jpeg, format="jpeg")


def _scan(robot: str, scan: SensorScan, time_ns: int) -> LaserScan:
    """Return a scan in its robot's frame; infinite: nothing is there; NaN: not measured."""
    bins = unpack(scan)
    x_m, y_m, heading_rad = scan.mount
    return LaserScan(
        timestamp=_time(time_ns), frame_id=robot, pose=_at(x_m, y_m, 0.0, heading_rad), start_angle=bins.first_rad,
        end_angle=bins.first_rad + bins.step_rad * max(0, len(bins.distances_m) - 1), ranges=bins.distances_m.tolist(),
    )  # fmt: skip
