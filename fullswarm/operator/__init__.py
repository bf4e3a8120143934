"""Operator layer: what people use to ask the swarm for behaviours (paper II.B), and to see how it does.

Out: BehaviourRequest, StopRequest, EStop, ParamRequest. In: RequestStatus, EStopReceipt, HealthReport,
RobotStates, Summary, Heartbeat, ParamReply. Read ``client`` (asking), ``view`` (seeing), then ``cli``.

The package imports nothing by itself, so that ``fullswarm --help`` stays quick.

Further files:

``console/``          The web console: one page on which people see a swarm and ask it for behaviours (extra
                      ``[console]``)
``estop.py``          One e-stop order and the robots that have confirmed it
``estop_command.py``  The command ``estop``: presses until every robot has confirmed, and reports which have
                      not
``joystick/``         Driving with a gamepad: pads (SDL) → pilot (what it means) → requests, stops and e-stops
``known.py``          Names that exist: of the swarm that runs, of a fleet file, of the package
``lease_command.py``  The commands about leases: list the holders, and hold robots
``leases.py``         Holding robots: the operator's side of the leases that the core keeps
``mock.py``           The paper's mock publisher (III.A): asks for one behaviour again and again, as an impatient
                      operator would
``orders.py``         The commands that make robots do something: request, stop, drive, mock
``params.py``         Asks a layer's local database over the bus (paper II.A)
``reads.py``          The commands that look: status, watch, robots, behaviours, params
``render.py``         A snapshot of the swarm as a table that people read; it fits 80 columns and says everything in
                      words
``session.py``        A command's connection to a swarm: bus, keys and runtime, with Ctrl-C in order
``teleop.py``         Driving by hand: a stream of short-lived intents, and zero at its end
``values.py``         ``key=value`` from a command line → typed parameters
"""
