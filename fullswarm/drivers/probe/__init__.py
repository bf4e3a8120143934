"""What robot is on a port, asked without moving it: for `fullswarm robots find` and `fullswarm doctor`.

In: ports, URLs, CAN interfaces. Out: :class:`.found.Asked` with the robots :class:`.found.Found` and the driver URL of
each. ``ask`` serves serial ports and URLs; ``create``, ``mavlink`` and ``can_bus`` are each make's own part.

Further files:

``found.py``  What was found on a port
"""
