"""Lidars on board, beside the driver of a robot of any make: ``ranges = "ld19:///dev/ttyUSB0"`` in ``[[robot]]``.

A lidar is no robot: it has no lifecycle and obeys nothing, so it is no driver. ``OneRobot`` adds its scans to what the
robot's driver reads, and counts as in FAULT while they are missing.

``protocol.py``  bytes of the LDROBOT and Slamtec lidars into turns
``sensor.py``    the lidar on its port: a thread that reads it, opens it again, and keeps the newest turn
``settings.py``  what a URL says: kind, port, where on the robot the lidar is
"""
