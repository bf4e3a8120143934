"""What is known of the robots that ``model=`` names: footprint, limits and watchdog, from their makers' documents.

The footprint is a disc around the point that the odometry counts (between the wheels), so a robot whose body lies
behind that point has a larger one than its size says.

``watchdog_s`` is that of the base alone, as delivered: after this silence on ``cmd_vel`` it stops by itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

from fullswarm.drivers.base import Limits, Pose

MIDDLE = Pose(0.0, 0.0, 0.0)
"""A sensor between the wheels that looks ahead."""


@dataclass(frozen=True, slots=True)
class Model:
    """A robot; topics are those that its own bring-up serves, empty: none."""

    make: str
    label: str
    radius_m: float
    limits: Limits
    watchdog_s: float | None
    battery: str = "battery_state"
    hazards: str = ""  # irobot_create_msgs/HazardDetectionVector
    stamped: bool = False
    scan_max_m: float = 0.0  # how far its lidar sees; 0: it is delivered without one, or with different ones
    scan_at: Pose = MIDDLE


def _limits(speed_m_s: float, turn_rad_s: float, accel: float, turn_accel: float, *, reverse: bool = True) -> Limits:
    return Limits(speed_m_s, turn_rad_s, accel, turn_accel, can_reverse=reverse)


MODELS = MappingProxyType(
    {
        # e-Manual, "Specifications" (speeds), turtlebot3_navigation2/param (footprint). The firmware limits no
        # acceleration; 1 m/s² is our assumption. turtlebot3_node passes each cmd_vel on and has no timeout: the
        # firmware's watches the node alone (ROBOTIS-GIT/turtlebot3#1154), so the last velocity is kept.
        # The lidar: turtlebot3_description/urdf, "scan_joint"; the older of both kinds, LDS-01, sees 3.5 m.
        "turtlebot3": Model(
            "ROBOTIS", "TurtleBot 3 Burger", 0.143, _limits(0.22, 2.84, 1.0, 6.0), None,
            scan_max_m=3.5, scan_at=Pose(-0.032, 0.0, 0.0),
        ),
        "turtlebot3_waffle": Model(
            "ROBOTIS", "TurtleBot 3 Waffle Pi", 0.257, _limits(0.26, 1.82, 1.0, 4.0), None,
            scan_max_m=3.5, scan_at=Pose(-0.064, 0.0, 0.0),
        ),
        # create3_docs, "Safety" (0.306 m/s with safety enabled, a backup limit: it does not reverse for longer than
        # centimetres) and "Moving the robot" (a fixed timeout); create3_sim states it: 0.5 s, 1.9 rad/s, and the
        # wheels' default of 0.9 m/s².
        "create3": Model(
            "iRobot", "Create 3", 0.171, _limits(0.306, 1.9, 0.9, 7.7, reverse=False), 0.5, hazards="hazard_detection"
        ),
        # turtlebot4_description/urdf/standard: an RPLIDAR A1 behind the middle, turned by a quarter.
        "turtlebot4": Model(
            "Clearpath", "TurtleBot 4", 0.175, _limits(0.306, 1.9, 0.9, 7.7, reverse=False), 0.5,
            hazards="hazard_detection", scan_max_m=12.0, scan_at=Pose(-0.04, 0.0, math.pi / 2.0),
        ),
        # rosbot_ros, rosbot_controller/config: velocity and acceleration limits, cmd_vel_timeout; sizes of the manuals.
        "rosbot": Model("Husarion", "ROSbot 2R", 0.155, _limits(1.0, 3.14, 1.0, 4.0), 0.5, battery="battery"),
        "rosbot_xl": Model("Husarion", "ROSbot XL", 0.233, _limits(0.8, 3.14, 1.0, 4.0), 0.5, battery="battery"),
    }
)  # fmt: skip
"""By the word of ``model=``."""
