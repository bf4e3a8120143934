"""Detects poses that cannot be right: two robots in one place, or a robot whose frame is not the swarm's.

The safety filter separates the reported poses. If they are wrong it may drive two robots into each other, so none of
them may drive by itself until a person has checked: see :class:`PoseConflicts`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from fullswarm.agent.neighbours.estimates import Nearby, Neighbours
from fullswarm.agent.state import AgentState
from fullswarm.kernels import Array, Flags, Index, kernel
from fullswarm.reasons import NONE, Code, Reason, reason

Near = Callable[[float], Nearby]
"""Which robots are in sensing range of each robot at a time in seconds, see ``Neighbours.around``."""

OVERLAP, APART = 0.5, 0.25
"""Shares of the smaller footprint's radius by which two discs overlap: so deep is an alarm, less deep ends it.

Touching bodies overlap by nothing, and pushed ones by millimetres; half a radius of a Create is three standard
deviations of two positions that are good to 2 cm each.
"""
DWELL_S = 0.5
FRESH_S = 0.3
"""A robot whose last state is older may be elsewhere by now."""
OWN_FRAME_S = 2.0
"""A robot in a frame of its own counts as present for this time after it was last received."""


@kernel
def overlaps(
    now_s: float, pose: Array, radius: Array, near: Nearby, since_s: Array, partner: Index, overlap: Flags
) -> None:
    """Update `overlap` (n,): robots reported where another robot is, for longer than `DWELL_S`.

    Parameters
    ----------
    pose, radius : (n, 3), (n,) of the own robots
    since_s, partner : (n,) in and out: since when, inf if not, and the row of the neighbour that overlaps most
    """
    start, other, places, states, _, _, arrival_s = near
    for i in range(pose.shape[0]):
        deepest = -math.inf
        for pair in range(start[i], start[i + 1]):
            j = other[pair]
            if now_s - arrival_s[j] <= FRESH_S:
                apart = math.hypot(pose[i, 0] - places[j, 0], pose[i, 1] - places[j, 1])
                share = (radius[i] + states[j, 5] - apart) / max(min(radius[i], states[j, 5]), 1e-3)
                if share > deepest:  # false for a place that is not known
                    deepest = share
                    if share > APART:
                        partner[i] = j
        if deepest > OVERLAP:
            since_s[i] = min(since_s[i], now_s)
            overlap[i] = overlap[i] or now_s - since_s[i] >= DWELL_S
        elif not overlap[i] or deepest <= APART:
            since_s[i] = math.inf
            overlap[i] = False


class PoseConflicts:
    """Checks that the reported poses of the swarm are consistent.

    Attributes
    ----------
    own_frame : the poses of this agent's robots count from a frame of their own
    overlap : (n,) another robot is reported where this one is
    frame_conflict : this agent or a neighbour has a frame of its own, and there is more than one robot; or there are
        robots whose states cannot be read
    other_version : of another process, whose messages cannot be read, written from outside; false: there is none
    """

    def __init__(self, own_frame: bool, state: AgentState, neighbours: Neighbours, near: Near) -> None:
        self._state, self._neighbours, self._near = state, neighbours, near
        count = len(state.radius)
        self.own_frame = own_frame
        self.overlap = np.zeros(count, bool)
        self.frame_conflict = False
        self.other_version = NONE
        self._since_s = np.full(count, math.inf)
        self._partner = np.zeros(count, np.int64)

    def update(self, now_s: float) -> None:
        """Check once; ten times a second is enough."""
        state, neighbours = self._state, self._neighbours
        near = self._near(now_s)
        overlaps.run(now_s, state.pose, state.radius, near, self._since_s, self._partner, self.overlap)
        foreign = now_s - neighbours.own_frame_s <= OWN_FRAME_S
        if self.own_frame and not foreign and neighbours.count:
            newest_s = float(neighbours.arrival_s[: neighbours.count].max())
            foreign = now_s - newest_s <= OWN_FRAME_S
        self.frame_conflict = foreign or bool(self.other_version)

    def reason(self, row: int) -> Reason:
        """Return why robot `row` may not drive by itself, and what to do; false if it may."""
        if self.other_version:
            return self.other_version
        if self.frame_conflict:
            if self.own_frame:
                return reason(Code.FRAME)
            return reason(Code.FOREIGN_FRAME, host=self._neighbours.own_frame_host)
        if self.overlap[row]:
            return reason(Code.OVERLAP, robot=self._neighbours.names[int(self._partner[row])])
        return NONE
