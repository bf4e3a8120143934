"""Cyclic pursuit: each robot pursues the next one, turned by an angle, which brings all onto one circle.

``ṗ_i = k R(α_i) (p_{i+1} - p_i)``: with ``α = π/n`` the robots drive on a circle at equal distances, for smaller angles
they meet, for larger ones they spiral outwards (Pavone and Frazzoli, Decentralized policies for geometric pattern
formation and path coverage, J. Dyn. Sys. Meas. Control 2007). The angle is corrected by the relative error of the gap,
which fixes the radius (Ramirez-Riberos, Pavone, Frazzoli, Miller, Distributed control of spacecraft formations via
cyclic pursuit, J. Guid. Control Dyn. 2010); ``k = v / (2 r sin(π/n))`` gives the speed v on it, so the rate is
``v / r``. An integral takes account of robots that turn late. If a robot is lost, the one behind it pursues the next.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array, Index
from fullswarm.memory import rows

INTEGRAL_PER_S = 0.1
MOST_RAD = 0.5
SLOWEST, FASTEST = 0.5, 2.0
"""Times the speed: limits of what the gap asks for."""


@dataclass
class Memory:
    """The integral of the gap's relative error."""

    outwards_rad: Array = rows()


def velocity(view: View, params: Params, memory: Memory) -> Array:
    """Return the turned pursuit of the next robot, (n, 2) m/s; zero for a robot alone."""
    to, alive = pursued(view)
    angle = np.pi / np.maximum(alive, 2)
    gap_m = 2.0 * params.radius_m[:, 0] * np.sin(angle)
    near = np.clip(1.0 - np.linalg.norm(to, axis=1) / gap_m, -1.0, 1.0)
    near = np.where(alive > 1, near, 0.0)
    memory.outwards_rad = np.clip(memory.outwards_rad + INTEGRAL_PER_S * view.dt_s * near, -MOST_RAD, MOST_RAD)
    turn = angle * (1.0 + params.gain[:, 0] * near) + memory.outwards_rad
    side = -1.0 if str(params.direction) == "counterclockwise" else 1.0
    (x, y), cos, sin = to.T, np.cos(turn), side * np.sin(turn)
    pull = np.stack([cos * x - sin * y, sin * x + cos * y], axis=1) / gap_m[:, None]
    size = np.linalg.norm(pull, axis=1, keepdims=True)
    speed: Array = params.speed_m_s * np.clip(size, SLOWEST, FASTEST) / np.maximum(size, 1e-6)
    return speed * pull


def pursued(view: View) -> tuple[Array, Index]:
    """Return the way to the next robot of the request that is sensed (n, 2) m, and how many there are (n,)."""
    count = max(len(view.members), 1)
    steps = (view.neighbour_index - view.index[view.of]) % count
    steps = np.where((view.neighbour_index >= 0) & (steps > 0), steps, count)
    fewest = np.full(len(view.position), count)
    np.minimum.at(fewest, view.of, steps)
    following = (steps < count) & (steps == fewest[view.of])
    alive = 1 + np.bincount(view.of[steps < count], minlength=len(view.position))
    return view.sum(np.where(following[:, None], view.offset, 0.0)), alive
