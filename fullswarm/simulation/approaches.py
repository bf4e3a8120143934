"""Follows how near bodies come: closest approach of each pair and of each body and obstacle, least time to contact.

Steps are taken in by the dozen: a pair that cannot come nearer than ever within a span of steps is left out at once.
For pairs that the referee has followed through a step (`ContactReferee.near`) its gaps count, which look into the
step; for all others bodies move straight from the start of a step to its end.

**Time to contact** of a pair after a step: its gap then over the rate at which the gap shrank in that step; a pair that
touched in the step has 0 s, one whose gap did not shrink has none.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fullswarm.kernels import Array, Index, kernel
from fullswarm.simulation.contacts import Solids, closest_on_way
from fullswarm.simulation.obstacles import obstacle_gap

SPAN = 60
"""So many steps are taken in at a time, at most: a bit of an integer for each."""


class Nearest(NamedTuple):
    """What came how near to what so far."""

    gap: Array  # (n (n - 1) / 2,) m, least of the pairs (0, 1), (0, 2), …, (1, 2), …
    at: Array  # (n (n - 1) / 2,) s, the end of the step in which it was
    wall_gap: Array  # (n, k) m, the same for bodies and obstacles
    wall_at: Array  # (n, k) s
    soonest: Array  # (2,) s, least time to contact, and the end of the step after which it was
    who: Index  # (2,) row and other row, or -1-k: of that
    followed: Index  # (n (n - 1) / 2,) bit s is set: the referee has followed the pair through step s of the span
    wall_followed: Index  # (n, k)


class Span(NamedTuple):
    """Steps that follow each other."""

    path: Array  # (s + 1, n, 3) poses: at the start, then at the end of each step
    away: Array  # (n,) m, how far each body got from where it was at the start
    longest: Array  # (n,) m, its longest step
    entries: Index  # (m, 3) what the referee has followed: step of the span (from 1), row, other row or -1-k
    gaps: Array  # (m,) m, its smallest gaps


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
def take_followed(nearest: Nearest, span: Span, first: int, dt: float, touch: float) -> None:
    """Take in what the referee has followed, and mark these pairs and steps."""
    n = span.path.shape[1]
    for m in range(span.entries.shape[0]):
        s, i, j, gap = span.entries[m, 0], span.entries[m, 1], span.entries[m, 2], span.gaps[m]
        time_s = (first + s) * dt
        if j >= 0:
            pair = pair_index(min(i, j), max(i, j), n)
            nearest.followed[pair] |= 1 << s
            if gap < nearest.gap[pair]:
                nearest.gap[pair], nearest.at[pair] = gap, time_s
        else:
            k = -1 - j
            nearest.wall_followed[i, k] |= 1 << s
            if gap < nearest.wall_gap[i, k]:
                nearest.wall_gap[i, k], nearest.wall_at[i, k] = gap, time_s
        if gap <= touch:
            book_time(nearest, time_s, 0.0, i, j)


@kernel
def take_pairs(nearest: Nearest, span: Span, first: int, dt: float, radius: Array) -> None:
    """Take in the steps of all pairs of bodies."""
    path, last = span.path, span.path.shape[0] - 1
    n = path.shape[1]
    pair = -1
    for i in range(n):
        for j in range(i + 1, n):
            pair += 1
            followed = nearest.followed[pair]
            nearest.followed[pair] = 0
            both = radius[i] + radius[j]
            x, y = path[0, j, 0] - path[0, i, 0], path[0, j, 1] - path[0, i, 1]
            apart = math.sqrt(x * x + y * y)
            room = apart - both - span.away[i] - span.away[j]
            step = span.longest[i] + span.longest[j]
            # Neither nearer than ever, nor so near that at the greatest rate it is the soonest.
            if room > nearest.gap[pair] and (step <= 0.0 or room > nearest.soonest[0] * step / dt):
                continue
            for s in range(1, last + 1):
                next_x, next_y = path[s, j, 0] - path[s, i, 0], path[s, j, 1] - path[s, i, 1]
                after = math.sqrt(next_x * next_x + next_y * next_y)
                least = min(apart, after)
                if after < apart and (after - both) * dt < nearest.soonest[0] * (apart - after):
                    book_time(nearest, (first + s) * dt, max(0.0, after - both) * dt / (apart - after), i, j)
                if (followed >> s) & 1 == 0:
                    along_x, along_y = next_x - x, next_y - y
                    if x * along_x + y * along_y < 0.0 < next_x * along_x + next_y * along_y:  # it went by
                        length = math.sqrt(along_x * along_x + along_y * along_y)
                        least = math.fabs(x * along_y - y * along_x) / length
                    if least - both < nearest.gap[pair]:
                        nearest.gap[pair], nearest.at[pair] = least - both, (first + s) * dt
                x, y, apart = next_x, next_y, after


@kernel
def take_obstacle(nearest: Nearest, span: Span, first: int, dt: float, solids: Solids, i: int, k: int) -> None:
    """Take in the steps of a body and an obstacle."""
    path, radius, obstacles = span.path, solids.radius[i], solids.obstacles
    followed = nearest.wall_followed[i, k]
    nearest.wall_followed[i, k] = 0
    x, y = path[0, i, 0], path[0, i, 1]
    apart, normal_x, normal_y = obstacle_gap(x, y, obstacles, k)
    room, step = apart - radius - span.away[i], span.longest[i]
    if room > nearest.wall_gap[i, k] and (step <= 0.0 or room > nearest.soonest[0] * step / dt):
        return
    for s in range(1, path.shape[0]):
        along_x, along_y = path[s, i, 0] - x, path[s, i, 1] - y
        after, next_x, next_y = obstacle_gap(path[s, i, 0], path[s, i, 1], obstacles, k)
        least = min(apart, after)
        if after < apart:
            book_time(nearest, (first + s) * dt, max(0.0, after - radius) * dt / (apart - after), i, -1 - k)
        if (followed >> s) & 1 == 0:
            if normal_x * along_x + normal_y * along_y < 0.0 < next_x * along_x + next_y * along_y:  # it went by
                least = closest_on_way(x, y, along_x, along_y, obstacles, k)
            if least - radius < nearest.wall_gap[i, k]:
                nearest.wall_gap[i, k], nearest.wall_at[i, k] = least - radius, (first + s) * dt
        x, y, apart, normal_x, normal_y = path[s, i, 0], path[s, i, 1], after, next_x, next_y


@kernel
def approach(nearest: Nearest, span: Span, solids: Solids, first: int, dt: float, touch: float) -> None:
    """Take in a span, before which there were `first` steps of `dt` seconds."""
    path = span.path
    for i in range(path.shape[1]):
        span.away[i] = span.longest[i] = 0.0
        for s in range(1, path.shape[0]):
            dx, dy = path[s, i, 0] - path[0, i, 0], path[s, i, 1] - path[0, i, 1]
            along_x, along_y = path[s, i, 0] - path[s - 1, i, 0], path[s, i, 1] - path[s - 1, i, 1]
            span.away[i] = max(span.away[i], dx * dx + dy * dy)
            span.longest[i] = max(span.longest[i], along_x * along_x + along_y * along_y)
        span.away[i], span.longest[i] = math.sqrt(span.away[i]), math.sqrt(span.longest[i])
    take_followed(nearest, span, first, dt, touch)
    take_pairs(nearest, span, first, dt, solids.radius)
    for i in range(path.shape[1]):
        for k in range(solids.obstacles.shape[0]):
            take_obstacle(nearest, span, first, dt, solids, i, k)


class Approaches:
    """How near n bodies came to each other and to obstacles.

    Attributes
    ----------
    nearest : all gaps and times
    """

    def __init__(self, solids: Solids, touch_m: float, dt_s: float) -> None:
        n, k = len(solids.radius), len(solids.obstacles)
        pairs = n * (n - 1) // 2
        self._solids, self._touch_m, self._dt_s = solids, touch_m, dt_s
        self._away, self._longest = np.zeros(n), np.zeros(n)
        self.nearest = Nearest(
            gap=np.full(pairs, math.inf),
            at=np.zeros(pairs),
            wall_gap=np.full((n, k), math.inf),
            wall_at=np.zeros((n, k)),
            soonest=np.array([math.inf, 0.0]),
            who=np.zeros(2, np.int64),
            followed=np.zeros(pairs, np.int64),
            wall_followed=np.zeros((n, k), np.int64),
        )

    def take(self, first: int, path: Array, entries: Index, gaps_m: Array) -> None:
        """Take in a span of `SPAN` steps at most, before which there were `first`.

        Parameters
        ----------
        path : (s + 1, n, 3) true poses
        entries, gaps_m : (m, 3), (m,) as in `Span`
        """
        span = Span(path, self._away, self._longest, entries, gaps_m)
        approach.run(self.nearest, span, self._solids, first, self._dt_s, self._touch_m)

    @property
    def apart_m(self) -> Array:
        """The least gap of each body to another one, (n,); inf: there is none."""
        n = len(self._solids.radius)
        least = np.full((n, n), math.inf)
        least[np.triu_indices(n, 1)] = self.nearest.gap
        found: Array = np.minimum(least, least.T).min(axis=1, initial=math.inf)
        return found

    @property
    def clear_m(self) -> Array:
        """The least gap of each body to an obstacle, (n,); inf: there is none."""
        found: Array = self.nearest.wall_gap.min(axis=1, initial=math.inf)
        return found
