"""A differential base with one motor controller per wheel on a CAN bus: ODrive (CANSimple) or VESC.

Twists go in, scaled to what both wheels can do, and leave as one set-point frame per wheel; heartbeats and
encoder estimates come back and leave as readings.

- ``protocol.py``, ``odrive.py``, ``vesc.py``: bytes only, pure
- ``kinematics.py``: two wheels ↔ one body, odometry
- ``settings.py``: the URL, checked
- ``machine.py``: the lifecycle, without input or output
- ``port.py``, ``driver.py``: python-can and the link thread
- ``emulator.py``: the other end of the wire

This folder is called ``can`` as well: inside it ``import can`` is absolute and means python-can.
"""
