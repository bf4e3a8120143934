"""Flocking: separation, alignment and cohesion, each within its radius (paper III.A.2, Reynolds' boids).

A neighbour nearer than `repulsion_radius_m` pushes with ``-d/|d|``, one nearer than `alignment_radius_m` lends its
heading, one nearer than `attraction_radius_m` pulls with ``d``. The paper's alignment (``dv = 0, dθ = θ_j - θ_i``)
turns without saying how fast to go; here each robot adds its wish to cruise along the mean heading of itself and its
neighbours, which has the same equilibrium: equal headings. Averages, not sums, keep the speed free of the density.
"""

from __future__ import annotations

import numpy as np

from fullswarm.agent.tasks import Params
from fullswarm.agent.view import Array, View


def velocity(view: View, params: Params) -> Array:
    """Return cruise, separation, alignment and cohesion added up, (n, 2) m/s."""
    of, distance = view.of, view.distance[:, None]
    unit = view.offset / np.maximum(distance, 1e-6)
    # Grows from 0 at the radius to 1 at contact, so that nobody chatters on the border.
    push = np.maximum(1.0 - distance / params.repulsion_radius_m[of], 0.0)
    separation = view.sum(-unit * push)
    near = distance < params.alignment_radius_m[of]
    alignment = _unit(_along(view.heading) + params.alignment * view.sum(_along(view.neighbour_heading) * near))
    far = (distance < params.attraction_radius_m[of]) & (distance > params.repulsion_radius_m[of])
    cohesion = view.sum(view.offset * far) / np.maximum(view.neighbours, 1.0)
    return params.cruise_m_s * (alignment + params.separation * separation + params.cohesion * cohesion)


def _along(heading: Array) -> Array:
    both = np.empty((len(heading), 2))
    np.cos(heading, out=both[:, 0])
    np.sin(heading, out=both[:, 1])
    return both


def _unit(vectors: Array) -> Array:
    length = np.sqrt(vectors[:, :1] ** 2 + vectors[:, 1:] ** 2)
    return vectors / np.maximum(length, 1e-9)
