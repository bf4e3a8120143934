"""The composition root: the only place that knows all layers. It builds nodes and gives them a bus and a clock.

In: a fleet file. Out: running processes, or a whole swarm in one process.

``processes.py``   one function per process: hub, core, centralised behaviours, agent, world
``supervisor.py``  starts them as real processes, watches them, ends them
``lockstep.py``    the same nodes in one process on a simulated clock
``show.py``        the demonstration: drive to a goal, flock, meet
``main.py``        the ``fullswarm`` command
"""
