"""What a centralised control law gets: all robots of its request at once, in the terms of a law on board.

The attributes have the names and shapes of ``fullswarm.agent.view.View``, so that a law that only adds up what its
pairs say runs in both places. Every robot of the request is a neighbour of every other, however far away.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from fullswarm import profiles
from fullswarm.kernels import Array, Flags, Index
from fullswarm.messages import RobotProfile
from fullswarm.reasons import NOTHING

Words = NDArray[np.str_]
Pairs = tuple[Index, Index]
NO_PROFILES: Mapping[str, RobotProfile] = MappingProxyType({})


class View:
    """The n robots of a request whose state is fresh. World frame, SI units.

    Parameters
    ----------
    index : (n,) place of each among `members`
    members : names of all robots of the request, in its order
    position : (n, 2) m
    heading : (n,) rad
    twist : (n, 2) speed along the heading and turn rate, m/s and rad/s
    radius : (n,) m, footprints
    appeared : (n,) the robot was not there in the call before: it is new, or its state has been stale
    elapsed_s : since the request was first computed, s
    dt_s : since the call before, s; one period at the first
    bounds_m : x_min, y_min, x_max, y_max of the arena
    roles : robot → its role in the request, if it has one
    described : robot → what it is and can do, if it has said so
    """

    def __init__(
        self, index: Index, members: tuple[str, ...], position: Array, heading: Array, twist: Array, radius: Array,
        appeared: Flags, elapsed_s: float, dt_s: float, bounds_m: tuple[float, float, float, float],
        roles: Mapping[str, str] = NOTHING, described: Mapping[str, RobotProfile] = NO_PROFILES,
    ) -> None:  # fmt: skip
        self.index, self.members = index, members
        self.position, self.heading, self.twist, self.radius = position, heading, twist, radius
        self.appeared, self.dt_s, self.bounds_m = appeared, dt_s, bounds_m
        self._elapsed_s, self._roles, self._described = elapsed_s, roles, described

    @property
    def time_s(self) -> Array:
        """Since the request was first computed, (n,) s; a node that is started again counts from zero."""
        return np.full(len(self.position), self._elapsed_s)

    @property
    def id(self) -> Words:
        """Names of the robots, (n,)."""
        return np.array([self.members[place] for place in self.index.tolist()], np.str_)

    @property
    def role(self) -> Words:
        """Role of each robot in the request, (n,); empty: it has none."""
        return np.array([self._roles.get(self.members[place], "") for place in self.index.tolist()], np.str_)

    # ------------------------------------------------------------------ what robots are and can do
    def _profiles(self) -> profiles.Known:
        return [self._described.get(self.members[place]) for place in self.index.tolist()]

    def _their_profiles(self) -> profiles.Known:
        own = self._profiles()
        return [own[row] for row in self.other.tolist()]

    @property
    def make(self) -> Words:
        """Make of the robot, (n,); empty: unknown."""
        return profiles.makes(self._profiles())

    @property
    def battery(self) -> Array:
        """Charge, (n,) 0 to 1, some seconds old; -1: unknown."""
        return profiles.charges(self._profiles())

    def can(self, capability: str) -> Flags:
        """Tell which robots (n,) are known to have a capability."""
        return profiles.having(self._profiles(), capability)

    @property
    def neighbour_make(self) -> Words:
        """Make of each pair's neighbour, (e,)."""
        return profiles.makes(self._their_profiles())

    @property
    def neighbour_battery(self) -> Array:
        """Charge of each pair's neighbour, (e,)."""
        return profiles.charges(self._their_profiles())

    def neighbour_can(self, capability: str) -> Flags:
        """Tell which neighbours (e,) are known to have a capability."""
        return profiles.having(self._their_profiles(), capability)

    @property
    def neighbour_limits(self) -> Array:
        """Greatest speed, turn rate and acceleration of a pair's neighbour, (e, 3) m/s, rad/s, m/s²; NaN: unknown."""
        return profiles.limits(self._their_profiles())

    # ------------------------------------------------------------------ pairs
    @functools.cached_property
    def _pairs(self) -> Pairs:
        of, other = np.nonzero(~np.eye(len(self.position), dtype=bool))
        return of, other

    @property
    def of(self) -> Index:
        """Robot of each pair, (e,), ascending."""
        return self._pairs[0]

    @property
    def other(self) -> Index:
        """Row of each pair's neighbour, (e,)."""
        return self._pairs[1]

    @functools.cached_property
    def offset(self) -> Array:
        """From the robot to its neighbour, (e, 2) m."""
        found: Array = self.position[self.other] - self.position[self.of]
        return found

    @functools.cached_property
    def distance(self) -> Array:
        """Length of `offset`, (e,) m."""
        return np.hypot(self.offset[:, 0], self.offset[:, 1])

    @property
    def neighbour_heading(self) -> Array:
        """Heading of the neighbour, (e,) rad."""
        found: Array = self.heading[self.other]
        return found

    @property
    def neighbour_radius(self) -> Array:
        """Footprint of the neighbour, (e,) m."""
        found: Array = self.radius[self.other]
        return found

    @property
    def neighbour_velocity(self) -> Array:
        """Velocity of the neighbour, world frame, (e, 2) m/s."""
        direction = np.stack([np.cos(self.heading), np.sin(self.heading)], axis=1)
        found: Array = (self.twist[:, :1] * direction)[self.other]
        return found

    @property
    def neighbour_id(self) -> Words:
        """Name of each pair's neighbour, (e,)."""
        found: Words = self.id[self.other]
        return found

    @property
    def neighbour_index(self) -> Index:
        """Place of each pair's neighbour among `members`, (e,)."""
        found: Index = self.index[self.other]
        return found

    @property
    def neighbour_role(self) -> Words:
        """Role of each pair's neighbour, (e,)."""
        found: Words = self.role[self.other]
        return found

    @property
    def neighbours(self) -> Array:
        """How many neighbours each robot has, (n, 1)."""
        count = len(self.position)
        return np.full((count, 1), float(count - 1))

    def sum(self, values: Array) -> Array:
        """Add up values of pairs (e, 2) over the neighbours of each robot: (n, 2)."""
        total = np.zeros((len(self.position), 2))
        np.add.at(total, self.of, values)
        return total
