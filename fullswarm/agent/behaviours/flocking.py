"""Flocking: separation, alignment and cohesion, each within its radius (paper III.A.2, Reynolds' boids).

A neighbour nearer than `repulsion_radius_m` pushes with ``-d/|d|``, one nearer than `alignment_radius_m` lends its
heading, one nearer than `attraction_radius_m` pulls with ``d``. The paper's alignment (``dv = 0, dθ = θ_j - θ_i``)
turns without saying how fast to go; here each robot adds a velocity along the mean heading of itself and its
neighbours, which has the same equilibrium: equal headings. Averages, not sums, keep the speed free of the density.

A kernel, because some thirty array operations on two or three neighbours cost a robot more than all else in a tick.
"""

from __future__ import annotations

import math

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array, Index, kernel


def velocity(view: View, params: Params) -> Array:
    """Return cruise, separation, alignment and cohesion added up, (n, 2) m/s."""
    desired = np.empty((len(view.position), 2))
    steer.run(
        view.heading, view.start, view.offset, view.distance, view.neighbour_heading, params.repulsion_radius_m,
        params.alignment_radius_m, params.attraction_radius_m, params.separation, params.alignment,
        params.cohesion, params.cruise_m_s, desired,
    )  # fmt: skip
    return desired


@kernel
def steer(
    heading: Array, start: Index, offset: Array, distance: Array, neighbour_heading: Array, repulsion_radius_m: Array,
    alignment_radius_m: Array, attraction_radius_m: Array, separation: Array, alignment: Array, cohesion: Array,
    cruise_m_s: Array, desired: Array,
) -> None:  # fmt: skip
    """Fill `desired` (n, 2), m/s. Neighbours as in the view; parameters are columns (n, 1)."""
    for i in range(heading.shape[0]):
        push_x = 0.0
        push_y = 0.0
        pull_x = 0.0
        pull_y = 0.0
        lent_x = 0.0
        lent_y = 0.0
        repulsion_m = float(repulsion_radius_m[i, 0])
        attraction_m = float(attraction_radius_m[i, 0])
        for pair in range(start[i], start[i + 1]):
            gap_m = float(distance[pair])
            x = float(offset[pair, 0])
            y = float(offset[pair, 1])
            if gap_m < repulsion_m:
                # Grows from 0 at the radius to 1 at contact, so that no robot chatters at the border.
                push = (1.0 - gap_m / repulsion_m) / max(gap_m, 1e-6)
                push_x -= push * x
                push_y -= push * y
            elif repulsion_m < gap_m < attraction_m:
                pull_x += x
                pull_y += y
            if gap_m < alignment_radius_m[i, 0]:
                lent_x += math.cos(neighbour_heading[pair])
                lent_y += math.sin(neighbour_heading[pair])
        along_x = math.cos(heading[i]) + alignment[i, 0] * lent_x
        along_y = math.sin(heading[i]) + alignment[i, 0] * lent_y
        length = max(math.sqrt(along_x * along_x + along_y * along_y), 1e-9)
        pull = cohesion[i, 0] / max(1, start[i + 1] - start[i])
        push = separation[i, 0]
        cruise = cruise_m_s[i, 0]
        desired[i, 0] = cruise * (along_x / length + push * push_x + pull * pull_x)
        desired[i, 1] = cruise * (along_y / length + push * push_y + pull * pull_y)
