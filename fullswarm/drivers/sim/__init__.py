"""The simulated make. In: twists of many bodies. Out: their poses, contacts and sensed obstacles.

``engine`` chooses the physics (``kinematic``, ``pybullet_engine``, ``pybullet_wheels``), ``obstacles`` gives it boxes
and walls; ``contacts`` judges who touched whom on the paths that it gives; ``world`` adds what every robot has
whatever the physics: limits, watchdog, odometry, sensors. Two ways lead into a world: ``fleet`` puts a
whole swarm's arrays on it in one process (lockstep), ``emulator`` serves it over UDP to one ``driver`` per robot
(``protocol`` is their wire). Emulators of other makes hold a ``World`` in the same way.

Further files:

``bullet.py``             What both PyBullet engines share: a quiet client of one's own, static obstacles, steps whose
                          paths are known
``contact_kernels.py``    Which bodies touch: exact geometry along the paths of a world step, the same loops for every
                          engine
``kinematic_kernels.py``  The loops of the kinematic engine (see :func:`advance`)
``starts.py``             Where bodies stand at first: a spaced grid for those that do not say, and a check for all
``url.py``                ``sim://[host:port/]robot[?option=value&...]``: where a simulated robot lives and what it
                          can do
``world_kernels.py``      What a world does to every body once per step, whatever the engine
``bodies.py``             Bodies of the world for emulated firmware: what a skin drives instead of a free body
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
