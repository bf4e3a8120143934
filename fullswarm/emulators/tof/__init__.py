"""Emulated time-of-flight sensors: VL53L1X behind a TCA9548A multiplexer, on an I2C bus at the end of a link.

- ``emulator.py``: the bus on its port, and what a person can do to it
- ``firmware.py``: frames, multiplexer and registers, written anew from the documents
"""
