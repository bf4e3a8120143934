"""The composition root: builds nodes and gives them a bus and a clock.

In: a fleet file. Out: running processes, or a whole swarm in one process.

``nodes.py``        builds the nodes of each layer, the same for live processes and lockstep
``processes.py``    one function per process: hub, core, centralised behaviours, agent, world
``world.py``        the node of the simulated world
``lockstep.py``     all nodes in one process on a simulated clock
``supervisor.py``   starts the processes of a fleet file, watches them, restarts them, ends them
``up.py``           `fullswarm up`: the supervisor in a terminal
``web_console.py``  the web console as one more process beside a swarm
``unit.py``         the agent's entry point on a robot's computer; ``on_board.py``: its reports to systemd and the
                    health file; ``notify.py``: the protocol of sd_notify
``latching.py``     where an agent of this machine keeps its latched e-stop
``network.py``      puts an emulated bad network between a process and its bus
``ports.py``        the ports of emulated robots, and free ports for a swarm that must not disturb another one
``guard.py``        turns an error of a command into one line and an exit code
``typed.py``        lines from the terminal or a pipe, polled by a timer
"""

HEALTH = "FULLSWARM_HEALTH"
"""Environment variable with the path of the health file, set by the robot's unit."""
