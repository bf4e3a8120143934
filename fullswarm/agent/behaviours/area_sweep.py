"""Area sweep: robots cover a rectangle in lanes, each its own part of them (boustrophedon).

The lanes lie along the longer side, `lane_m` apart, and are shared out in blocks of neighbouring lanes, in the order of
the request (Choset, Coverage for robotics, Ann. Math. Artif. Intell. 2001, for a single cell). A robot drives its lanes
to and fro at a constant speed and ends with a result. In all that is a way of about the area divided by `lane_m`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array, Index
from fullswarm.memory import rows

REACH_M = 0.1
"""A corner so near is passed."""


@dataclass
class Memory:
    """The corner that the robot drives to."""

    corner: Index = rows(fill=0)


def velocity(view: View, params: Params, memory: Memory) -> Array:
    """Return the way to the next corner, and back onto the lane, (n, 2) m/s."""
    desired = np.zeros_like(view.position)
    members = max(len(view.members), 1)
    for row, (index, here) in enumerate(zip(view.index.tolist(), view.position, strict=True)):
        corners = way(np.array(params.area), float(params.lane_m[row, 0]), members, index)
        passed = int(memory.corner[row])
        if passed < len(corners) and np.linalg.norm(corners[passed] - here) < REACH_M:
            memory.corner[row] = passed = passed + 1
        if passed >= len(corners):
            view.finish([row], "arrived", f"{len(corners) // 2} lanes" if len(corners) else "no lane is left for it")
            continue
        before = corners[passed - 1] if passed else here
        desired[row] = _along(before, corners[passed], here, float(params.speed_m_s[row, 0]))
    return desired


def way(area: Array, lane_m: float, members: int, index: int) -> Array:
    """Return the corners (2 k, 2) of the k lanes of the robot at place `index` of the request.

    Raises
    ------
    ConfigError
        The area is no rectangle.
    """
    low, high = area.min(axis=0), area.max(axis=0)
    if len(area) < 2 or not (high - low > 1e-6).all():
        raise ConfigError("the area is no rectangle", hint="two opposite corners: area = [[0, 0], [8, 5]]")
    long = int(high[1] - low[1] > high[0] - low[0])
    width = high[1 - long] - low[1 - long]
    count = max(1, int(np.ceil(width / lane_m - 1e-9)))
    mine = np.arange(index * count // members, (index + 1) * count // members) if index >= 0 else np.arange(0)
    inset = min(0.5 * lane_m, 0.5 * (high[long] - low[long]))
    ends = np.array([low[long] + inset, high[long] - inset])
    corners = np.empty((2 * len(mine), 2))
    for lane, number in enumerate(mine.tolist()):
        forth = ends if lane % 2 == 0 else ends[::-1]
        corners[2 * lane : 2 * lane + 2, long] = forth
        corners[2 * lane : 2 * lane + 2, 1 - long] = low[1 - long] + (number + 0.5) * width / count
    return corners


def _along(start: Array, end: Array, here: Array, speed: float) -> Array:
    """Return a velocity along the line from `start` to `end`, bent back onto it, never slower than needed to arrive."""
    left = end - here
    line = end - start
    length = float(np.linalg.norm(line))
    if length > 1e-6:
        direction = line / length
        ahead = min(float(left @ direction), 0.5)
        left = left - (float(left @ direction) - ahead) * direction  # aims at most half a metre ahead on the line
    found: Array = speed * left / max(float(np.linalg.norm(left)), REACH_M)
    return found
