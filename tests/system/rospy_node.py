"""A node of ROS 1 for tests, run by the system's Python: prints what it has received as one line of JSON.

It uses Debian's own message classes, which share nothing with the bridge. Those of nav_msgs bring 138 MB of headers
with them: where they are not installed, ROS's own genpy reads the odometry by the definition that comes with it.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import genpy.dynamic
import rospy
from geometry_msgs.msg import Twist
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

try:
    from nav_msgs.msg import Odometry
except ImportError:
    Odometry = None
SECONDS = 3.0


CLASSES: dict[str, Any] = {}


def read(message: Any) -> Any:
    """Return a message of any type as an object."""
    if not isinstance(message, rospy.AnyMsg):
        return message
    header = message._connection_header
    kind = header["type"]
    if kind not in CLASSES:
        CLASSES.update(genpy.dynamic.generate_dynamic(kind, header["message_definition"]))
    found = CLASSES[kind]()
    found.deserialize(message._buff)
    return found


def main() -> None:
    robot, request = sys.argv[1:3]
    rospy.init_node("test_node", anonymous=True, disable_signals=True)
    odometry: list[tuple[float, Any]] = []
    answers: list[str] = []
    frames: list[str] = []
    rospy.Subscriber(
        f"/{robot}/odom", Odometry or rospy.AnyMsg, lambda message: odometry.append((time.monotonic(), read(message)))
    )
    scans: list[Any] = []
    rospy.Subscriber("/r2/scan", rospy.AnyMsg, lambda message: scans.append(read(message)))
    rospy.Subscriber("/swarm/answer", String, lambda message: answers.append(message.data))
    rospy.Subscriber("/tf_static", TFMessage, lambda message: frames.append(message.transforms[0].child_frame_id))
    ask = rospy.Publisher("/swarm/request", String, queue_size=5)
    drive = rospy.Publisher(f"/{robot}/cmd_vel", Twist, queue_size=5)
    limit_s = time.monotonic() + 20.0
    while (not odometry or not ask.get_num_connections() or not drive.get_num_connections()) and (
        time.monotonic() < limit_s
    ):
        time.sleep(0.02)
    began_s = time.monotonic()
    time.sleep(SECONDS)
    count = sum(at_s >= began_s for at_s, _ in odometry)
    start = odometry[-1][1].pose.pose.position
    ask.publish(request)
    while time.monotonic() < limit_s and not any(json.loads(each).get("running") for each in answers):
        time.sleep(0.02)
    time.sleep(1.0)
    place = odometry[-1][1].pose.pose.position
    requested_m = ((place.x - start.x) ** 2 + (place.y - start.y) ** 2) ** 0.5
    twist = Twist()
    twist.angular.z = 0.5
    turned = []
    for _ in range(30):
        drive.publish(twist)
        time.sleep(0.05)
        turned.append(odometry[-1][1].twist.twist.angular.z)
    time.sleep(1.0)
    sys.stdout.write(json.dumps({
        "hz": count / SECONDS, "requested_m": requested_m, "turn_rad_s": max(turned), "answers": answers,
        "after_rad_s": odometry[-1][1].twist.twist.angular.z, "frames": frames[-1:],
        "scan_frame": scans[-1].header.frame_id, "scan": [min(each, 1e9) for each in scans[-1].ranges],
    }) + "\n")  # fmt: skip


if __name__ == "__main__":
    main()
