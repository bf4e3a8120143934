"""Orbit: drive around a point, counter-clockwise, at a given distance.

Along the tangent at the wished speed, plus a pull towards the circle: ``ṗ = v t + K (R - |d|) d/|d|`` with
``d = p - E`` and the tangent ``t``.
"""

from __future__ import annotations

import numpy as np
from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array


def velocity(view: View, params: Params) -> Array:
    """Return tangent and pull added up, (n, 2) m/s; a robot on the centre itself leaves it to the east."""
    away = view.position - params.centre
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    out = np.where(distance > 1e-6, away / np.maximum(distance, 1e-6), [1.0, 0.0])
    tangent = np.stack([-out[:, 1], out[:, 0]], axis=1)
    return params.speed_m_s * tangent + params.gain * (params.radius_m - distance) * out
