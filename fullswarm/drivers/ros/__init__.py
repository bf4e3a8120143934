"""ROS robots that take ``cmd_vel`` and give ``odom``: TurtleBot 3 and 4, Create 3, ROSbot and others.

::

    driver.py              RosDriver: a session on one of the transports
    settings.py            the URL, checked
      models.py            footprint, limits and watchdog of known robots
    probe.py               listens for the odometry, without moving the robot
      session.py           the conversation as a state machine; no I/O, no clock of its own
        zenoh_wire.py      messages ↔ packets of the relay; keys of rmw_zenoh and zenoh-bridge-ros2dds
        rosbridge_wire.py  messages ↔ bytes of a rosbridge websocket. Extra: ``pip install 'fullswarm[ros]'``
      relay.py             the port: packets to and from the relay process
        relay_process.py   holds the zenoh session, and stops the robot of a driver that is silent or has died
      protocol.py          messages in CDR and JSON ↔ our own types

Set-points (twists) flow in, readings (odometry, twist, battery, hazards) flow out.
"""

from __future__ import annotations

from fullswarm.drivers.make import Emulation, Evidence, Icon, Make, Model

_TURTLEBOT3 = "?model=turtlebot3&watchdog=0.5"

MAKE = Make(
    name="ros",
    robots="ROS robots",
    schemes=("ros",),
    driver="fullswarm.drivers.ros.driver:RosDriver",
    claims="fullswarm.drivers.ros.settings:claims",
    example="ros://tcp/192.168.1.5:7447/turtlebot1?model=turtlebot3&watchdog=0.5",
    limits="`cmd_vel` and `odom` over rmw_zenoh, zenoh-bridge-ros2dds (`rmw=bridge`) or rosbridge "
    "(`ros://ws/host:9090`); records of TurtleBot 3 and 4, Create 3 and ROSbot; battery, hazards and an e-stop topic. "
    "A base that never stops by itself is refused over a network",
    extra="ros",
    guarded=True,
    emulation=Emulation(
        start="fullswarm.emulators.ros:start",
        models=(
            Model("turtlebot3", f"ros://tcp/127.0.0.1:{{port}}{_TURTLEBOT3}", place="tcp", first_port=7460),
            Model("turtlebot3_bridge", f"ros://tcp/127.0.0.1:{{port}}{_TURTLEBOT3}&rmw=bridge", place="tcp",
                  first_port=7560),
            Model("turtlebot3_rosbridge", f"ros://ws/127.0.0.1:{{port}}{_TURTLEBOT3}", place="tcp", first_port=9090),
            Model("turtlebot4", "ros://ws/127.0.0.1:{port}?model=turtlebot4&stamped=1", place="tcp", first_port=9190),
        ),
        bench="fullswarm.emulators.ros:on_bench",
        clients="fullswarm.emulators.ros:clients",
    ),
    probe="fullswarm.drivers.ros.probe",
    check="ROS robot: its bring-up and rmw_zenohd, zenoh-bridge-ros2dds or rosbridge_server are running, same network",
    icon=Icon("circle", "R"),
    evidence=(
        Evidence("emulated", "our emulator, whose messages rosbags encodes, over rmw_zenoh's keys, the bridge's and "
                 "rosbridge", "2026-11-26"),
    ),
)  # fmt: skip
