"""Robots that cannot be where they say: two in one place, or one whose frame is not known to be the swarm's.

The safety filter keeps apart what is told to it. Where that is wrong it may drive two robots together with its gaps
intact, so both are barred from driving by themselves until a person has looked: see :class:`Company`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fullswarm.kernels import kernel

if TYPE_CHECKING:
    from fullswarm.agent.node import AgentNode

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Flags = NDArray[np.bool_]

OVERLAP, APART = 0.5, 0.25
"""Shares of the smaller footprint's radius by which two discs overlap: so deep is an alarm, less deep ends it.

Touching bodies overlap by nothing, and pushed ones by millimetres; half a radius of a Create is three standard
deviations of two positions that are good to 2 cm each.
"""
DWELL_S = 0.5
FRESH_S = 0.3
"""Who was heard longer ago may be elsewhere by now."""
STRAY_S = 2.0
"""A robot in a frame of its own is taken to be about for so long after it was heard."""


@kernel
def overlaps(
    now_s: float, pose: Array, radius: Array, start: Index, other: Index, places: Array, heard: Array,
    arrival_s: Array, since_s: Array, whom: Index, overlap: Flags,
) -> None:  # fmt: skip
    """Renew `overlap` (n,): robots that were told to be where another one is, for a while.

    Parameters
    ----------
    pose, radius : (n, 3), (n,) of the own robots
    start, other, places, heard, arrival_s : neighbours, see :class:`~fullswarm.agent.neighbours.Neighbours`
    since_s, whom : (n,) in and out: since when, inf if not, and the row of the one overlapped most
    """
    for i in range(pose.shape[0]):
        deepest = -math.inf
        for edge in range(start[i], start[i + 1]):
            j = other[edge]
            if now_s - arrival_s[j] <= FRESH_S:
                apart = math.hypot(pose[i, 0] - places[j, 0], pose[i, 1] - places[j, 1])
                share = (radius[i] + heard[j, 5] - apart) / max(min(radius[i], heard[j, 5]), 1e-3)
                if share > deepest:  # false for a place that is not known
                    deepest = share
                    if share > APART:
                        whom[i] = j
        if deepest > OVERLAP:
            since_s[i] = min(since_s[i], now_s)
            overlap[i] = overlap[i] or now_s - since_s[i] >= DWELL_S
        elif not overlap[i] or deepest <= APART:
            since_s[i] = math.inf
            overlap[i] = False


class Company:
    """Watches whether what the robots about tell fits together.

    Attributes
    ----------
    own_frame : the poses of this agent's robots count from a place of their own
    overlap : (n,) another robot is told to be where this one is
    astray : somebody about, or this agent, has a frame of its own, and it is not alone
    """

    def __init__(self, agent: AgentNode) -> None:
        self._agent = agent
        count = len(agent.fleet.ids)
        self.own_frame = any(each.own_frame for each in agent.fleet.descriptions)
        self.overlap = np.zeros(count, bool)
        self.astray = False
        self._stray = ""
        self._since_s = np.full(count, math.inf)
        self._whom = np.zeros(count, np.int64)

    def look(self, now_s: float) -> None:
        """Look once; ten times a second will do."""
        agent, heard = self._agent, self._agent.neighbours
        start, other = agent.wishes.near(now_s)
        overlaps.run(
            now_s, agent.pose, agent.radius, start, other, heard.places, heard.heard, heard.arrival_s,
            self._since_s, self._whom, self.overlap,
        )  # fmt: skip
        self._stray = next((host for host, at_s in heard.strays.items() if now_s - at_s <= STRAY_S), "")
        others = self.own_frame and heard.count > 0 and now_s - float(heard.arrival_s[: heard.count].max()) <= STRAY_S
        self.astray = bool(self._stray or others)

    def bars(self, row: int) -> bool:
        """Tell whether robot `row` may not drive by itself."""
        return self.astray or bool(self.overlap[row])

    def why(self, row: int) -> str:
        """Return why, and what to do; empty when nothing bars it."""
        if self.own_frame and self.astray:
            return (
                "its position counts from where it was switched on, and other robots are about: write [world] origin "
                "= [latitude, longitude] into the fleet file; until then only driving by hand moves it"
            )
        if self.astray:
            return (
                f"'{self._stray}' is about, whose position counts from where it was switched on: write [world] origin "
                "= [latitude, longitude] into its fleet file; until then only driving by hand moves this one"
            )
        if self.overlap[row]:
            name = self._agent.neighbours.names[int(self._whom[row])]
            return (
                f"'{name}' is reported in the same place, so a position is wrong: look where both are, then drive "
                "them apart by hand or correct their poses"
            )
        return ""
