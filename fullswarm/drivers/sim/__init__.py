"""The simulated make: a robot in a world process, reached over UDP. The world itself is in :mod:`fullswarm.simulation`.

``driver.py``    The session on UDP
``protocol.py``  The datagrams between driver and world
``session.py``   The conversation with the world as a state machine
``settings.py``  ``sim://[host:port/]robot[?option=value&...]``: the address and the options of a simulated robot
"""

from __future__ import annotations

from fullswarm.drivers.make import Icon, Make

MAKE = Make(
    name="sim",
    robots="simulated robots",
    schemes=("sim",),
    driver="fullswarm.drivers.sim.driver:SimDriver",
    claims="fullswarm.drivers.sim.protocol:claims",
    example="sim://127.0.0.1:7450/r1",
    limits="body of a world process; options as a query: `?speed_limit_m_s=4&turn_limit_rad_s=0.785&sensing_m=3`",
    extra="sim",
    simulated=True,
    icon=Icon("circle", "S"),
)
