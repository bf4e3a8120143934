"""Lidars that are added to any make's robot: LDROBOT LD06 and LD19, Slamtec RPLIDAR. Out: ``Reading.ranges``.

A lidar is a driver without wheels: the same link, lifecycle and faults as a robot's. ``ranges = "ld19:///dev/ttyUSB0"``
in ``[[robot]]`` adds it to a robot; :class:`~fullswarm.drivers.fleet.OneRobot` joins what both measure.

``protocol`` is bytes only: packets, nodes, answers, and the turns that they make up. ``session`` is the conversation
with a lidar as a state machine, from OPEN to FAULT and back. ``settings`` reads the URL, ``driver`` puts a session on a
serial port or a TCP connection.
"""

from __future__ import annotations

from fullswarm.drivers.make import Emulation, Evidence, Make, Model

LDROBOT = Make(
    name="ld19",
    robots="LDROBOT LD06 and LD19 lidars",
    schemes=("ld06", "ld19", "ld06+tcp", "ld19+tcp"),
    driver="fullswarm.drivers.lidar.driver:LidarDriver",
    claims="fullswarm.drivers.lidar.settings:claims",
    example="ld19:///dev/ttyUSB0",
    limits="12 m, 10 turns a second; each packet has a checksum",
    emulation=Emulation(
        start="fullswarm.emulators.lidar:start",
        models=(Model("ld19", "ld19://{port}"), Model("ld06", "ld06://{port}")),
    ),
    evidence=(Evidence("emulated", "our emulator; the packet printed in the manual", "2026-11-26"),),
)
SLAMTEC = Make(
    name="rplidar",
    robots="Slamtec RPLIDAR A1, A2, A3 and S1 lidars",
    schemes=("rplidar", "rplidar+tcp"),
    driver="fullswarm.drivers.lidar.driver:LidarDriver",
    claims="fullswarm.drivers.lidar.settings:claims",
    example="rplidar:///dev/ttyUSB0",
    limits="standard scan, which has no checksum; `baud=256000` for A2M7, A2M12, A3 and S1, `max_m=` beyond 12 m",
    emulation=Emulation(
        start="fullswarm.emulators.lidar:start",
        models=(Model("rplidar", "rplidar://{port}"),),
    ),
    evidence=(Evidence("emulated", "our emulator, which rplidar-roboticia reads as well", "2026-11-26"),),
)
