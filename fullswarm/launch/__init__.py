"""The composition root: builds nodes and gives them a bus and a clock.

In: a fleet file. Out: running processes, or a whole swarm in one process.

``nodes.py``        builds the nodes of each layer, the same for live processes and lockstep
``reload.py``       loads behaviours under development again when their files change
``processes.py``    one function per process: hub, core, centralised behaviours, agent, world
``on_board.py``     reports of an agent on a robot's computer to systemd and to the health file
``world.py``        the node of the simulated world
``lockstep.py``     all nodes in one process on a simulated clock
``supervisor.py``   starts the processes of a fleet file, watches them, restarts them, ends them
``spare.py``        processes that have imported everything, and become the next ones that died
``journals.py``     builds a process's nodes with a journal, and builds them again of one
``run_folder.py``   folders of a run, which no other user may enter: made, removed after a crash; bounded logs
``liveness.py``     how each process shows its supervisor that its loop runs
``complaints.py``   tells the person at the terminal of `up` what goes wrong, once each
``recorder.py``     whether recordings can be made here, and the recorder beside a swarm
``up.py``           `fullswarm up`: the supervisor in a terminal
``stopping.py``     checks a fleet file before a start: can its robots stop in time?
``web_console.py``  the web console as one more process beside a swarm
``observer.py``     serves what an observer receives to programs that connect: viewers, Prometheus
``network.py``      an emulated bad network between a process and its bus; ports: of emulated robots, free ones beside
                    another swarm
"""

HEALTH = "FULLSWARM_HEALTH"
"""Environment variable with the path of the health file, set by the robot's unit."""
