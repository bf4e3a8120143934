"""The web console: one page that shows a swarm and sends requests to it (extra ``[console]``).

In, from the bus: what :mod:`fullswarm.operator` receives, Interventions, SeenObstacles and CoverageMeasurement.
In, from the page: the frames of ``frames``. Out, to the page: JSON frames, each encoded once for all pages.

The nodes know neither asyncio nor a browser and run on any scheduler:

``gateway.py``   connects the bus to the pages: subscriptions, frames and their rates; read this first
``sessions.py``  carries out what one operator does: requests, driving, leases, stops
``world.py``     mirrors the core's database: arena, behaviours, groups, orders of the robots
``fleet.py``     the table of robots, the chart of metrics, the states
``map.py``       trails, goals, obstacles, covered cells, robots that the filter holds back
``log.py``       the log: requests and outcomes, leases, changes of hub, core and robots
``stops.py``     tracks e-stops and stops: which robots have confirmed

The server knows no robots, and serves the runtime of the nodes on its own loop, without a further thread:

``frames.py``    the frames that a page may send, and their checks
``server.py``    the web application: files, WebSockets, frames that wait for a slow page
``access.py``    access control: Host, Origin, token, limits of unverified connections
``serve.py``     the loop, start and end; opens the page in a browser

The page itself is in ``page/``: ``main.js`` puts its modules together.
"""
