"""A differential base with one motor controller per wheel on a CAN bus: ODrive (CANSimple) or VESC.

Twists go in, scaled to what both wheels can do, and leave as one set-point frame per wheel; heartbeats and
encoder estimates come back and leave as readings.

- ``protocol.py``: what the makes share; ``layout.py``: how messages lie in bytes; pure, as are
  ``odrive.py``, ``odrive_states.py``, ``vesc.py`` (all messages, both ways) and ``slcan.py`` (frames as text)
- ``odrive_axis.py``, ``vesc_motor.py``: one wheel's controller as the driver sees it
- ``kinematics.py``: two wheels ↔ one body, odometry; ``settings.py``: the URL, checked
- ``machine.py``, ``axis.py``: the lifecycle, without input or output
- ``port.py``, ``slcan_bus.py``, ``driver.py``: python-can and the link thread
- ``emulator.py``: the other end of the wire, of ``odrive_emulator.py`` or ``vesc_emulator.py``, ``spin.py``,
  ``wire.py`` and, for a serial adapter on a pseudo terminal, ``pty.py``

This folder is called ``can`` as well: inside it ``import can`` is absolute and means python-can.
"""
