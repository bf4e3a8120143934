"""Drivers: one contract (:mod:`fullswarm.drivers.base`), one folder per make. In: twists. Out: readings.

Every folder has the same files: ``protocol.py`` (bytes only, pure), ``driver.py`` (owns the link) and
``emulator.py`` (the other end of the wire). See ``fullswarm/drivers/README.md`` for units, frames and signs.
"""
