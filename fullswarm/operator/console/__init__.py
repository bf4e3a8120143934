"""The web console: one page that shows a swarm and sends requests to it (extra ``[console]``).

In, from the bus: what :mod:`fullswarm.operator` receives, Interventions, SeenObstacles and CoverageMeasurement.
In, from the page: the frames of ``frames``. Out, to the page: JSON frames, each encoded once for all pages.

The nodes know neither asyncio nor a browser and run on any scheduler:

``gateway.py``   connects the bus to the pages: subscriptions, frames and their rates; read this first
``sessions.py``  carries out what one operator does: requests, driving, leases, stops
``handover.py``  hands robots over from one operator to another: offers, and what becomes of them
``presence.py``  tells which operators are here, and which robots they hold and drive
``undo.py``      plans what undoes an operator's newest request
``world.py``     mirrors the core's database: arena, behaviours, groups, places, orders of the robots
``detail.py``    samples all robots, and shows the details of those whose pane is open
``fields.py``    the numbers of a robot that can be charted: titles, units, meanings
``samples.py``   keeps these numbers and the metrics over time, bounded
``charts.py``    sends pages the charts that they show, of now and of the past
``fleet.py``     the table of robots, the states
``map.py``       trails, goals, obstacles, covered cells, robots that the filter holds back
``log.py``       the log: requests and outcomes, leases, changes of hub, core and robots
``stops.py``     tracks e-stops and stops: which robots have confirmed
``missions.py``  tracks missions: the newest state of each
``cameras.py``   tracks the cameras that see the robots, and encodes their pictures
``scans.py``     sends pages the range scans of the robots they look at, and asks for them meanwhile
``history.py``   keeps what pages were shown, in compressed segments
``timeline.py``  lets pages look back: sends segments at a bounded rate
``bookmarks.py`` moments with a name, kept beside a recording
``clips.py``     makes clips in a process of its own, and keeps them for download
``experiments.py``  lists, starts and stops experiments, in processes of their own
``children.py``  starts processes that work for pages behind all else, and ends them
``study.py``     conducts a trial of a human-swarm study: phases, probes, questionnaire, log of the input

The server knows no robots, and serves the runtime of the nodes on its own loop, without a further thread:

``frames.py``    the frames that a page may send, and their checks
``server.py``    the web application: files, WebSockets, frames that wait for a slow page
``tokens.py``    tokens: whose they are, what they allow, how long they count
``reports.py``   serves the reports of experiments, and has them made
``underlay.py``  what lies under the map: reads a plan, a map of ROS or tiles, and serves it
``access.py``    access control: Host, Origin, token, limits of unverified connections
``serve.py``     the loop, start and end; opens the page in a browser
``api/``         the interface for outside programs, on the same server

The page itself is in ``page/``, JavaScript with JSDoc types and no build step. A new panel is a module there, a section
of ``index.html`` and a line in ``main.js``:

``main.js``       puts the modules together; ``index.html``, ``style.css``, ``parts.css``: structure and looks
``link.js``       the WebSocket; ``store.js``: the newest of everything; ``tracks.js``: positions between two states
``commands.js``   requests and their answers, leases
``stops.js``      stop and e-stop: the panel, its receipts, what is shown and signalled while one is latched
``keyboard.js``   all keys
``drive.js``      driving with arrow keys and a gamepad: which button does what; ``stick.js``: a finger on the screen
``selection.js``  the selected robots
``fleet.js``      the table of robots; ``attention.js``: the strip above it that names those which need attention
``groups.js``     the groups, and making one of the selection
``detail.js``     the details of one robot; ``facts.js``: what it says, ``detail.css``: its looks
``panel.js``      the behaviours; ``forms.js``, ``field.js``: their parameters; ``terms.js``: team, needs and roles;
                  ``refusals.js``: when a refusal's cause is gone; ``words.js``: titles, and states in words for people
``places.js``     places on the map: their list, keeping one, drawing; ``saved.js``: requests kept under a name
``ranges.js``     what the range sensors of a few robots measure, on the map
``missions.js``   the missions: their steps, and the buttons that pause, resume, abort and confirm
``missionform.js``  a new mission of points that are picked on the map
``routes.js``     the missions on the map: places of their steps, numbered and joined
``layout.js``     tabs, menus that fold away, the side of the stick; ``signals.js``: sound and vibration
``summary.js``    the fleet in words
``experiments.js``  the panel of experiments; ``experiments.css``: its looks
``camera.js``     the pictures of the cameras; ``floorpicture.js``: one of them under the map, to scale;
                  ``floorworker.js``, ``floorwarp.js``: lay it on the floor
``people.js``      the operators on this console, and hand-over; ``people.css``: looks of it, of guide and log filter
``guide.js``       the guide for the first minute; ``tips.js``: tooltips
``logfilter.js``   which lines of the log are shown
``charts.js``     the charts, kept in the address; ``series.js``: what is charted, ``plot.js``: one chart,
                  ``chartform.js``: the form that chooses, ``charts.css``: their looks
``log.js``, ``legend.js``, ``banners.js``, ``toolbar.js``: the other panels, one each
``map.js``        the map: the loop that draws; ``ground.js``, ``robots.js``, ``sprites.js``: what it draws;
``labels.js``     where labels go: beside their robots, never over a robot or another label
``viewport.js``   which part of the world it shows; ``geometry.js``, ``palette.js``, ``theme.js``: helpers
``underlay.js``   what lies under the map: a plan, a map of ROS, tiles
``tools.js``      the tools of the map: goals, formations, measuring; ``pointer.js``: mouse, pen and fingers
``past.js``       plays the past into the store that is shown; ``timeline.js``, ``marks.js``: the bar, its panel
``study.js``      the dialogs of a study: briefing, probes, NASA-TLX; tells the console what is clicked
``dom.js``        helpers for elements and events
``uplot.js``      vendored, see ``vendored.toml``
"""
