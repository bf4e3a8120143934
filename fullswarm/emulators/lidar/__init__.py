"""Emulated lidars on a serial port: what an LD19 and an RPLIDAR A1 send of their surroundings.

- ``emulator.py``: the lidar on its port, and what a person can do to it
- ``firmware.py``: the bytes, written anew from the makers' documents
"""
