"""Line up: the robots take evenly spaced places on a line, in the order in which they stand along it.

A centralised law: which place is whose depends on all robots at once. No two robots change places, so no paths cross.
"""

from __future__ import annotations

import numpy as np
from fullswarm.core.centralised.view import View
from fullswarm.kernels import Array
from fullswarm.parameters import Params


def velocity(view: View, params: Params) -> Array:
    """Return the pull of each robot to its place, (n, 2) m/s."""
    line = params.end - params.start
    rank = np.argsort(np.argsort(((view.position - params.start) * line).sum(axis=1)))
    share = (rank[:, None] + 0.5) / len(rank)
    return params.gain * (params.start + share * line - view.position)
