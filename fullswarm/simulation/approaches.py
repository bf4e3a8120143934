"""Follows how near bodies come: closest approach of each pair and of each body and obstacle, least time to contact.

For pairs that the referee has followed through a step (`ContactReferee.near`) its gaps count, which look into the
step; for all others bodies move straight from the start of a step to its end.

**Time to contact** of a pair after a step: its gap then over the rate at which the gap shrank in that step; a pair that
touched in the step has 0 s, one whose gap did not shrink has none.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fullswarm.kernels import Array, Flags, Index, kernel
from fullswarm.simulation.contacts import ContactReferee, Solids, closest_on_way
from fullswarm.simulation.obstacles import obstacle_gap


class Nearest(NamedTuple):
    """What came how near to what so far, and what is needed to go on."""

    gap: Array  # (n (n - 1) / 2,) m, least of the pairs (0, 1), (0, 2), …, (1, 2), …
    at: Array  # (n (n - 1) / 2,) s, the end of the step in which it was
    wall_gap: Array  # (n, k) m, the same for bodies and obstacles
    wall_at: Array  # (n, k) s
    room: Array  # (n, k) way of the body (`way`) at which its gap to the obstacle may be less again
    way: Array  # (n,) m that each body has moved
    soonest: Array  # (2,) s, least time to contact, and the end of the step after which it was
    who: Index  # (2,) row and other row, or -1-k: of that
    followed: Flags  # (n (n - 1) / 2,) scratch
    wall_followed: Flags  # (n, k) scratch
    before: Array  # (n, 2) where the bodies were


@kernel
def pair_index(i: int, j: int, n: int) -> int:
    """Return where the pair `i` < `j` of `n` robots stands in the order (0, 1), (0, 2), …, (1, 2), … of all pairs."""
    return i * n - i * (i + 1) // 2 + j - i - 1


@kernel
def book_time(nearest: Nearest, time_s: float, seconds: float, i: int, j: int) -> None:
    """Take in a time to contact."""
    if seconds < nearest.soonest[0]:
        nearest.soonest[0], nearest.soonest[1] = seconds, time_s
        nearest.who[0], nearest.who[1] = i, j


@kernel
def take_followed(nearest: Nearest, time_s: float, near: Index, gaps: Array, touch: float) -> None:
    """Take in the gaps of the pairs that the referee has followed, and mark these pairs."""
    n = nearest.before.shape[0]
    for m in range(near.shape[0]):
        i, j, gap = near[m, 0], near[m, 1], gaps[m]
        if j >= 0:
            pair = pair_index(min(i, j), max(i, j), n)
            nearest.followed[pair] = True
            if gap < nearest.gap[pair]:
                nearest.gap[pair], nearest.at[pair] = gap, time_s
        else:
            k = -1 - j
            nearest.wall_followed[i, k] = True
            if gap < nearest.wall_gap[i, k]:
                nearest.wall_gap[i, k], nearest.wall_at[i, k] = gap, time_s
        if gap <= touch:
            book_time(nearest, time_s, 0.0, i, j)


@kernel
def take_pairs(nearest: Nearest, time_s: float, dt: float, pose: Array, radius: Array, furthest: float) -> None:
    """Take in one step of all pairs of bodies, none of which moved more than `furthest`."""
    n = pose.shape[0]
    slack = 2.0 * furthest
    soon = nearest.soonest[0] * slack / dt if slack > 0.0 else 0.0
    pair = -1
    for i in range(n):
        for j in range(i + 1, n):
            pair += 1
            followed = nearest.followed[pair]
            nearest.followed[pair] = False
            both = radius[i] + radius[j]
            x, y = pose[j, 0] - pose[i, 0], pose[j, 1] - pose[i, 1]
            apart = x * x + y * y
            # Neither nearer than ever within the step, nor so near that at the greatest rate it is the soonest.
            far = max(nearest.gap[pair] + slack, soon) + both
            if apart >= far * far:
                continue
            old_x = nearest.before[j, 0] - nearest.before[i, 0]
            old_y = nearest.before[j, 1] - nearest.before[i, 1]
            after = math.sqrt(apart)
            closed = math.sqrt(old_x * old_x + old_y * old_y) - after
            if closed > 0.0:
                book_time(nearest, time_s, max(0.0, after - both) * dt / closed, i, j)
            if followed:
                continue
            along_x, along_y = x - old_x, y - old_y
            length = along_x * along_x + along_y * along_y
            if length > 0.0:
                part = min(1.0, max(0.0, -(old_x * along_x + old_y * along_y) / length))
                old_x += part * along_x
                old_y += part * along_y
            gap = math.sqrt(old_x * old_x + old_y * old_y) - both
            if gap < nearest.gap[pair]:
                nearest.gap[pair], nearest.at[pair] = gap, time_s


@kernel
def take_obstacles(nearest: Nearest, time_s: float, dt: float, pose: Array, solids: Solids) -> None:
    """Take in one step of all bodies and obstacles."""
    obstacles = solids.obstacles
    for i in range(pose.shape[0]):
        x, y = nearest.before[i, 0], nearest.before[i, 1]
        along_x, along_y = pose[i, 0] - x, pose[i, 1] - y
        length = math.sqrt(along_x * along_x + along_y * along_y)
        soon = 0.0
        if length > 0.0:
            nearest.way[i] += length
            soon = nearest.soonest[0] * length / dt
        for k in range(obstacles.shape[0]):
            followed = nearest.wall_followed[i, k]
            nearest.wall_followed[i, k] = False
            spare = nearest.room[i, k] - nearest.way[i]
            # The gap is at least what it was when `room` was set, less the way since then.
            if spare > 0.0 and nearest.wall_gap[i, k] + spare > soon:
                continue
            first, first_x, first_y = obstacle_gap(x, y, obstacles, k)
            last, last_x, last_y = obstacle_gap(x + along_x, y + along_y, obstacles, k)
            if last < first:
                book_time(nearest, time_s, max(0.0, last - solids.radius[i]) * dt / (first - last), i, -1 - k)
            least = min(first, last)
            if first_x * along_x + first_y * along_y < 0.0 < last_x * along_x + last_y * along_y:
                least = closest_on_way(x, y, along_x, along_y, obstacles, k)  # it went by within the step
            if not followed and least - solids.radius[i] < nearest.wall_gap[i, k]:
                nearest.wall_gap[i, k], nearest.wall_at[i, k] = least - solids.radius[i], time_s
            nearest.room[i, k] = nearest.way[i] + last - solids.radius[i] - nearest.wall_gap[i, k]


@kernel
def approach(
    nearest: Nearest, time_s: float, dt: float, pose: Array, solids: Solids, near: Index, gaps: Array, touch: float
) -> None:
    """Take in one step from where the bodies were to `pose`; the pairs `near` came as close as `gaps` in it."""
    furthest = 0.0
    for i in range(pose.shape[0]):
        dx, dy = pose[i, 0] - nearest.before[i, 0], pose[i, 1] - nearest.before[i, 1]
        moved = dx * dx + dy * dy
        if moved > furthest:  # false for a body that is nowhere
            furthest = moved
    take_followed(nearest, time_s, near, gaps, touch)
    take_pairs(nearest, time_s, dt, pose, solids.radius, math.sqrt(furthest))
    take_obstacles(nearest, time_s, dt, pose, solids)
    for i in range(pose.shape[0]):
        nearest.before[i, 0], nearest.before[i, 1] = pose[i, 0], pose[i, 1]


class Approaches:
    """How near n bodies came to each other and to obstacles, from `pose` (n, 3) on.

    Attributes
    ----------
    nearest : all gaps and times
    """

    def __init__(self, pose: Array, solids: Solids) -> None:
        n, k = len(pose), len(solids.obstacles)
        pairs = n * (n - 1) // 2
        self._solids = solids
        self.nearest = Nearest(
            gap=np.full(pairs, math.inf),
            at=np.zeros(pairs),
            wall_gap=np.full((n, k), math.inf),
            wall_at=np.zeros((n, k)),
            room=np.full((n, k), -math.inf),
            way=np.zeros(n),
            soonest=np.array([math.inf, 0.0]),
            who=np.zeros(2, np.int64),
            followed=np.zeros(pairs, np.bool_),
            wall_followed=np.zeros((n, k), np.bool_),
            before=np.array(pose[:, :2]),
        )

    def sample(self, time_s: float, dt_s: float, pose: Array, referee: ContactReferee) -> None:
        """Take in one step of `dt_s` that ended at `time_s` with the bodies at `pose` (n, 3), as the referee saw it."""
        approach.run(
            self.nearest, time_s, dt_s, pose, self._solids, referee.near, referee.near_gap_m, referee.touch_m
        )  # fmt: skip

    @property
    def apart_m(self) -> Array:
        """The least gap of each body to another one, (n,); inf: there is none."""
        n = len(self.nearest.before)
        least = np.full((n, n), math.inf)
        least[np.triu_indices(n, 1)] = self.nearest.gap
        found: Array = np.minimum(least, least.T).min(axis=1, initial=math.inf)
        return found

    @property
    def clear_m(self) -> Array:
        """The least gap of each body to an obstacle, (n,); inf: there is none."""
        found: Array = self.nearest.wall_gap.min(axis=1, initial=math.inf)
        return found
