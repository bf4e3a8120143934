"""fullswarm: runs swarm algorithms on robots, simulated or real, and measures how well they did.

Four layers: ``operator`` requests behaviours, ``core`` decides which robot runs what, ``agent`` controls one robot,
``drivers`` communicate with its hardware. ``perf`` measures. Read :mod:`fullswarm.messages` and :mod:`fullswarm.keys`
first: they define all communication between processes.

Further files:

``__main__.py``    ``python -m fullswarm``: the same entry point as the ``fullswarm`` command, and that of a robot's
                   unit
``audit/``         The audit log: who asked what of which robots, when, in a chain of hashes
``bringup/``       Brings up a robot: find it, test it, check this machine and the robot's computer
``bus/``           Publish and subscribe
``cli/``           The ``fullswarm`` command: one file per noun that parses, calls and prints
``clock.py``       The monotonic clock, the wall clock and a simulated one
``config/``        Settings of a swarm: TOML → typed, with all errors at once, each with its line
``demo/``          `fullswarm demo`: eight simulated robots drive to a goal, flock and meet
``deploy/``        Releases, cards, first installs, updates with automatic rollback
``earth.py``       Latitude and longitude in a swarm's own frame: the plane tangent to the WGS84 ellipsoid at the
                   swarm's origin
``emulators/``     Emulated robots of each make on real ports
``envs/``          Environments for Gymnasium and PettingZoo, and trained policies as behaviours
``errors.py``      The error tree
``evaluate/``      Experiments (paper IV): scenarios, trials, experiments, results
``exporter/``      Metrics of a live swarm for Prometheus
``files.py``       Replaces files in one step: a reader finds the old content or the new one; a disk that may fail
``fitness.py``     Decides whether a robot is fit for a request: capabilities, limits, make, charge
``geometry.py``    Angles, the unicycle map and frame changes
``heap.py``        The heap of a process that runs for weeks: free memory goes back to the system
``identity/``      Who a process is on the bus: roles, certificates, and which of them are valid
``kernels.py``     Kernels: small loops over arrays that run as plain Python on a robot and compiled in a lockstep
                   trial
``keys.py``        Every key expression of the bus
``lab/``           A swarm in a Python program or a notebook: ``from fullswarm import Lab``
``launch/``        The composition root: builds nodes and gives them a bus and a clock
``localization/``  Publishes external pose measurements, such as motion capture, as pose fixes
``maps/``          Occupancy maps: cells as boxes, tiles on the bus, files of ROS's map_server
``mcp_server/``    `fullswarm mcp`: a swarm for language models, by the Model Context Protocol
``kept.py``        Places on the map and requests that operators keep under a name in the core's database
``logs.py``        Loggers that load structlog with their first line, and where the lines go
``messages.py``    Every message on the wire: typed, versioned, immutable
``output.py``      stdout is data, stderr is progress
``reasons.py``     Why robots do not move and requests are refused: codes for programs, texts for people
``record/``        Recordings and views of a swarm: every message that an observer may receive, in MCAP files or in
                    viewers; replay of recordings
``journal/``       What the nodes of a process received and did, so that they can be run again on it
``recent.py``      A dict that keeps its newest entries
``memory.py``      Memory of a control law: arrays with one row per robot that are kept from call to call
``parameters.py``  Parameters of a request as a control law reads them
``portability.py`` What operating systems do differently: locks, users; refuses what a system has no means for
``profiles.py``    Columns of what robots are and can do, as control laws read them
``registry.py``    Drivers and behaviours by name: a table first, entry points for names that are not in it
``rehearse/``      Rehearses faults: a whole swarm on a simulated clock whose processes may die at any moment
``robotarium/``    Runs scripts of the Robotarium's simulator in a laboratory
``ros_bridge/``    The swarm as ROS 2 and ROS 1 see it, and commands of ROS for a named operator
``runtime.py``     Runs nodes: one thread, a mailbox and timers, on the wall clock or on a simulated one
``schemas.py``     JSON Schemas of the messages, for programs in other languages
``simulation/``    The simulated world: bodies, physics engines, contacts, sensors
``stderr.py``      Keeps a process alive whose log is on a full disk
``store.py``       A layer's local database (paper II.A): key → JSON value with its author, its time and its newest
                   changes
``study/``         Human-swarm studies: blinded conditions in a balanced order, measures of the operators
``testing/``       Checks and test doubles for control laws, drivers and nodes, here and in outside packages
``units.py``       Units by the suffix of a name: ``speed_m_s`` is in m/s
"""

from __future__ import annotations

__version__ = "0.1.0"
_LAZY = {
    "AsyncSwarm": "fullswarm.operator.swarm",
    "Lab": "fullswarm.lab",
    "Swarm": "fullswarm.operator.swarm",
}
"""Exported names by the module that has them: imported when first used, because a robot needs none of them.

Type checkers read ``__init__.pyi``.
"""


def __getattr__(name: str) -> object:
    """Import an exported name (PEP 562)."""
    if name not in _LAZY:
        raise AttributeError(f"module 'fullswarm' has no attribute '{name}'")
    import importlib

    return getattr(importlib.import_module(_LAZY[name]), name)


def __dir__() -> list[str]:
    """Return what can be imported from here."""
    return sorted({*globals(), *_LAZY})
