"""The simulated make. In: twists of many bodies. Out: their poses, contacts and sensed obstacles.

``engine`` chooses the physics (``kinematic``, ``pybullet_engine``, ``pybullet_wheels``); ``contacts`` judges who
touched whom on the paths that it gives; ``world`` adds what every robot has whatever the physics: limits, watchdog,
odometry, sensors. Two ways lead into a world: ``fleet`` puts a
whole swarm's arrays on it in one process (lockstep), ``emulator`` serves it over UDP to one ``driver`` per robot
(``protocol`` is their wire). Emulators of other makes hold a ``World`` in the same way.
"""

from __future__ import annotations

from fullswarm.drivers.make import Icon, Make

MAKE = Make(
    name="sim",
    robots="simulated robots",
    schemes=("sim",),
    driver="fullswarm.drivers.sim.driver:SimDriver",
    example="sim://127.0.0.1:7450/r1",
    limits="body of a world process; options as a query: `?speed_limit_m_s=4&turn_limit_rad_s=0.785&sensing_m=3`",
    extra="sim",
    simulated=True,
    icon=Icon("circle", "S"),
)
