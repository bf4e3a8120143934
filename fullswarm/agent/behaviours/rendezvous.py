"""Rendezvous: meet at a common point (paper III.A.3).

``dv_i = Σ_j d_ij`` over the neighbours sensed, normalised by their number: the mean, so that the speed of approach
does not depend on how many there are.
"""

from __future__ import annotations

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array


def velocity(view: View, params: Params) -> Array:
    """Return the gain times the mean offset to the neighbours, (n, 2) m/s; zero for a robot alone."""
    return params.gain * view.sum(view.offset) / np.maximum(view.neighbours, 1.0)
