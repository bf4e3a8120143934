"""Consensus: robots agree on a meeting point by broadcasts, then drive there.

Each starts with its own position as estimate, ``ẋ_i = K Σ_j w_ij (x_j - x_i)`` with Metropolis weights
``w_ij = 1 / (1 + max(d_i, d_j))``, d being the number of neighbours (Xiao and Boyd, Fast linear iterations for
distributed averaging, Syst. Control Lett. 2004). The weights are symmetric, so the mean of all estimates stays; they
converge to it at the rate ``K λ₂``, λ₂ being the second-smallest eigenvalue of the weighted Laplacian (Olfati-Saber and
Murray, IEEE TAC 2004), if the network is connected. Lost broadcasts delay the agreement, and shift the point a little.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array
from fullswarm.memory import rows


@dataclass
class Memory:
    """Where the robot believes that all will meet."""

    estimate_m: Array = rows(2, fill=np.nan)


@dataclass
class Says:
    """The estimate, and how many robots its sender receives."""

    estimate_m: Array = rows(2)
    degree: Array = rows()


def velocity(view: View, params: Params, memory: Memory) -> Array:
    """Return zero while the robots agree, then the gain times the way to the point, (n, 2) m/s."""
    heard = view.heard
    estimate = np.where(np.isnan(memory.estimate_m), view.position, memory.estimate_m)
    weight = 1.0 / (1.0 + np.maximum(heard.count[heard.of, 0], heard.degree))
    change = heard.sum(weight[:, None] * (heard.estimate_m - estimate[heard.of]))
    memory.estimate_m = estimate + view.dt_s * params.rate * change
    view.say(estimate_m=memory.estimate_m, degree=heard.count[:, 0])
    agreed = view.time_s >= params.wait_s[:, 0]
    return params.gain * np.where(agreed[:, None], memory.estimate_m - view.position, 0.0)
