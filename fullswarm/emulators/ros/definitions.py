"""The message types of an emulated base: `rosbags` with the definitions of ROS 2 and of irobot_create_msgs.

Extra: ``pip install 'fullswarm[ros-emulator]'``.
"""

from __future__ import annotations

import functools
from typing import Any

from fullswarm.errors import MissingExtra

TWIST, TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
ODOMETRY, BATTERY, BOOL = "nav_msgs/msg/Odometry", "sensor_msgs/msg/BatteryState", "std_msgs/msg/Bool"
SCAN = "sensor_msgs/msg/LaserScan"
HAZARDS = "irobot_create_msgs/msg/HazardDetectionVector"
_HAZARD = "std_msgs/Header header\nuint8 type\n"
_HAZARD_VECTOR = "std_msgs/Header header\nHazardDetection[] detections\n"
"""As published in iRobotEducation/irobot_create_msgs, without comments and constants."""


@functools.cache
def typestore() -> Any:
    """Return the types.

    Raises
    ------
    MissingExtra
        rosbags is not installed.
    """
    try:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise MissingExtra(
            "an emulated ROS base needs the package rosbags", hint="pip install 'fullswarm[ros-emulator]'"
        ) from error
    store = get_typestore(Stores.ROS2_HUMBLE)
    found: dict[str, Any] = {}
    found.update(get_types_from_msg(_HAZARD, "irobot_create_msgs/msg/HazardDetection"))
    found.update(get_types_from_msg(_HAZARD_VECTOR, HAZARDS))
    store.register(found)
    return store
