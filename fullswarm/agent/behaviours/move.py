"""Teleoperated moves (paper II.B): ``move_left`` and so on, with a magnitude from the stick.

The direction is fixed in the record, in the operator's map: left is west (-x), forward is north (+y).
"""

from __future__ import annotations

from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array


def velocity(view: View, params: Params) -> Array:
    """Return ``magnitude * speed * direction``, the same for all, (n, 2) m/s."""
    return params.magnitude * params.speed_m_s * params.direction + 0.0 * view.position
