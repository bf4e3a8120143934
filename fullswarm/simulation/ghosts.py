"""Ghosts: real robots as bodies of the simulated world, where they report to be.

Simulated robots see them, feel them and cannot push them, as they do movers; the referee counts the contacts. The real
robots know of the simulated ones by their states, as of all robots. A ghost that has reported nothing yet is outside
the arena; one that falls silent stays where it was: the robot stands there.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from fullswarm.config import MoverConfig, WorldConfig
from fullswarm.messages import FITS, RobotStates
from fullswarm.simulation.movers import Movers

FASTEST_M_S = 2.0
"""Up to this speed the engines look ahead for what a ghost may touch."""
AHEAD_S = 0.3
"""A ghost goes on as it last reported for so long."""
OUTSIDE_M = 100.0
"""So far from the arena a ghost waits for its first report."""
APART_M = 10.0


def with_ghosts(world: WorldConfig, radius_m: Mapping[str, float]) -> WorldConfig:
    """Return the settings of a world with a further mover for each real robot, by the radii of their bodies in m."""
    x_max, y_max = world.bounds_m[2:]
    ghosts = tuple(
        MoverConfig(
            waypoints=((x_max + OUTSIDE_M + number * APART_M, y_max + OUTSIDE_M),), radius_m=each, speed_m_s=FASTEST_M_S
        )
        for number, each in enumerate(radius_m.values())
    )
    return world.model_copy(update={"movers": (*world.movers, *ghosts)})


class Ghosts:
    """Moves the last movers of a world, one per real robot, as the robots report.

    Parameters
    ----------
    robots : the real robots, in the order of :func:`with_ghosts`
    """

    def __init__(self, movers: Movers, robots: tuple[str, ...]) -> None:
        first = len(movers) - len(robots)
        self._movers, self._row = movers, {robot: first + number for number, robot in enumerate(robots)}
        self._newest: dict[str, tuple[float, tuple[float, float, float, float]]] = {}

    def report(self, states: RobotStates, now_s: float) -> None:
        """Take in states; those that count from a place of the robot's own say nothing of where it is."""
        if states.own_frame or self._row.keys().isdisjoint(states.robots) or not FITS[RobotStates](states):
            return
        columns = zip(states.x_m, states.y_m, states.heading_rad, states.speed_m_s, strict=True)
        for robot, state in zip(states.robots, columns, strict=True):
            if robot in self._row and all(map(math.isfinite, state)):
                self._newest[robot] = now_s, state

    def move(self, now_s: float) -> None:
        """Put all ghosts where the robots are now, before a step of the world."""
        for robot, (arrived_s, (x_m, y_m, heading_rad, speed_m_s)) in self._newest.items():
            way_m = speed_m_s * min(now_s - arrived_s, AHEAD_S)
            self._movers.put(self._row[robot], x_m + way_m * math.cos(heading_rad), y_m + way_m * math.sin(heading_rad))
