"""Where the joint filter's numbers lie: vectors that the solver reads and that each tick fills in place."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from fullswarm.kernels import Array, Index


@dataclass(frozen=True, slots=True)
class Arena:
    """What all robots share: walls, limits, how fast gaps may close."""

    low: Array  # (2,) m
    high: Array
    speed_m_s: float
    gain_per_s: float  # γ
    margin_m: float

    def same_as(self, other: Arena) -> bool:
        """Tell whether both are the same; nodes make one per tick from the same walls."""
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
