"""Patrol: robots visit places again and again, always those that have waited longest for a visit.

Conscientious agents that share what they know (Machado et al., Multi-agent patrolling, MABS 2002; Portugal and Rocha,
Distributed multi-robot patrol, Robot. Auton. Syst. 2013): the shared table holds when each place was last visited, the
later time of two; robots broadcast where they are driving to, and none drives to the place of another. A robot chooses
the place with the greatest idleness on arrival per second that it takes, ``(t + d / v) / (d / v + 1 s)``. Ways lead
around obstacles as in :mod:`~fullswarm.agent.behaviours.navigate`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fullswarm.agent.behaviours import navigate
from fullswarm.agent.view import Params, View
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array, Index
from fullswarm.memory import rows

MOST = 64
MERGE = {"visit": max}
LEAST_S = 1.0


@dataclass
class Memory:
    """The place that the robot drives to, -1: none yet."""

    place: Index = rows(fill=-1)


@dataclass
class Says:
    """The place that its sender drives to."""

    place: Index = rows(fill=-1)


def velocity(view: View, params: Params, memory: Memory) -> Array:
    """Return the ways to the places, (n, 2) m/s."""
    places = np.array(params.places, float)
    if len(places) > MOST:
        raise ConfigError(f"{len(places)} places are too many", hint=f"{MOST} at most in one request")
    heard = view.heard
    for row, here in enumerate(view.position):
        place = int(memory.place[row])
        if place >= 0 and np.linalg.norm(places[place] - here) < params.arrive_radius_m[row, 0]:
            view.table.put(row, f"visit/{place}", float(view.time_s[row]))
            place = -1
        theirs, of = heard.place[heard.of == row], heard.index[heard.of == row]
        if place >= 0 and (of[theirs == place] < view.index[row]).any():
            place = -1  # chosen by both at once: the first of the request drives there
        if place < 0:
            place = _choose(view, row, places, theirs, float(params.speed_m_s[row, 0]))
        memory.place[row] = place
    view.say(place=memory.place)
    to = navigate.drive(view, params, places[memory.place])
    size = np.linalg.norm(to, axis=1, keepdims=True)
    desired: Array = to / np.maximum(size, 1e-6) * np.minimum(size, params.speed_m_s)
    return desired


def _choose(view: View, row: int, places: Array, taken: Index, speed_m_s: float) -> int:
    """Return the place with the greatest idleness per time that no other robot drives to."""
    now_s = float(view.time_s[row])
    visited_s = np.array([view.table.get(row, f"visit/{place}", 0.0) for place in range(len(places))])
    way_s = np.linalg.norm(places - view.position[row], axis=1) / speed_m_s
    worth = (now_s - visited_s + way_s) / (way_s + LEAST_S)
    worth[visited_s >= now_s] = -1.0  # it is there
    free = np.setdiff1d(np.arange(len(places)), taken)
    return int(free[worth[free].argmax()]) if len(free) else int(worth.argmax())
