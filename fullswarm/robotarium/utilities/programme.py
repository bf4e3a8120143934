"""The quadratic programme behind the certificates: the nearest velocities that satisfy linear constraints, by OSQP.

    minimise |u - desired|²  subject to  rows u <= limits

Where no velocities satisfy all constraints (robots too near each other in a corner, or at the limits of their wheels),
the answer violates them by as little as possible, in the sum of squares.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import osqp
from scipy import sparse

from fullswarm.kernels import Array

SETTINGS: dict[str, Any] = {
    "verbose": False,
    "eps_abs": 1e-7,
    "eps_rel": 1e-7,
    "max_iter": 20_000,
    "adaptive_rho_interval": 50,  # by iterations, not by time: the same input gives the same answer
    "polishing": True,
}
NEARNESS = 1e-4
"""Weight of nearness to the desired velocities against violations, where the constraints cannot all hold."""


@dataclass(frozen=True)
class Constraints:
    """Linear constraints of the planar velocities of N robots: ``rows u <= limits``, u = (x, y) robot by robot.

    Attributes
    ----------
    rows : (m, 2N)
    limits : (m,)
    """

    rows: Array
    limits: Array

    def __add__(self, other: Constraints) -> Constraints:
        return Constraints(np.vstack([self.rows, other.rows]), np.concatenate([self.limits, other.limits]))


def nearest(desired: Array, constraints: Constraints) -> Array:
    """Return the velocities (2, N) nearest to the desired ones (2, N) that satisfy the constraints."""
    wanted = desired.ravel(order="F")
    size = np.linalg.norm(constraints.rows, axis=1)
    size[size == 0.0] = 1.0  # robots in one place have no direction; nothing to divide by
    rows, limits = constraints.rows / size[:, None], constraints.limits / size
    if (rows @ wanted <= limits).all():
        return desired
    found = _solve(sparse.identity(len(wanted), format="csc"), -wanted, sparse.csc_matrix(rows), limits)
    if found is None:
        found = _least_violation(wanted, rows, limits)
    return found.reshape((2, -1), order="F")


def _least_violation(wanted: Array, rows: Array, limits: Array) -> Array:
    """Minimise ``NEARNESS |u - wanted|² + |s|²`` with ``rows u - s <= limits``: this always has an answer."""
    count, size = rows.shape
    weights = sparse.diags(np.r_[np.full(size, NEARNESS), np.ones(count)], format="csc")
    relaxed = sparse.hstack([sparse.csc_matrix(rows), -sparse.identity(count)], format="csc")
    found = _solve(weights, np.r_[-NEARNESS * wanted, np.zeros(count)], relaxed, limits)
    return np.zeros(size) if found is None else found[:size]


def _solve(weights: Any, linear: Array, rows: Any, limits: Array) -> Array | None:
    solver = osqp.OSQP()
    solver.setup(weights, linear, rows, np.full(len(limits), -np.inf), limits, **SETTINGS)
    answer = solver.solve(raise_error=False)
    found: Array = answer.x
    return found if answer.info.status == "solved" and np.isfinite(found).all() else None
