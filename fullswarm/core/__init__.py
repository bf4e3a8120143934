"""The core layer (paper II.C): runs on the base station, decides which robot runs what, never touches one.

In: ``BehaviourRequest`` and ``StopRequest`` of the operators, ``HealthReport`` and ``ControlAck`` of the agents.
Out: ``ControlRequest`` and ``Command`` to each agent, ``RequestStatus`` to all, ``Heartbeat``.

``behaviours.toml``    the behaviours that exist: people edit this
``schema.py``          what a record may say
``records.py``         records in the local database; a request's parameters checked and completed
``shapes.py``          circle, line, grid: targets of a formation
``main_controller.py`` looks a request up, refuses or accepts it, hands it on
``newest.py``          which of an operator's requests is the newest for each robot
``request_handler.py`` makes every robot run what is wanted of it, whatever gets lost or restarts
``desired.py``         one robot: what is wanted, what it confirmed, what is on the way
``progress.py``        one request: from the states of its robots to its status
``status.py``          what became of each request
``remap.py``           the core's end of the centralised behaviours
``roster.py``          which robots are present
``settings.py``        settings: seeded from the fleet file, changed while it runs
``params.py``          the local database on the bus
``node.py``            wires all of it
``centralised/``       the centralised behaviours' own process

Further files:

``groups.py``   Groups of robots in the core's database: ``@name`` stands for them wherever a request names robots
``keep.py``     Writes the core's memory: a disk that is full or locked is complained about, and must not end the core
``latches.py``  Which robots are in e-stop: the second memory beside the agents' own
``leases.py``   Authority: who drives which robots (decision 17)
``outside.py``  Records of behaviours that other packages bring: their law is an entry point, their record lies beside
                the law
"""
