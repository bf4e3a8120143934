"""Dispersion: spread until no neighbour is nearer than a given distance.

Springs that only push, as in Howard, Matarić, Sukhatme, Mobile sensor network deployment using potential fields (DARS
2002), without its inertia: ``ṗ_i = -K Σ_j (s - d_ij)₊ d̂_ij``, the descent of ``K/2 Σ (s - d_ij)₊²``. Each edge of the
arena pushes in the same way from half that distance on. Two robots by themselves approach the distance as
``exp(-2 K t)``; robots that are far enough apart stand.
"""

from __future__ import annotations

import numpy as np

from fullswarm.agent.navigation.edges import inwards
from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array


def velocity(view: View, params: Params) -> Array:
    """Return the gain times the sum of what the springs are compressed by, (n, 2) m/s."""
    short_m = np.maximum(params.spacing_m[view.of, 0] - view.distance, 0.0)
    away = -view.offset * (short_m / np.maximum(view.distance, 1e-6))[:, None]
    reach_m = 0.5 * params.spacing_m
    return params.gain * (view.sum(away) + reach_m * inwards(view.position, view.bounds_m, reach_m))
