"""The simulated world: bodies, physics, contacts, sensors. In: twists of many bodies. Out: their poses and readings.

It runs where a world or lockstep trials run: no driver imports it and no release contains it. A robot that
drives in it has the driver of ``drivers/sim/`` (or, emulated, the one of its make).

``world.py``            The simulated world: an engine, and what every robot has with any engine
``engine.py``           The interface of a physics engine, and the table ``ENGINES`` that names them. A new engine is a
                        file, a line there and its name in ``EngineName`` of ``config/models.py``. The engines:
``kinematic.py``        Unicycles on exact arcs, no masses
``drivetrain.py``       The kinematic bodies behind dead time, motor lag, soft brakes, unequal wheels and slip
``pybullet_engine.py``  PyBullet, velocity-driven cylinders: the default
``pybullet_wheels.py``  PyBullet, wheel-driven bodies on a floor with friction
``contacts.py``         Decides which bodies touched during a step, in the same way for every engine
``approaches.py``       Follows how near bodies come to each other and to obstacles, and the least time to contact
``obstacles.py``        Boxes and walls as rows of numbers, and the distance of a point to one
``movers.py``           Bodies that no agent commands, on their way from waypoint to waypoint
``ghosts.py``           Real robots as bodies of the world, where they report to be
``batteries.py``        The bodies' batteries, and the docks that charge them
``sight.py``            Which other bodies a robot sees, and what hides them
``ranges.py``           What a range sensor measures: rays against boxes, walls, movers and robots
``pictures.py``         Renders what a camera above sees of flat things, with lens, blur, noise, glare and known truth
``starts.py``           Start poses: a spaced grid for robots without one, and a check of all

Three interfaces of a world:

``fleet.py``            Presents all robots of a world in this process as a fleet (lockstep)
``server.py``           Serves a world over UDP to one ``sim://`` driver per robot
``bodies.py``           The body that emulated firmware drives: one of a world, or one alone on an endless floor
"""
