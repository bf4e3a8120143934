"""fullswarm: from a swarm algorithm to robots that move, and a number for how well they did.

Four layers, left to right: ``operator`` asks, ``core`` decides, ``agent`` drives one robot,
``drivers`` speak to its wheels. ``perf`` measures. Read :mod:`fullswarm.messages` and
:mod:`fullswarm.keys` first: they are everything that crosses a process border.

Further files:

``__main__.py``    ``python -m fullswarm``: the same entry point as the ``fullswarm`` command, and that of a robot's
                   unit
``bringup/``       From a cable to a robot that may drive: find it, test it, check this machine and the robot's
                   computer
``bus/``           Publish and subscribe
``cli/``           The ``fullswarm`` command: one file per noun that parses, calls and prints
``clock.py``       The monotonic clock, the wall clock and a simulated one
``config/``        Settings of a swarm: TOML → typed, with every error at once and where it stands
``demo/``          `fullswarm demo`: eight simulated robots drive to a goal, flock and meet, then belong to the
                   operator
``deploy/``        From a blank card to a robot that moves: releases, cards, first installs, updates that roll
                   themselves back
``earth.py``       Places on earth in a swarm's own frame: the plane that touches the WGS84 ellipsoid at the swarm's
                   origin
``emulators/``     Emulated robots: the other end of the wire of each make, on real ports
``errors.py``      The error tree
``evaluate/``      Experiments (paper IV): worlds, trials, how they are run, and what came of them
``geometry.py``    Angles, the unicycle map and frame changes
``kernels.py``     Kernels: small loops over arrays that run as plain Python on a robot and compiled in a lockstep
                   trial
``keys.py``        Every key expression of the bus
``launch/``        The composition root: builds nodes and gives them a bus and a clock
``localization/``  Poses from outside: what measures robots from the base station becomes pose fixes on the bus
``messages.py``    Every message on the wire: typed, versioned, immutable
``output.py``      stdout is data, stderr is progress
``reasons.py``     Why robots stand and requests are refused: codes for programs, texts for people
``recent.py``      A dict that keeps its newest entries
``registry.py``    Drivers and behaviours by name: a table first, entry points only on a miss
``runtime.py``     Runs nodes: one thread, a mailbox and timers, on the wall clock or on a simulated one
``simulation/``    The simulated world: bodies, physics engines, contacts, sensors
``store.py``       A layer's local database (paper II.A): key → JSON value with its author, its time and its newest
                   changes
``testing/``       Checks and stand-ins for the tests of laws, drivers and nodes, here and in outside packages
``units.py``       Units by the end of a name: ``speed_m_s`` is in m/s
"""

__version__ = "0.1.0"
