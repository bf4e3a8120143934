"""The core layer (paper II.C): runs on the base station, decides which robot runs what, has no connection to a driver.

In: ``BehaviourRequest``, ``MissionRequest`` and ``StopRequest`` of the operators, ``HealthReport`` and
``ControlAck`` of the agents. Out: ``ControlRequest``, ``Command`` and ``ChargeOrder`` to each agent,
``RequestStatus``, ``MissionStatus`` and ``ChargingStatus`` to all, ``Heartbeat``.

``behaviours.toml``    the behaviours that exist: people edit this
``behaviours.py``      reads and checks the records of behaviours; completes a request's parameters by its record
``main_controller.py`` looks a request up, refuses or accepts it, passes it on
``groups.py``          ``@name`` stands for a group of robots wherever a request names robots
``roles.py``           which robots take part in a request, and which role each has
``teams.py``           which robots the control laws of a request count as neighbours
``leases.py``          which operator drives which robots (decision 17)
``request_order.py``   which request or stop of an operator is the newest for each robot
``request_handler.py`` brings every robot to its desired state, whatever message is lost or process restarted
``desired.py``         one robot: its order, what it confirmed, the control request in flight
``request_status.py``  one request: its status, derived from the states of its robots and published
``missions.py``        runs missions: steps of requests with conditions, kept over restarts
``mission_state.py``   a mission's state machine, and what a step waits for; pure
``mission_facts.py``   where robots are and what metrics say, while a mission needs it
``mission_places.py``  which places on the map a step names; pure
``charging.py``        sends robots to docks and back, by their reports
``charge_plan.py``     which robots must go now, so that docks are not short later; pure
``energy.py``          what a robot draws, and how fast a dock charges it: learnt from its reports
``remap.py``           keeps the node of the centralised behaviours in step with the robots' desired states
``relay.py``           passes on states between robots that do not receive each other
``clock.py``           tells agents the core's time
``roster.py``          which robots are present
``latches.py``         which robots are in e-stop, in addition to the latches on board
``settings.py``        the core's settings in its local database, and the server that shows and changes them
``audit.py``           records what is asked and what comes of it in the audit log
``node.py``            wires all of it
``centralised/``       the centralised behaviours' own process
"""
