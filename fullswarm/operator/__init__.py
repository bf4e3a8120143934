"""Operator layer: what people use to ask the swarm for behaviours (paper II.B), and to see how it does.

Out: BehaviourRequest, StopRequest, EStop, ParamRequest. In: RequestStatus, EStopReceipt, HealthReport,
RobotStates, Summary, Heartbeat, ParamReply. Read ``client`` (asking), ``view`` (seeing), then ``cli``.

The package imports nothing by itself, so that ``fullswarm --help`` stays quick.
"""
