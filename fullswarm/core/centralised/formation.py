"""Formation with the best assignment: which robot takes which target is decided for all at once (III.A.4).

The Hungarian method on squared distances: the sum is least, and straight paths of such an assignment do not cross.
A new assignment replaces the present one only when it is clearly better, so that noise changes no assignment.
"""

from __future__ import annotations

import numpy as np

from fullswarm.core.centralised import need
from fullswarm.core.centralised.law import Memory, Params, number
from fullswarm.kernels import Array, Index

CLEARLY = 0.9
"""The new sum of squares must be below this share of the present one."""


def velocities(positions: Array, headings: Array, params: Params, memory: Memory, rows: Index) -> Array:
    """Return ``K (E_a(i) - p_i)``, (n, 2) m/s; `memory["target"]` keeps the target index of each row (or -1)."""
    del headings
    targets = np.asarray(params["targets"], float).reshape(-1, 2)
    kept = memory.get("target")
    if kept is None or len(kept) <= rows.max(initial=-1):
        kept = memory["target"] = np.full(max(len(targets), rows.max(initial=-1) + 1), -1.0)
    chosen = assign(positions, targets, kept[rows].astype(np.int64))
    kept[:] = -1.0
    kept[rows] = chosen
    return number(params, "gain") * (targets[chosen] - positions)


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
