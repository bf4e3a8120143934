"""What a control law gets: its robots, the neighbours they sense, the arena, its parameters. Arrays over n robots.

Neighbours come as a list of pairs sorted by robot: pair e means that robot ``of[e]`` senses a neighbour at
``offset[e]``. A control law works on pairs and adds them up with :meth:`View.sum`, so one line of NumPy serves one
robot on board and a thousand in a trial.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from fullswarm.drivers.base import NO_OBSTACLES
from fullswarm.kernels import Array, Index, kernel
from fullswarm.parameters import Params as Params  # a law's module imports both from here
from fullswarm.reasons import Reason


def nothing_known(_row: int, _source: str) -> Array:
    """Return no obstacles."""
    return NO_OBSTACLES


def none_standing(_row: int) -> Array:
    """Return no obstacles."""
    return NO_OBSTACLES


class View:
    """The world as n robots sense it at one moment. World frame, SI units.

    Parameters
    ----------
    position : (n, 2) m
    heading : (n,) rad
    radius : (n,) m, footprints
    near : finds the neighbours when they are first used: ``start`` (n + 1,), pairs of robot i are
        ``start[i]:start[i + 1]``, and ``other`` (e or more,), rows of the neighbours in `states` and `predicted`
    predicted : (m, 2) m, positions of all robots received, predicted to now
    states : (m, 6) x, y, heading, speed, turn rate, radius as received
    bounds_m : x_min, y_min, x_max, y_max of the arena
    known : ``known(row, source)`` returns the static obstacles (k, 6) that a robot knows, see `ObstacleMap`
    speed_limit : (n,) m/s; None: there is none
    aims : (m, 2) m, where the robots received say that they are driving to, see `Neighbours`; None: none says
    margin_m : (n,) m, the gap that the safety filter keeps where it runs; None: none
    standing : ``standing(row)`` returns the robots at standstill that are not on their way, as obstacles (k, 6), `row`
        itself left out

    Attributes
    ----------
    aim : (n, 2) m, out: where the control law is driving to next, for the neighbours; None or NaN: it does not say
    blocked : out: by robot, why the control law knows no way
    """

    def __init__(
        self,
        position: Array,
        heading: Array,
        radius: Array,
        near: Callable[[], tuple[Index, Index]],
        predicted: Array,
        states: Array,
        bounds_m: tuple[float, float, float, float],
        known: Callable[[int, str], Array] = nothing_known,
        speed_limit: Array | None = None,
        aims: Array | None = None,
        margin_m: Array | None = None,
        standing: Callable[[int], Array] = none_standing,
    ) -> None:
        self.speed_limit = np.full(len(position), math.inf) if speed_limit is None else speed_limit
        self.position, self.heading, self.radius = position, heading, radius
        self.bounds_m = bounds_m
        self.known, self.standing = known, standing
        self.aims = np.full((len(states), 2), math.nan) if aims is None else aims
        self.margin_m = np.zeros(len(position)) if margin_m is None else margin_m
        self.aim: Array | None = None
        self.blocked: dict[int, Reason] = {}
        self._near = near
        self._predicted, self._states = predicted, states
        # Filled when first asked for. Plain slots: functools.cached_property takes a lock on Python 3.11.
        self._lists: tuple[Index, Index] | None = None
        self._described: tuple[Index, Array, Array, Array] | None = None

    def _neighbours(self) -> tuple[Index, Index]:
        if self._lists is None:
            start, other = self._near()
            self._lists = start, other[: start[-1]]
        return self._lists

    @property
    def start(self) -> Index:
        """Pairs of robot i are ``start[i]:start[i + 1]``, (n + 1,)."""
        return self._neighbours()[0]

    @property
    def other(self) -> Index:
        """Row of each pair's neighbour among the robots received, (e,)."""
        return self._neighbours()[1]

    def _pairs(self) -> tuple[Index, Array, Array, Array]:
        if self._described is None:
            start, other = self._neighbours()
            count = len(other)
            found = np.empty(count, np.int64), np.empty((count, 2)), np.empty(count), np.empty(count)
            describe.run(self.position, start, other, self._predicted, self._states, *found)
            self._described = found
        return self._described

    @property
    def of(self) -> Index:
        """Robot of each pair, (e,)."""
        return self._pairs()[0]

    @property
    def offset(self) -> Array:
        """From the robot to its neighbour, ``d_ij = p_j - p_i`` of the paper, (e, 2) m."""
        return self._pairs()[1]

    @property
    def distance(self) -> Array:
        """Length of `offset`, (e,) m."""
        return self._pairs()[2]

    @property
    def neighbour_heading(self) -> Array:
        """Heading of the neighbour, (e,) rad."""
        return self._pairs()[3]

    @property
    def neighbour_radius(self) -> Array:
        """Footprint of the neighbour, (e,) m."""
        radius: Array = self._states[self.other, 5]
        return radius

    @property
    def neighbours(self) -> Array:
        """How many neighbours each robot senses, (n, 1)."""
        return (self.start[1:] - self.start[:-1]).astype(float)[:, None]

    @property
    def predicted(self) -> Array:
        """Positions of all robots received, predicted to now, (m, 2) m; `other` names its rows."""
        return self._predicted

    @property
    def states(self) -> Array:
        """States of all robots as received, (m, 6)."""
        return self._states

    def sum(self, values: Array) -> Array:
        """Add up values of pairs (e, 2) over the neighbours of each robot: (n, 2)."""
        total = np.empty((len(self.position), 2))
        fold.run(self.start, values, total)
        return total

    def select(self, rows: Index) -> View:
        """Return the view of a part of the robots, `rows` (k,) ascending."""

        def near() -> tuple[Index, Index]:
            start = np.concatenate([[0], np.cumsum((self.start[1:] - self.start[:-1])[rows])])
            others = [self.other[self.start[row] : self.start[row + 1]] for row in rows]
            return start, np.concatenate(others)

        return View(
            self.position[rows],
            self.heading[rows],
            self.radius[rows],
            near,
            self._predicted,
            self._states,
            self.bounds_m,
            lambda row, source: self.known(int(rows[row]), source),
            self.speed_limit[rows],
            self.aims,
            self.margin_m[rows],
            lambda row: self.standing(int(rows[row])),
        )


@kernel
def describe(
    position: Array, start: Index, other: Index, predicted: Array, states: Array, of: Index, offset: Array,
    distance: Array, heading: Array,
) -> None:  # fmt: skip
    """Fill the robot of each pair (e,), offset (e, 2), distance (e,) and the neighbour's heading (e,)."""
    for i in range(position.shape[0]):
        for pair in range(start[i], start[i + 1]):
            row = other[pair]
            dx = predicted[row, 0] - position[i, 0]
            dy = predicted[row, 1] - position[i, 1]
            of[pair] = i
            offset[pair, 0] = dx
            offset[pair, 1] = dy
            distance[pair] = math.sqrt(dx * dx + dy * dy)
            heading[pair] = states[row, 2]


@kernel
def fold(start: Index, values: Array, total: Array) -> None:
    """Add up values of pairs (e, 2) per robot into `total` (n, 2)."""
    for i in range(total.shape[0]):
        x = 0.0
        y = 0.0
        for pair in range(start[i], start[i + 1]):
            x += values[pair, 0]
            y += values[pair, 1]
        total[i, 0] = x
        total[i, 1] = y
