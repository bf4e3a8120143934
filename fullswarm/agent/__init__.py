"""The agent: the process on board of a robot (paper II.D). In: control requests, commands, neighbours' states.

Out: twists to the driver, states, health and measurements. One node object carries n robots as arrays: n is 1 on
board and the whole swarm in a lockstep trial, so both run the same control laws, filter and controller.

====================  ========================================================================================
``node.py``           wires the parts to the bus, the timers and each other; the tick
``state.py``          poses, twists, readings and set-points of the n robots; the node writes them
``view.py``           the input of a control law: the world as its robots sense it, and its parameters
``core_clock.py``     the core's clock, and how old neighbours' states are on arrival
``message_delay.py``  the delay of messages from a computer with another clock
``orders/``           incoming requests, commands, stops and e-stops; the tasks they create
``behaviours/``       one control law per file
``navigation/``       ways on a map, exactly, and the order in which robots drive through narrow passages
``safety/``           the barrier filter, and the resolution of its deadlocks
``mapping/``          what range sensors show: near obstacles, moving bodies, a shared occupancy grid
``messaging/``        what control laws broadcast to neighbours, and their shared table
``motion/``           from desired velocities to the set-points of the drivers
``pose/``             the estimated pose of each robot
``neighbours/``       estimates of other robots and of obstacles
``telemetry/``        what the agent publishes about its robots
====================  ========================================================================================
"""
