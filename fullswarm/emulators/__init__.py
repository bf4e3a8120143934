"""Emulated robots: the other end of the wire of each make, on real ports, over a body of the simulated world.

No driver imports them and no robot gets them: they belong to the computer that runs a world or `fullswarm emulate`.
A make's record (:mod:`fullswarm.drivers.make`) names the functions of its folder here.

- ``can/``, ``create_oi/``, ``mavlink/``: what each make's record names
- ``faults.py``: injected faults of a link: chunks dropped, corrupted or delayed
- ``ports.py``: makes the folder of an emulated serial port
"""
