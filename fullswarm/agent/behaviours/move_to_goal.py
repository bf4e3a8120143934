"""Move to goal: a proportional law (paper III.A.1).

``ṗ = -K (p - E)``, whose solution is ``p(t) = E + (p(0) - E) e^{-Kt}`` (the paper drops the ``- E``). The goal is a
disc: inside `arrive_radius_m` the robot has arrived and stops.
"""

from __future__ import annotations

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array


def velocity(view: View, params: Params) -> Array:
    """Return ``K (E - p)`` outside the goal disc, zero inside, (n, 2) m/s."""
    error = params.goal - view.position
    away = error[:, :1] ** 2 + error[:, 1:] ** 2 > params.arrive_radius_m**2
    return np.where(away, params.gain * error, 0.0)
