"""Barrier certificates of all robots at once (the paper's [11]): one sparse quadratic programme, solved by OSQP.

    minimise |u - u_desired|²  over the planar velocities u of all robots, subject to
    -n_ij·(u_i - u_j) <= γ max(d_ij - D_ij, 0)   for each pair within 3 m; n_ij from j to i, D_ij radii plus margin
    the same towards the walls, and |u| within the speed limit on each axis

u = 0 is always allowed. The certificates are for robots that can move in any direction. A unicycle cannot: it moves
along its heading while it turns towards u. :func:`to_twists` therefore checks the pairs again with the velocities that
the robots will really have, and slows those down that would close in too fast.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.core.centralised import need
from fullswarm.kernels import Array, Index

NEAR_M = 3.0
STAY_M = 3.5
"""A pair once in the programme stays until it is so far apart: fewer changes of the pattern, fewer set-ups."""

Complex = NDArray[np.complex128]

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

    def same_as(self, other: Arena) -> bool:
        """Tell whether both are equal; a node makes one per tick from the same walls."""
        if self is other:
            return True
        return (
            self.speed_m_s == other.speed_m_s
            and self.gain_per_s == other.gain_per_s
            and self.margin_m == other.margin_m
            and (self.low is other.low or self.low.tobytes() == other.low.tobytes())
            and (self.high is other.high or self.high.tobytes() == other.high.tobytes())
        )


class Walls:
    """How fast each robot may approach each wall; made once for robots and an arena."""

    def __init__(self, radii: Array, arena: Arena) -> None:
        self._arena, self._radii = arena, radii.tobytes()
        room = (radii + arena.margin_m)[:, None]
        # Velocities at the origin of the frame: what a position takes off them is the gain times it.
        self._gain = arena.gain_per_s
        self._low, self._high = (self._gain * (arena.low + room)).ravel(), (self._gain * (arena.high - room)).ravel()
        self._zero = np.zeros(2 * len(radii))
        self._most = self._zero + arena.speed_m_s
        self._least = -self._most

    def holds_for(self, radii: Array, arena: Arena) -> bool:
        """Tell whether these are the robots and the arena that it was made for."""
        return self._arena.same_as(arena) and self._radii == radii.tobytes()

    def box(self, positions: Array, least: Array, greatest: Array) -> None:
        """Write the least and the greatest velocity on each axis, (2 n,) m/s: speed limit and walls, zero allowed."""
        # One step at a time on flat arrays: half the time of one expression on stacked ones.
        moved = positions.ravel() * self._gain
        np.subtract(self._low, moved, out=least)
        np.maximum(least, self._least, out=least)
        np.minimum(least, self._zero, out=least)
        np.subtract(self._high, moved, out=greatest)
        np.minimum(greatest, self._most, out=greatest)
        np.maximum(greatest, self._zero, out=greatest)


@dataclass(slots=True)
class Layout:
    """The vectors of a programme of `size` unknowns and `pairs` rows; the named parts are views into them."""

    size: int
    pairs: int
    lower: Array = field(init=False)
    upper: Array = field(init=False)
    data: Array = field(init=False)  # entries of the matrix: pairs, first ones, then second ones, then the box
    order: Index = field(init=False)  # where in `data` each stored entry of the matrix comes from
    lower_box: Array = field(init=False)  # (size,)
    upper_box: Array = field(init=False)
    budget: Array = field(init=False)  # (pairs,)
    enough: Array = field(init=False)  # (pairs,) m, the distance at which the budget ends
    unit: Array = field(init=False)  # (pairs, 2)
    minus_unit: Array = field(init=False)
    complex_unit: NDArray[np.complex128] = field(init=False)  # the same numbers as `unit`
    zero: Array = field(init=False)  # (pairs,) NumPy compares with an array faster than with a number
    tiny: Array = field(init=False)

    def __post_init__(self) -> None:
        size, pairs = self.size, self.pairs
        self.lower, self.upper = np.full(size + pairs, -np.inf), np.zeros(size + pairs)
        self.lower_box, self.upper_box, self.budget = self.lower[:size], self.upper[:size], self.upper[size:]
        self.data, self.order = np.ones(4 * pairs + size), np.zeros(0, np.int64)
        self.minus_unit = self.data[: 2 * pairs].reshape(-1, 2)
        self.unit = self.data[2 * pairs : 4 * pairs].reshape(-1, 2)
        self.complex_unit = self.unit.view(np.complex128).ravel()
        self.zero, self.enough = np.zeros(pairs), np.zeros(pairs)
        self.tiny = self.zero + 1e-9


@dataclass(frozen=True, slots=True)
class Pairs:
    """Neighbouring pairs: `first` < `second`, unit vector from second to first, what the gap allows.

    Valid until the filter is called again, which writes into the same arrays.
    """

    first: Index  # (k,)
    second: Index
    unit: Array  # (k, 2)
    budget_m_s: Array  # (k,) how fast they may close in, >= 0


class JointFilter:
    """The certificates of one set of robots, from tick to tick.

    Eight robots take the solver 30 µs, about as long as 50 NumPy calls do, so everything that does not change from
    tick to tick is kept, and results go straight into the vectors that the solver reads.
    """

    def __init__(self) -> None:
        self.solver_type: Any = need("osqp").OSQP  # a benchmark watches it
        self._sparse = need("scipy.sparse")
        self._solver: Any = None
        self._codes: Index = np.zeros(0, np.int64)  # one number per pair of the programme
        self._robots = -1
        self._answer: Array = np.zeros(0)
        self._all: Index = np.zeros((2, 0), np.int64)
        self._kept = b""  # which of all pairs are in the programme
        self._within_m: Array = np.zeros(0)  # how far apart each of all pairs may be to be in it
        self._rows: Index | None = None
        self._chosen: Index = self._all
        self._walls: Walls | None = None
        self._layout = Layout(0, 0)
        self._near = Pairs(self._chosen[0], self._chosen[1], self._layout.unit, self._layout.budget)
        self.setups = 0

    def filter(self, desired: Array, positions: Array, radii: Array, arena: Arena) -> tuple[Array, Pairs]:
        """Return the nearest allowed velocities (n, 2) and the pairs that were looked at.

        Velocities are zero for all when the solver has no answer.

        Parameters
        ----------
        desired : (n, 2) m/s
        positions : (n, 2) m
        radii : (n,) m
        """
        changed, offset, distance = self._pairs(np.ascontiguousarray(positions))
        walls = self._walls
        if walls is None or not walls.holds_for(radii, arena):
            walls = self._walls = Walls(radii, arena)
            changed = True  # rare: everything that was kept is made again
        if changed:
            layout = self._layout = Layout(desired.size, len(distance))
            layout.enough += radii.take(self._chosen).sum(axis=0)
            layout.enough += arena.margin_m
            self._near = Pairs(self._chosen[0], self._chosen[1], layout.unit, layout.budget)
        layout = self._layout
        walls.box(positions, layout.lower_box, layout.upper_box)
        budget = np.subtract(distance, layout.enough, out=layout.budget)
        budget *= arena.gain_per_s
        np.maximum(budget, layout.zero, out=budget)
        np.divide(offset, np.maximum(distance, layout.tiny, out=distance), out=layout.complex_unit)
        np.negative(layout.unit, out=layout.minus_unit)
        if changed:
            self._set_up(desired)
        else:
            # The solver writes into the array that it is given: `take` makes it a new one.
            data = layout.data.take(layout.order)
            self._solver.update(q=-desired.ravel(), l=layout.lower, u=layout.upper, Ax=data)
        answer = self._solver.solve(raise_error=False)
        found: Array = answer.x
        if answer.info.status != "solved" or not math.isfinite(found.dot(found)):  # infeasible: huge values
            return np.zeros_like(desired), self._near
        self._answer = found
        allowed: Array = np.maximum(found, layout.lower_box)
        return np.minimum(allowed, layout.upper_box, out=allowed).reshape(-1, 2), self._near

    def _pairs(self, positions: Array) -> tuple[bool, Complex, Array]:
        """Choose the pairs; return whether they are others than last time, offsets as complex numbers, distances."""
        count, places = len(positions), positions.view(np.complex128).ravel()
        same = count == self._robots and self._solver is not None
        self._robots, seen = count, self._kept if same else b""
        if count > TRY_ALL_BELOW:
            return self._search(positions, places, same)
        if not same:
            self._all = np.stack(np.triu_indices(count, 1)).astype(np.int64)
            self._within_m = np.full(self._all.shape[1], NEAR_M)
        ends = places.take(self._all)
        offset: Complex = ends[0] - ends[1]
        distance: Array = np.abs(offset)
        keep = distance <= self._within_m
        kept = keep.tobytes()
        same = same and kept == seen
        if not same:
            self._kept, rows = kept, keep.nonzero()[0]
            self._within_m = np.where(keep, STAY_M, NEAR_M)
            self._chosen, self._rows = self._all.take(rows, 1), None if keep.all() else rows
        if self._rows is None:
            return not same, offset, distance
        return not same, offset.take(self._rows), distance.take(self._rows)

    def _search(self, positions: Array, places: Complex, same: bool) -> tuple[bool, Complex, Array]:
        """Choose the pairs of many robots, found with a tree."""
        tree = need("scipy.spatial").cKDTree(positions)
        found = tree.query_pairs(STAY_M, output_type="ndarray").astype(np.int64).reshape(-1, 2)
        codes = found[:, 0] * len(positions) + found[:, 1]
        order = codes.argsort()
        found, codes = found[order], codes[order]
        offset = places[found[:, 0]] - places[found[:, 1]]
        distance = np.abs(offset)
        keep = distance <= NEAR_M
        if same:
            keep |= np.isin(codes, self._codes)
        codes = codes[keep]
        same = same and np.array_equal(codes, self._codes)
        self._codes, self._chosen = codes, found[keep].T
        return not same, offset[keep], distance[keep]

    def _set_up(self, desired: Array) -> None:
        layout, size, count = self._layout, desired.size, self._chosen.shape[1]
        rows = np.concatenate([np.repeat(size + np.arange(count), 2)] * 2 + [np.arange(size)])
        of_pairs = (2 * self._chosen[:, :, None] + [0, 1]).ravel()  # both axes of the first ones, then of the second
        columns = np.concatenate([of_pairs, np.arange(size)])
        # Entries numbered from one, so that none is taken for a zero: the pattern must hold what is zero only now.
        numbered = np.arange(1, len(layout.data) + 1, dtype=float)
        pattern = self._sparse.coo_matrix((numbered, (rows, columns)), shape=(size + count, size)).tocsc()
        layout.order = pattern.data.astype(np.int64) - 1
        pattern.data = layout.data.take(layout.order)
        self._solver = self.solver_type()
        identity = self._sparse.eye(size, format="csc")
        self._solver.setup(identity, -desired.ravel(), pattern, layout.lower, layout.upper, **SETTINGS)
        if len(self._answer) == size:
            self._solver.warm_start(x=self._answer)
        self.setups += 1


def to_twists(
    velocities: Array, pairs: Pairs, positions: Array, headings: Array, radii: Array, arena: Arena, turn: Array
) -> Array:
    """Map allowed velocities to speeds and turn rates (n, 2) under which no gap closes too fast.

    A robot goes with the projection of its velocity on its heading and never backwards: with more than 90° to
    turn it turns on the spot. Turning is never limited: it moves no disc.

    Parameters
    ----------
    velocities : (n, 2) m/s
    headings : (n,) rad
    turn : (2,) gain K_w in 1/s and limit in rad/s
    """
    size = np.linalg.norm(velocities, axis=1)
    desired = np.arctan2(velocities[:, 1], velocities[:, 0])
    error = np.arctan2(np.sin(desired - headings), np.cos(desired - headings))
    ahead = np.stack([np.cos(headings), np.sin(headings)], axis=1)
    speed = np.clip(np.minimum(size, arena.speed_m_s) * np.cos(error), 0.0, None)
    low, high = np.empty((2, *positions.shape))
    Walls(radii, arena).box(positions, low.reshape(-1), high.reshape(-1))
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
        if sweep == SWEEPS - 1:  # assume that no robot gives way: this sweep is certain to end
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
