"""The agent: what runs on board of a robot (paper II.D). In: control requests, commands, neighbours' states.

Out: twists to the driver, states, health and measurements. One node object carries n robots as arrays: n is 1 on
board and the whole swarm in a lockstep trial, so both run the same control laws, filter and controller.

====================  ========================================================================================
``node.py``           wires the parts to the bus, the timers and each other; the tick
``state.py``          poses, twists, readings and set-points of the n robots; the node writes them
``view.py``           what a behaviour's control law gets: the world as its robots sense it, and its parameters
``message_delay.py``  how late messages of a computer with another clock are
``orders/``           what arrives: requests, commands, stops, e-stops; the tasks they make
``behaviours/``       one control law per file
``safety/``           the barrier filter, and what resolves its deadlocks
``motion/``           from desired velocities to the set-points of the drivers
``pose/``             the estimated pose of each robot
``neighbours/``       what robots know of others and of obstacles
``telemetry/``        what the agent publishes about its robots
====================  ========================================================================================
"""
