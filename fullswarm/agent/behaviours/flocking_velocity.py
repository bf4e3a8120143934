"""Flocking by velocity matching: robots move as one lattice to a point (algorithm 2 of Olfati-Saber).

``u_i = Σ_j φ(d_ij) d̂_ij + K_v Σ_j a_ij (v_j - v_i) + K_g (σ(q - p_i) - v_i)`` is the acceleration of each robot: a
force that is zero at the spacing, pushes below and pulls above it up to the range; matching of the neighbours'
velocities; and feedback to a common destination q, bounded by ``σ(z) = s z / sqrt(|z|² + 1)`` with the speed s, without
which a flock breaks apart (Olfati-Saber, Flocking for multi-agent dynamic systems, IEEE TAC 2006). The matching alone
brings all velocities to their mean (Cucker and Smale, IEEE TAC 2007): with all n in range at the rate ``n K_v``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array
from fullswarm.memory import rows


@dataclass
class Memory:
    """The velocity that the robot is to have."""

    velocity_m_s: Array = rows(2)


def velocity(view: View, params: Params, memory: Memory) -> Array:
    """Return the integral of the accelerations, (n, 2) m/s."""
    before = memory.velocity_m_s
    apart_m, spacing_m = view.distance, params.spacing_m[view.of, 0]
    reach_m = RANGE * spacing_m
    near = np.where(apart_m < reach_m, bump(apart_m / reach_m), 0.0)
    force = params.stiffness[view.of, 0] * near * (apart_m - spacing_m) / np.maximum(apart_m, 1e-6)
    matching = params.matching[view.of, 0] * near
    pairs = force[:, None] * view.offset + matching[:, None] * (view.neighbour_velocity - before[view.of])
    way = params.destination - view.position
    way *= params.speed_m_s / np.sqrt((way**2).sum(axis=1, keepdims=True) + 1.0)
    change = view.sum(pairs) + params.navigation * (way - before)
    after = before + view.dt_s * change
    fastest = FASTEST * params.speed_m_s
    memory.velocity_m_s = after / np.maximum(np.linalg.norm(after, axis=1, keepdims=True) / fastest, 1.0)
    return memory.velocity_m_s.copy()


RANGE = 1.2
"""Neighbours count up to the spacing times this, as in the paper: no further than the nearest of a lattice."""
FASTEST = 2.0
"""Greatest velocity, of the speed."""
SOFT = 0.9


def bump(share: Array) -> Array:
    """Return the weight of neighbours at a share of the range: 1, then falling smoothly to 0 at 1 (bump function)."""
    beyond = np.clip((share - SOFT) / (1.0 - SOFT), 0.0, 1.0)
    return 0.5 * (1.0 + np.cos(np.pi * beyond))
