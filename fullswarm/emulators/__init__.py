"""Emulated robots of each make: firmware on real ports, which moves a body of the simulated world.

No driver imports them and no release contains them: they run where a world or `fullswarm emulate` runs.
A make's record (:mod:`fullswarm.drivers.make`) names the functions of its folder here.

- ``base.py``: the shell of all emulated robots: thread, links with injected faults, plugging; what a firmware must do
- ``ports.py``: the robot's ends of real links: pseudo terminal, UDP, TCP
- ``can/``, ``create_oi/``, ``mavlink/``, ``ros/``: each make's firmware, and what its record names
- ``lidar/``: lidars on a serial port
- ``ntrip/``: a caster of RTK corrections
- ``tof/``: time-of-flight sensors on an I2C bus
- ``mocap/``: players of motion capture systems, which speak the vendors' formats
"""
