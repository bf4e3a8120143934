"""Flocking that loses no robot: as :mod:`~fullswarm.agent.behaviours.flocking`, with a pull that grows without limit.

In `flocking` the pull of a neighbour ends at the attraction radius, and is a mean: a robot at the edge of the flock may
drift out of range, and is lost. Here the weight of a pull is ``w(d) = (r / (R - d))²`` beyond half the radius R, with
``r = R / 2``: near R it exceeds all other terms (edge tension; Ji and Egerstedt, Distributed coordination control of
multiagent systems while preserving connectedness, IEEE T-RO 2007). It acts on the pairs of the relative neighbourhood
graph only, those that have no third robot nearer to both: these keep the swarm connected (Toussaint, Pattern
Recognition 1980), each robot finds its own among its neighbours, and the flock may spread. Edges of the arena turn it.
"""

from __future__ import annotations

import math

import numpy as np

from fullswarm.agent.navigation.edges import inwards
from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array, Flags, Index, kernel

TIGHT = 0.98
"""Share of the radius beyond which the weight stays as it is: a robot that has come so far is pulled at full speed."""
TURN = 2.0
"""Weight of the push at the edge of the arena."""


def velocity(view: View, params: Params) -> Array:
    """Return cruise, separation, alignment and the pull that keeps the flock together, (n, 2) m/s."""
    apart_m, reach_m = view.distance, params.attraction_radius_m[view.of, 0]
    near_m = params.repulsion_radius_m[view.of, 0]
    away = np.where(apart_m < near_m, 1.0 - apart_m / near_m, 0.0)
    kept = relative_neighbours(view)
    pull = np.where(kept & (apart_m > near_m), tension(apart_m, reach_m) * params.cohesion[view.of, 0], 0.0)
    weight = (pull - params.separation[view.of, 0] * away) / np.maximum(apart_m, 1e-6)
    aligned = apart_m < params.alignment_radius_m[view.of, 0]
    along = np.stack([np.cos(view.neighbour_heading), np.sin(view.neighbour_heading)], axis=1)
    course = np.stack([np.cos(view.heading), np.sin(view.heading)], axis=1)
    course += params.alignment * view.sum(np.where(aligned[:, None], along, 0.0))
    course /= np.maximum(np.linalg.norm(course, axis=1, keepdims=True), 1e-6)
    turn = TURN * inwards(view.position, view.bounds_m, params.edge_m)
    return params.cruise_m_s * (course + view.sum(weight[:, None] * view.offset) + turn)


def tension(apart_m: Array, reach_m: Array) -> Array:
    """Return the weight of a pull at distances (e,): 1 up to half the reach, then growing to a pole at the reach."""
    share = np.clip(apart_m / reach_m, 0.5, TIGHT)
    return (0.5 / (1.0 - share)) ** 2


def relative_neighbours(view: View) -> Flags:
    """Return which pairs have no third robot that is nearer to both, (e,)."""
    kept = np.ones(len(view.of), np.bool_)
    relative.run(view.start, view.offset, view.distance, kept)
    return kept


@kernel
def relative(start: Index, offset: Array, distance: Array, kept: Flags) -> None:
    """Clear `kept` (e,) for pairs that have a third robot nearer to both; neighbours as in the view."""
    for i in range(start.shape[0] - 1):
        for pair in range(start[i], start[i + 1]):
            for third in range(start[i], start[i + 1]):
                if distance[third] < distance[pair]:
                    dx = offset[third, 0] - offset[pair, 0]
                    dy = offset[third, 1] - offset[pair, 1]
                    if math.sqrt(dx * dx + dy * dy) < distance[pair]:
                        kept[pair] = False
                        break
