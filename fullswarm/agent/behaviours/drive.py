"""Teleoperation in the robot's own frame: a stick for speed, one for turning."""

from __future__ import annotations

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array


def twist(view: View, params: Params) -> Array:
    """Return the sticks' shares of full speed and turn rate, (n, 2) m/s and rad/s."""
    del view
    return np.concatenate([params.linear * params.speed_m_s, params.angular * params.turn_rad_s], axis=1)
