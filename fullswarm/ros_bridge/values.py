"""Makes plain values of ROS messages of what the swarm publishes.

Conventions are those of REP 103 and REP 105, which are also ours: metres, radians, x forward, counter-clockwise; the
frame ``map`` is the swarm's world frame. A robot's pose is measured in the world, so ``map`` → ``r1/odom`` is the
identity, and ``r1/odom`` → ``r1/base_link`` may jump where a fix corrects it.
"""

from __future__ import annotations

import colorsys
import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from fullswarm.maps.scans import unpack
from fullswarm.maps.tiles import GridPlace
from fullswarm.messages import RobotHealth, RobotStates, SensorScan

MAP = "map"
BODY_M, NAME_M, WALL_M = 0.1, 0.15, 0.3
"""Heights of a body, of the letters of its name and of an obstacle: the swarm's world is flat."""
LASTS_S = 2.0
"""A marker is drawn so long after the last message that has it."""
GREY, WHITE = (0.5, 0.5, 0.55, 0.9), (1.0, 1.0, 1.0, 1.0)
ARROW, CUBE, SPHERE, CYLINDER, LINE_STRIP, TEXT = 0, 1, 2, 3, 4, 9
OK, WARN, ERROR, STALE = 0, 1, 2, 3
CHARGING_UNKNOWN, CHARGING, DISCHARGING = 0, 1, 2


class RobotState(NamedTuple):
    """One robot's part of `RobotStates`; NaN where nothing is stated."""

    x_m: float
    y_m: float
    heading_rad: float
    speed_m_s: float
    turn_rad_s: float
    radius_m: float
    speed_limit_m_s: float
    turn_limit_rad_s: float
    sigma_m: float
    sigma_rad: float
    aim_x_m: float
    aim_y_m: float
    own_frame: bool


def states_of(message: RobotStates) -> dict[str, RobotState]:
    """Return robot → state of all robots of a message."""
    unknown = (math.nan,) * len(message.robots)
    columns = (
        message.x_m, message.y_m, message.heading_rad, message.speed_m_s, message.turn_rad_s, message.radius_m,
        message.speed_limit_m_s or unknown, message.turn_limit_rad_s or unknown, message.sigma_m or unknown,
        message.sigma_rad or unknown, message.aim_x_m or unknown, message.aim_y_m or unknown,
        (message.own_frame,) * len(message.robots),
    )  # fmt: skip
    return {robot: RobotState._make(row) for robot, *row in zip(message.robots, *columns, strict=True)}


