"""Formation, assigned: drives a formation whose assignment of robots to targets is decided for all at once (III.A.4).

The Hungarian method on squared distances: the sum is least, and straight paths of such an assignment do not cross. A
new assignment replaces the present one only when it is clearly better, so that noise changes no assignment.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fullswarm.core.centralised import need
from fullswarm.core.centralised.view import View
from fullswarm.kernels import Array, Index
from fullswarm.memory import rows
from fullswarm.parameters import Params

CLEARLY = 0.9
"""The new sum of squares must be below this share of the present one."""


@dataclass
class Memory:
    """What is kept of each robot."""

    target: Index = rows(fill=-1)  # (n,) index of its target; -1: none yet


def velocity(view: View, params: Params, memory: Memory) -> Array:
    """Return ``K (E_a(i) - p_i)``, (n, 2) m/s."""
    targets = np.asarray(params.targets, float).reshape(-1, 2)
    memory.target = assign(view.position, targets, np.where(view.appeared, -1, memory.target))
    pull: Array = params.gain * (targets[memory.target] - view.position)
    return pull


def assign(positions: Array, targets: Array, kept: Index) -> Index:
    """Return a target index per robot.

    Parameters
    ----------
    positions : (n, 2) m
    targets : (m, 2) m, m >= n
    kept : (n,) present targets; -1: none
    """
    cost = ((positions[:, None, :] - targets[None, :, :]) ** 2).sum(axis=2)
    optimize = need("scipy.optimize")
    row, column = optimize.linear_sum_assignment(cost)
    best = np.empty(len(positions), np.int64)
    best[row] = column
    valid = bool((kept >= 0).all()) and bool((kept < len(targets)).all()) and len(set(kept.tolist())) == len(kept)
    everyone = np.arange(len(positions))
    if valid and cost[everyone, best].sum() >= CLEARLY * cost[everyone, kept].sum():
        return kept
    return best
