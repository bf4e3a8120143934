"""Barrier certificates of all robots at once (the paper's [11]): one sparse quadratic programme, solved by OSQP.

    minimise |u - u_wished|²  over the planar velocities u of all robots, subject to
    -n_ij·(u_i - u_j) <= γ max(d_ij - D_ij, 0)   for each pair within 3 m; n_ij from j to i, D_ij radii plus margin
    the same towards the walls, and |u| within the speed limit on each axis

u = 0 is always allowed. The certificates are for robots that can move in any direction. A unicycle cannot: it goes
along its heading while it turns towards u. :func:`to_twists` therefore checks the pairs again with the velocities that
the robots will really have, and slows those down that would close in too fast.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

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
TRY_ALL_BELOW = 150
"""Robots below which looking at all pairs beats building a tree."""


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
        self.solver_type: Any = need("osqp").OSQP  # a benchmark watches it
        self._sparse = need("scipy.sparse")
        self._solver: Any = None
        self._codes: Index = np.zeros(0, np.int64)  # one number per pair of the programme
        self._robots = -1
        self._order: Index = np.zeros(0, np.int64)
        self._answer: Array = np.zeros(0)
        self._all: tuple[Index, Index] = self._codes, self._codes
        self._all_of = -1
        self._kept: NDArray[np.bool_] = np.zeros(0, bool)  # which of all pairs are in the programme
        self._chosen: tuple[Index, Index, Index] = self._codes, self._codes, self._codes
        self._upper = self._lower = self._data = self._reach_m = self._answer
        self._reach_of = b"", 0.0
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
        pairs, changed = self._pairs(positions, radii, arena)
        low, high = _box(positions, radii, arena)
        size, count = wished.size, len(pairs.first)
        if changed or len(self._upper) != size + count:
            self._upper, self._lower = np.empty(size + count), np.full(size + count, -np.inf)
            self._data = np.ones(size + 4 * count)
        upper, lower, data = self._upper, self._lower, self._data
        upper[:size], lower[:size], upper[size:] = high.reshape(-1), low.reshape(-1), pairs.budget_m_s
        unit = pairs.unit.reshape(-1)
        np.negative(unit, out=data[size : size + 2 * count])
        data[size + 2 * count :] = unit
        if changed:
            self._set_up(wished, pairs, data, lower, upper)
        else:
            # The solver writes into the array that it is given: `take` makes it a new one.
            self._solver.update(q=-wished.reshape(-1), l=lower, u=upper, Ax=data.take(self._order))
        answer = self._solver.solve(raise_error=False)
        found = np.asarray(answer.x, float)
        if answer.info.status != "solved" or not math.isfinite(found.sum()):  # an infeasible answer holds huge values
            return np.zeros_like(wished), pairs
        self._answer = found
        allowed: Array = np.minimum(np.maximum(found.reshape(-1, 2), low), high)
        return allowed, pairs

    def _pairs(self, positions: Array, radii: Array, arena: Arena) -> tuple[Pairs, bool]:
        """Return the pairs of the programme, and whether they are others than last time."""
        count = len(positions)
        same = count == self._robots and self._solver is not None
        if count <= TRY_ALL_BELOW:
            first, second, offset, squared = self._try_all(positions)
            keep = squared <= NEAR_M * NEAR_M
            if same:
                keep |= self._kept & (squared <= STAY_M * STAY_M)
                same = keep.tobytes() == self._kept.tobytes()
            if not same:
                self._kept, rows = keep, keep.nonzero()[0]
                self._chosen = rows, first[rows], second[rows]
            rows, first, second = self._chosen
            offset, squared = offset.take(rows, 0), squared.take(rows)
        else:
            first, second, offset, squared = self._search(positions, same)
            codes = first * count + second
            same = same and np.array_equal(codes, self._codes)
            self._codes = codes
        self._robots = count
        distance = np.sqrt(squared)
        unit = offset / np.maximum(distance, 1e-9)[:, None]
        made = radii.tobytes(), arena.margin_m
        if not same or made != self._reach_of:
            self._reach_m, self._reach_of = radii.take(first) + radii.take(second) + arena.margin_m, made
        return Pairs(first, second, unit, arena.gain_per_s * np.maximum(distance - self._reach_m, 0.0)), not same

    def _try_all(self, positions: Array) -> tuple[Index, Index, Array, Array]:
        """Return all pairs: rows, offsets, squared distances."""
        if self._all_of != len(positions):
            first, second = np.triu_indices(len(positions), 1)
            self._all, self._all_of = (first.astype(np.int64), second.astype(np.int64)), len(positions)
        first, second = self._all
        offset = positions.take(first, 0) - positions.take(second, 0)
        return first, second, offset, np.einsum("ij,ij->i", offset, offset)

    def _search(self, positions: Array, same: bool) -> tuple[Index, Index, Array, Array]:
        """Return the pairs to keep, found with a tree."""
        tree = need("scipy.spatial").cKDTree(positions)
        found = tree.query_pairs(STAY_M, output_type="ndarray").astype(np.int64).reshape(-1, 2)
        codes = found[:, 0] * len(positions) + found[:, 1]
        order = codes.argsort()
        found, codes = found[order], codes[order]
        offset = positions[found[:, 0]] - positions[found[:, 1]]
        squared = np.einsum("ij,ij->i", offset, offset)
        keep = squared <= NEAR_M * NEAR_M
        if same:
            keep |= np.isin(codes, self._codes)
        return found[keep, 0], found[keep, 1], offset[keep], squared[keep]

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
        self._solver = self.solver_type()
        identity = self._sparse.eye(size, format="csc")
        self._solver.setup(identity, -wished.ravel(), pattern, lower, upper, **SETTINGS)
        if len(self._answer) == size:
            self._solver.warm_start(x=self._answer)
        self.setups += 1


def _box(positions: Array, radii: Array, arena: Arena) -> tuple[Array, Array]:
    """Return the least and the greatest velocity on each axis, (n, 2) m/s: speed limit and walls, zero allowed."""
    room = (radii + arena.margin_m)[:, None]
    to = np.empty((2, *positions.shape))
    low, high = to
    np.subtract(positions, arena.low + room, out=low)
    np.subtract(arena.high - room, positions, out=high)
    to *= arena.gain_per_s
    np.minimum(np.maximum(to, 0.0, out=to), arena.speed_m_s, out=to)
    return np.negative(low, out=low), high


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
