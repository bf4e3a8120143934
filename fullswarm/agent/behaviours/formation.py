"""Formation: each robot has its own target (paper III.A.4), ``ṗ_i = -K (p_i - E_i)``."""

from __future__ import annotations

from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array


def velocity(view: View, params: Params) -> Array:
    """Return ``K (E_i - p_i)``, (n, 2) m/s."""
    return params.gain * (params.target - view.position)
