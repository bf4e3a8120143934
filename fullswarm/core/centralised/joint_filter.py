"""Barrier certificates of all robots at once (the paper's [11]): one sparse quadratic programme, solved by OSQP.

    minimise |u - u_wished|²  over the planar velocities u of all robots, subject to
    -n_ij·(u_i - u_j) <= γ max(d_ij - D_ij, 0)   for each pair within 3 m; n_ij from j to i, D_ij radii plus margin
    the same towards the walls, and |u| within the speed limit on each axis

u = 0 is always allowed. The certificates are for robots that can move in any direction. A unicycle cannot: it goes
along its heading while it turns towards u. :func:`to_twists` therefore checks the pairs again with the velocities that
the robots will really have, and slows those down that would close in too fast.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from fullswarm.core.centralised import need
from fullswarm.core.centralised.law import Array, Index

NEAR_M = 3.0
STAY_M = 3.5
"""A pair once in the programme stays until it is so far apart: fewer changes of the pattern, fewer set-ups."""

SETTINGS: dict[str, Any] = {
    "verbose": False,
    "eps_abs": 1e-4,
    "eps_rel": 1e-4,
    "max_iter": 4000,
    "adaptive_rho_interval": 50,  # by iterations, not by time: the same input gives the same answer
}
SWEEPS = 20


@dataclass(frozen=True, slots=True)
class Arena:
    """What all robots share: walls, limits, how fast gaps may close."""

    low: Array  # (2,) m
    high: Array
    speed_m_s: float
    gain_per_s: float  # γ
    margin_m: float


@dataclass(frozen=True, slots=True)
class Pairs:
    """Neighbouring pairs: `first` < `second`, unit vector from second to first, what the gap allows."""

    first: Index  # (k,)
    second: Index
    unit: Array  # (k, 2)
    budget_m_s: Array  # (k,) how fast they may close in, >= 0


class JointFilter:
    """The certificates of one set of robots, from tick to tick."""

    def __init__(self) -> None:
        self._osqp = need("osqp")
        self._sparse = need("scipy.sparse")
        self._solver: Any = None
        self._codes: Index = np.zeros(0, np.int64)  # one number per pair of the programme
        self._robots = -1
        self._order: Index = np.zeros(0, np.int64)
        self._answer: Array = np.zeros(0)
        self.setups = 0

    def filter(self, wished: Array, positions: Array, radii: Array, arena: Arena) -> tuple[Array, Pairs]:
        """Return the nearest allowed velocities (n, 2) and the pairs that were looked at.

        Velocities are zero for all when the solver has no answer.

        Parameters
        ----------
        wished : (n, 2) m/s
        positions : (n, 2) m
        radii : (n,) m
        """
        pairs = self._pairs(positions, radii, arena)
        low, high = _box(positions, radii, arena)
        upper = np.concatenate([high.ravel(), pairs.budget_m_s])
        lower = np.concatenate([low.ravel(), np.full(len(pairs.first), -np.inf)])
        data = np.concatenate([np.ones(wished.size), (-pairs.unit).ravel(), pairs.unit.ravel()])
        codes = pairs.first * len(wished) + pairs.second
        if self._solver is None or len(wished) != self._robots or not np.array_equal(codes, self._codes):
            self._set_up(wished, pairs, data, lower, upper)
            self._codes, self._robots = codes, len(wished)
        else:
            # The solver writes into the array that it is given.
            self._solver.update(q=-wished.ravel(), l=lower, u=upper, Ax=data[self._order].copy())
        answer = self._solver.solve(raise_error=False)
        solved = answer.info.status == "solved" and np.isfinite(answer.x).all()
        if not solved:  # an infeasible answer holds huge values
            return np.zeros_like(wished), pairs
        self._answer = np.array(answer.x, float)
        allowed: Array = np.clip(np.asarray(answer.x, float).reshape(-1, 2), low, high)
        return allowed, pairs

    def _pairs(self, positions: Array, radii: Array, arena: Arena) -> Pairs:
        tree = need("scipy.spatial").cKDTree(positions)
        found = tree.query_pairs(STAY_M, output_type="ndarray").astype(np.int64).reshape(-1, 2)
        found = found[np.argsort(found[:, 0] * len(positions) + found[:, 1])]
        offset = positions[found[:, 0]] - positions[found[:, 1]]
        distance = np.linalg.norm(offset, axis=1)
        keep = distance <= NEAR_M
        if self._robots == len(positions):
            keep |= np.isin(found[:, 0] * self._robots + found[:, 1], self._codes)
        found, offset, distance = found[keep], offset[keep], distance[keep]
        unit = offset / np.maximum(distance, 1e-9)[:, None]
        gap = distance - radii[found[:, 0]] - radii[found[:, 1]] - arena.margin_m
        return Pairs(found[:, 0], found[:, 1], unit, arena.gain_per_s * np.maximum(gap, 0.0))

    def _set_up(self, wished: Array, pairs: Pairs, data: Array, lower: Array, upper: Array) -> None:
        size, count = wished.size, len(pairs.first)
        limits, both = np.arange(size), np.repeat(size + np.arange(count), 2)
        rows = np.concatenate([limits, both, both])
        first = (2 * pairs.first[:, None] + [0, 1]).ravel()
        second = (2 * pairs.second[:, None] + [0, 1]).ravel()
        columns = np.concatenate([limits, first, second])
        # Entries numbered from one, so that none is taken for a zero: the pattern must hold what is zero only now.
        numbered = np.arange(1, len(data) + 1, dtype=float)
        pattern = self._sparse.coo_matrix((numbered, (rows, columns)), shape=(size + count, size)).tocsc()
        self._order = pattern.data.astype(np.int64) - 1
        pattern.data = data[self._order].copy()
        self._solver = self._osqp.OSQP()
        identity = self._sparse.eye(size, format="csc")
        self._solver.setup(identity, -wished.ravel(), pattern, lower, upper, **SETTINGS)
        if len(self._answer) == size:
            self._solver.warm_start(x=self._answer)
        self.setups += 1


def _box(positions: Array, radii: Array, arena: Arena) -> tuple[Array, Array]:
    """Return the least and the greatest velocity on each axis, (n, 2) m/s: speed limit and walls, zero allowed."""
    room = radii[:, None] + arena.margin_m
    to_low = arena.gain_per_s * np.maximum(positions - arena.low - room, 0.0)
    to_high = arena.gain_per_s * np.maximum(arena.high - positions - room, 0.0)
    return -np.minimum(to_low, arena.speed_m_s), np.minimum(to_high, arena.speed_m_s)


def to_twists(
    velocities: Array, pairs: Pairs, positions: Array, headings: Array, radii: Array, arena: Arena, turn: Array
) -> Array:
    """Map allowed velocities to speeds and turn rates (n, 2) under which no gap closes too fast.

    A robot goes with the projection of its velocity on its heading and never backwards: with more than 90° to
    turn it stands and turns. Turning is always free, it moves no disc.

    Parameters
    ----------
    velocities : (n, 2) m/s
    headings : (n,) rad
    turn : (2,) gain K_w in 1/s and limit in rad/s
    """
    size = np.linalg.norm(velocities, axis=1)
    wished = np.arctan2(velocities[:, 1], velocities[:, 0])
    error = np.arctan2(np.sin(wished - headings), np.cos(wished - headings))
    ahead = np.stack([np.cos(headings), np.sin(headings)], axis=1)
    speed = np.clip(np.minimum(size, arena.speed_m_s) * np.cos(error), 0.0, None)
    low, high = _box(positions, radii, arena)
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(ahead > 0.0, high, low) / ahead
    speed = np.minimum(speed, np.nanmin(np.where(np.abs(ahead) > 1e-12, room, np.inf), axis=1, initial=np.inf))
    _slow_down(speed, ahead, pairs)
    rate = np.clip(turn[0] * error, -turn[1], turn[1])
    return np.stack([speed, np.where(size > 1e-6, rate, 0.0)], axis=1)


def _slow_down(speed: Array, ahead: Array, pairs: Pairs) -> None:
    """Lower `speed` (n,) in place until every pair closes in within its budget."""
    first, second = pairs.first, pairs.second
    # Closing speed per unit of own speed: positive when the robot drives towards the other one.
    towards_second = -(pairs.unit * ahead[first]).sum(axis=1)
    towards_first = (pairs.unit * ahead[second]).sum(axis=1)
    for sweep in range(SWEEPS):
        own, other = towards_second * speed[first], towards_first * speed[second]
        if sweep == SWEEPS - 1:  # count on nobody getting out of the way: this one ends it for certain
            own, other = np.maximum(own, 0.0), np.maximum(other, 0.0)
        excess = own + other > pairs.budget_m_s + 1e-9
        if not excess.any():
            return
        approach = np.maximum(own, 0.0) + np.maximum(other, 0.0)
        retreat = np.minimum(own, 0.0) + np.minimum(other, 0.0)
        share = np.where(excess, (pairs.budget_m_s - retreat) / np.maximum(approach, 1e-12), 1.0)
        factor = np.ones_like(speed)
        np.minimum.at(factor, first[own > 0.0], share[own > 0.0])
        np.minimum.at(factor, second[other > 0.0], share[other > 0.0])
        speed *= np.clip(factor, 0.0, 1.0)
