"""The web console: one page on which people see a swarm and ask it for behaviours (extra ``[console]``).

In, from the bus: all that :mod:`fullswarm.operator` hears, and Interventions, SeenObstacles, CoverageMeasurement,
Leases. In, from the page: the frames of ``frames``. Out, to the page: JSON frames, each encoded once for all.

Two halves that meet in ``gateway``. The nodes know neither asyncio nor a browser and run on any scheduler:

``gateway.py``    collects, sends on, hands out desks; read this first
``desk.py``       one operator at one page: requests, driving, leases, stops
``world.py``      arena, behaviours and groups from the core's database, and what each robot shall run
``goals.py`` ``history.py`` ``ground.py`` ``alarms.py`` ``requests.py``  what the page draws, in small pieces
``report.py`` ``advice.py``  the fleet's table, and what to do about a robot that needs attention

The server knows no robots, and serves the runtime of the nodes on its own loop, with no thread more:

``server.py`` ``guard.py`` ``pages.py`` ``outbox.py``  HTTP, WebSocket, access control, slow clients
``connections.py``  what connections without the token may use up
``pump.py`` ``serve.py``  the loop, start and end

Further files:

``door.py``  Opens the page in the user's browser without its token on a command line, which other users can read
``news.py``  What happens to hub, core, robots and leases, as lines of the log: each change once
"""
