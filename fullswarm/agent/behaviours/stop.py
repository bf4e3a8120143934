"""Stand still."""

from __future__ import annotations

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array


def twist(view: View, params: Params) -> Array:
    """Return zero for all robots, (n, 2)."""
    del params
    return np.zeros((len(view.position), 2))
