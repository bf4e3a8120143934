"""Navigate, each robot to its own target: :mod:`~fullswarm.agent.behaviours.navigate` with the goals of a formation."""

from __future__ import annotations

from fullswarm.agent.behaviours import navigate
from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array


def velocity(view: View, params: Params) -> Array:
    """Return velocities towards the next waypoints on the ways to the targets, (n, 2) m/s."""
    return navigate.drive(view, params, params.target)
