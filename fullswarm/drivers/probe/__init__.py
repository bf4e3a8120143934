"""What robot is on a port, asked without moving it: for `fullswarm robots find` and `fullswarm doctor`.

- ``ask.py``: serial ports and URLs; asks the probe of each make
- ``line.py``: a serial port that is being asked
- ``found.py``: what was found
"""