# ---------------------------------------------------------------- frames
def time_of(stamp_ns: int) -> dict[str, int]:
    """Return nanoseconds since 1970 as a time of ROS."""
    return {"sec": stamp_ns // 1_000_000_000, "nanosec": stamp_ns % 1_000_000_000}


def header(frame: str, stamp_ns: int) -> dict[str, Any]:
    """Return a header."""
    return {"stamp": time_of(stamp_ns), "frame_id": frame}


def turned(angle_rad: float) -> dict[str, float]:
    """Return a turn about the vertical axis as a quaternion."""
    return {"x": 0.0, "y": 0.0, "z": math.sin(0.5 * angle_rad), "w": math.cos(0.5 * angle_rad)}


def pose(x_m: float = 0.0, y_m: float = 0.0, angle_rad: float = 0.0, z_m: float = 0.0) -> dict[str, Any]:
    """Return a pose on the floor, or `z_m` above it."""
    return {"position": {"x": x_m, "y": y_m, "z": z_m}, "orientation": turned(angle_rad)}


def transform(parent: str, child: str, stamp_ns: int, place: Sequence[float] | None = None) -> dict[str, Any]:
    """Return a transform to a place that begins with x, y and heading, as a state does; without one the identity."""
    x_m, y_m, heading_rad = (0.0, 0.0, 0.0) if place is None else place[:3]
    return {
        "header": header(parent, stamp_ns), "child_frame_id": child,
        "transform": {"translation": {"x": x_m, "y": y_m, "z": 0.0}, "rotation": turned(heading_rad)},
    }  # fmt: skip


# ---------------------------------------------------------------- one robot
def odometry(name: str, state: RobotState, stamp_ns: int) -> dict[str, Any]:
    """Return a robot's pose in its frame ``odom``, and its twist in its own frame."""
    covariance = np.zeros(36)
    if state.sigma_m > 0.0:
        covariance[0] = covariance[7] = state.sigma_m**2
    if state.sigma_rad > 0.0:
        covariance[35] = state.sigma_rad**2
    return {
        "header": header(f"{name}/odom", stamp_ns), "child_frame_id": f"{name}/base_link",
        "pose": {"pose": pose(state.x_m, state.y_m, state.heading_rad), "covariance": covariance},
        "twist": {"twist": {"linear": {"x": state.speed_m_s}, "angular": {"z": state.turn_rad_s}}},
    }  # fmt: skip


def battery(name: str, health: RobotHealth, stamp_ns: int) -> dict[str, Any]:
    """Return the state of a battery whose charge is known; ROS writes what is not known as NaN."""
    status = {None: CHARGING_UNKNOWN, True: CHARGING, False: DISCHARGING}[health.charging]
    unknown = dict.fromkeys(("voltage", "temperature", "current", "charge", "capacity", "design_capacity"), math.nan)
    return {
        "header": header(f"{name}/base_link", stamp_ns), **unknown, "percentage": health.battery,
        "power_supply_status": status, "present": True,
    }  # fmt: skip


def laser_scan(frame: str, scan: SensorScan, stamp_ns: int) -> dict[str, Any]:
    """Return a scan with the time of its last ray; by REP 117 what is infinite is not there, NaN was not measured."""
    bins = unpack(scan)
    last_rad = bins.first_rad + bins.step_rad * max(0, len(bins.distances_m) - 1)
    return {
        "header": header(frame, stamp_ns), "angle_min": bins.first_rad, "angle_max": last_rad,
        "angle_increment": bins.step_rad, "scan_time": scan.duration_s, "range_max": scan.max_m,
        "ranges": bins.distances_m,
    }  # fmt: skip


# ---------------------------------------------------------------- the whole swarm
def occupancy_grid(place: GridPlace, cells: Any, stamp_ns: int) -> dict[str, Any]:
    """Return the grid that robots have measured; `cells`: (rows · columns,) int8."""
    return {
        "header": header(MAP, stamp_ns),
        "info": {
            "map_load_time": time_of(stamp_ns), "resolution": place.cell_m, "width": place.columns,
            "height": place.rows, "origin": pose(place.x_min, place.y_min),
        },
        "data": cells,
    }  # fmt: skip


def diagnostic(level: int, name: str, text: str, values: Mapping[str, str], hardware: str = "") -> dict[str, Any]:
    """Return one entry of a DiagnosticArray."""
    listed = [{"key": key, "value": value} for key, value in values.items()]
    return {"level": level, "name": name, "message": text, "hardware_id": hardware, "values": listed}


def robot_markers(
    robot: str, name: str, state: RobotState, goal: Sequence[float] | None, stamp_ns: int
) -> list[dict[str, Any]]:
    """Return what RViz draws of a robot: body, heading, name, and where it is driving to."""
    hue = zlib.crc32(robot.encode()) % 360 / 360.0  # the same in each run
    colour = (*colorsys.hsv_to_rgb(hue, 0.6, 0.9), 0.9)
    frame, radius_m = f"{name}/base_link", state.radius_m
    found = [
        _marker("bodies", robot, CYLINDER, frame, stamp_ns, pose(z_m=0.5 * BODY_M),
                (2.0 * radius_m, 2.0 * radius_m, BODY_M), colour),
        _marker("headings", robot, ARROW, frame, stamp_ns, pose(z_m=BODY_M),
                (1.1 * radius_m, 0.2 * radius_m, 0.2 * radius_m), WHITE),
        _marker("names", robot, TEXT, frame, stamp_ns, pose(z_m=BODY_M + NAME_M), (0.0, 0.0, NAME_M), WHITE,
                text=robot),
    ]  # fmt: skip
    if goal is not None:
        place = pose(goal[0], goal[1], z_m=0.5 * BODY_M)
        found.append(_marker("goals", robot, SPHERE, MAP, stamp_ns, place, (BODY_M, BODY_M, BODY_M), colour))
        line = [{"x": state.x_m, "y": state.y_m, "z": 0.01}, {"x": goal[0], "y": goal[1], "z": 0.01}]
        found.append(_marker("ways", robot, LINE_STRIP, MAP, stamp_ns, pose(), (0.02, 0.0, 0.0), colour, points=line))
    return found


def obstacle_markers(rows: Iterable[tuple[float, ...]], stamp_ns: int) -> list[dict[str, Any]]:
    """Return a box for each obstacle, corner radius included: centre x, y, half sizes x, y, yaw, corner radius."""
    found = []
    for number, (x_m, y_m, half_x_m, half_y_m, yaw_rad, corner_m) in enumerate(rows):
        size = (2.0 * (half_x_m + corner_m), 2.0 * (half_y_m + corner_m), WALL_M)
        place = pose(x_m, y_m, yaw_rad, 0.5 * WALL_M)
        found.append(_marker("obstacles", number, CUBE, MAP, stamp_ns, place, size, GREY))
    return found


def _marker(
    group: str, number: str | int, shape: int, frame: str, stamp_ns: int, place: dict[str, Any],
    size: tuple[float, float, float], colour: Sequence[float], **more: Any,
) -> dict[str, Any]:  # fmt: skip
    # RViz tells markers apart by group and number: a robot's must stay the same while others come and go.
    identity = number if isinstance(number, int) else zlib.crc32(number.encode()) & 0x7FFFFFFF
    whole_s = int(LASTS_S)
    return {
        "header": header(frame, stamp_ns), "ns": group, "id": identity, "type": shape, "action": 0, "pose": place,
        "scale": dict(zip("xyz", size, strict=True)), "color": dict(zip("rgba", colour, strict=True)),
        "lifetime": {"sec": whole_s, "nanosec": round(1e9 * (LASTS_S - whole_s))}, "frame_locked": True, **more,
    }  # fmt: skip
