"""Identifies the robot on a port without moving it: for `fullswarm robots find` and `fullswarm doctor`.

- ``ask.py``: serial ports and URLs; runs the probe of each make
- ``line.py``: a serial port that is being probed
- ``found.py``: what was found
"""
