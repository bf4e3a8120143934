"""Behaviours computed on the base station for all their robots at once (paper II.C.1): a process of their own.

In: ``CentralisedRequest`` of the core, ``RobotStates`` of the agents.
Out: ``CentralisedCommands``, which the request handler distributes, and a ``Heartbeat`` with the active ids.

``node.py``          the process: requests, states, 20 Hz tick
``behaviours/``      the laws: best assignment of a formation, coverage on exact cells, the centroid by a stick
``law.py``           a law by name, and what is remembered of a request from call to call
``view.py``          what a law gets: all robots of the request
``joint_filter.py``  barrier certificates of all robots in one sparse QP (`_bc`)
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
from typing import Any

from fullswarm.errors import MissingExtra

PACKAGES = ("osqp", "scipy", "shapely")


@functools.cache
def missing_packages() -> tuple[str, ...]:
    """Return which packages of the extra ``[core]`` are not installed, without importing any."""
    return tuple(name for name in PACKAGES if importlib.util.find_spec(name) is None)


def need(package: str) -> Any:
    """Import a package of the extra ``[core]`` only when a centralised behaviour is requested.

    Raises
    ------
    MissingExtra
        It is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        hint = 'pip install "fullswarm[core]"'
        raise MissingExtra(f"centralised behaviours need {package}: {error}", hint=hint) from error
