"""The simulated make. In: twists of many bodies. Out: their poses, contacts and sensed obstacles.

``engine`` chooses the physics (``kinematic``, ``pybullet_engine``, ``pybullet_wheels``), ``obstacles`` gives it boxes
and walls; ``contacts`` judges who touched whom on the paths that it gives; ``world`` adds what every robot has
whatever the physics: limits, watchdog, odometry, sensors. Two ways lead into a world: ``fleet`` puts a
whole swarm's arrays on it in one process (lockstep), ``emulator`` serves it over UDP to one ``driver`` per robot
(``protocol`` is their wire). Emulators of other makes hold a ``World`` in the same way.
"""
