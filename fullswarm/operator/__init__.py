"""Operator layer: requests behaviours of a swarm (paper II.B) and shows its state. A library: ``cli/`` prints.

Out: BehaviourRequest, MissionRequest, StopRequest, EStop, LeaseRequest, ParamRequest. In: RequestStatus, MissionStatus,
EStopReceipt, HealthReport, RobotStates, Summary, Heartbeat, Leases, ParamReply. The package imports nothing by itself,
so that ``fullswarm --help`` appears at once.

``swarm.py``        a live swarm in a Python program: ``from fullswarm import Swarm``
``outcome.py``      reads what the core says of a request: whether it has ended, and which error a refusal is
``target.py``       the swarm and the operator of a command; says at once when there is no hub
``session.py``      connects one command to a swarm: bus, keys and runtime, with an orderly Ctrl-C
``client.py``       sends requests, stops and e-stops; the paper's mock publisher; read this first
``estop.py``        repeats one e-stop until the robots have confirmed it
``leases.py``       holds robots: the operator's side of the leases that the core keeps
``teleop.py``       drives by hand: a stream of short-lived intents, and zero at its end
``missions.py``     starts and controls missions, and collects their states
``params.py``       reads and writes a layer's local database (paper II.A)
``view.py``         collects what a swarm publishes: the newest of everything, with its age
``scans.py``        asks robots for the scans of their range sensors, while they are looked at
``robot_state.py``  describes in a few words what a robot does, and the remedy
``render.py``       draws the swarm as a table for a terminal
``state_lines.py``  tells changes of the swarm's state as lines, for a pipe
``console/``        the web console (extra ``[console]``)
``joystick/``       driving with a gamepad (extra ``[joystick]``)
"""
