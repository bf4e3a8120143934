"""Decides which bodies of a world touched during a step, in the same way for every engine.

Two bodies, or a body and an obstacle, touch when their rims come within `touch_m` of each other anywhere on the paths
that they took, substep by substep. The engine supplies only the paths: its own contacts are not used, because a solver
pushes fast bodies apart before they meet and drops short contacts within a step.

A path has one point per body at the start of the step and one after each physics substep (the kinematic engine adds
one before it pushes); between two points bodies move straight. A pair is (row, other row), or (row, -1-k) for
obstacle k, whose columns are those of :func:`fullswarm.simulation.obstacles.with_trigonometry`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fullswarm.config import WorldConfig
from fullswarm.kernels import Array, Index, kernel
from fullswarm.simulation.obstacles import obstacle_gap

TOUCH_M = 0.002
"""Bodies of 0.17 m that meet at 4 + 4 m/s are pushed by Bullet at a gap of up to 1.5 mm, see `touch_m`."""
PUSHED = 3.0
"""The gap of two bodies shrinks by at most this many times the way of the fastest one: it and one that others push."""
BRUTE_FORCE_BODIES = 40
SKIN_RADII = 1.5  # how far apart two bodies may be, in radii, to stay on the list
HALVINGS = 40  # of an interval in which a distance has one minimum


class Solids(NamedTuple):
    """What is solid in a world of n bodies."""

    obstacles: Array  # (k, 8) rows of `with_trigonometry`
    radius: Array  # (n,) m, of the bodies


class Candidates(NamedTuple):
    """Pairs that may meet soon: a list that is kept until bodies have moved far enough to change it."""

    pairs: Index  # (m, 4) row, other row or -1-k, two columns of scratch
    used: Index  # (1,) how many rows of it are
    slack: Array  # (2,) m: moved since the list was made; gap up to which pairs are on it, -1: no list
    anchor: Array  # (n, 2) where bodies were then
    grid: Index  # (8 n + 64,) scratch


class Judged(NamedTuple):
    """What the referee has found on the paths of a step."""

    near: Index  # (m, 2) pairs that were so close that they might have touched
    gaps: Array  # (m,) their smallest gaps
    pairs: Index  # (m, 2) pairs that touch
    contacts: Index  # (n,) of how many touching pairs each body is part
    found: Index  # (2,) how many are near, and how many touch


def touch_m(config: WorldConfig, radius_m: Array | None = None) -> float:
    """Return the gap at or below which two bodies of a world touch, with radii (n,) other than the world's if given.

    Bullet keeps two bodies of radius r apart along the line through their centres at the start of a substep. When they
    also move past each other by s in it, as in a graze, a gap of hypot(2 r, s) - 2 r stays. It is the largest for the
    smallest bodies.
    """
    substep_s = 1.0 / (config.rate_hz * config.substeps)
    both_m = 2.0 * (config.radius_m if radius_m is None else float(radius_m.min(initial=math.inf)))
    if math.isinf(both_m):
        return TOUCH_M
    return max(TOUCH_M, 1e-4 + math.hypot(both_m, 2.0 * config.speed_limit_m_s * substep_s) - both_m)


def radii_of(bodies: Sequence[WorldConfig]) -> Array:
    """Return the radii of bodies, (n,) m."""
    return np.array([body.radius_m for body in bodies], np.float64)


class ContactReferee:
    """Judges the paths of n bodies, step by step.

    Parameters
    ----------
    radius_m : (n,) of the bodies
    part_s : (p,) when the parts of a step end, since its start
    movers : so many of the obstacles, the last ones, are movers

    Attributes
    ----------
    part_s : as given
    path : (p + 1, n, 2) m, written by the engine: centres at the start of a step and after each part of it
    contacts : (n,) bodies and obstacles that each body touched during the last step; the same array at all times
    pairs : (m, 2) which touched; the second is -1-k for obstacle k
    fixed : so many of the obstacles, the first ones, do not move
    near, near_gap_m : (m, 2), (m,) pairs that were so close that they might have touched, and their smallest gaps
    """

    def __init__(
        self, config: WorldConfig, obstacles: Array, radius_m: Array, part_s: Array, movers: int = 0
    ) -> None:  # fmt: skip
        count = len(radius_m)
        self.radius_m, self.touch_m = np.array(radius_m, np.float64), touch_m(config, radius_m)
        self.solids, self.fixed = Solids(obstacles, self.radius_m), len(obstacles) - movers
        self.part_s, self.path = part_s, np.zeros((len(part_s) + 1, count, 2))
        self.contacts = np.zeros(count, np.int64)
        self._marked = np.zeros(count, np.bool_)
        self._listed = 0
        self.allocate(16 * count + 64)
        self._sweep()  # compiles it, where kernels are: not when the first two robots meet

    def allocate(self, capacity: int) -> None:
        """Make room for so many candidates."""
        count = len(self.radius_m)
        self.candidates = Candidates(
            pairs=np.zeros((capacity, 4), np.int64),
            used=np.zeros(1, np.int64),
            slack=np.array([0.0, -1.0]),
            anchor=np.full((count, 2), math.inf),
            grid=np.zeros(8 * count + 64, np.int64),
        )
        self.judged = Judged(
            near=np.zeros((capacity, 2), np.int64),
            gaps=np.zeros(capacity),
            pairs=np.zeros((capacity, 2), np.int64),
            contacts=self.contacts,
            found=np.zeros(2, np.int64),
        )

    def place_movers(self, places: Array) -> None:
        """Put the last of the obstacles at `places` (m, 2)."""
        rows = self.solids.obstacles[len(self.solids.obstacles) - len(places) :]
        way_m = float(np.hypot(*(places - rows[:, :2]).T).max(initial=0.0))
        self.candidates.slack[0] += way_m
        rows[:, :2] = places

    def reach_m(self, furthest_m: float) -> float:
        """Return the gap from which bodies can touch in a step in which the fastest one drives `furthest_m`."""
        return PUSHED * furthest_m + self.touch_m

    def look_ahead(self, pose: Array, furthest_m: float) -> list[int]:
        """Return the rows of the bodies that may touch something in the next step, in which none drives further."""
        listed = self._look(pose, furthest_m)
        while listed < 0:
            self.allocate(2 * len(self.candidates.pairs))
            listed = self._look(pose, furthest_m)
        self._listed = listed
        rows: list[int] = np.flatnonzero(self._marked).tolist() if listed else []
        return rows

    def _look(self, pose: Array, furthest_m: float) -> int:
        reach_m = self.reach_m(furthest_m)
        return may_touch.run(pose, self.solids, reach_m, self.candidates, self.judged.near, self._marked)

    def judge(self) -> None:
        """Find the contacts on the paths of the bodies that `look_ahead` has listed."""
        if self._listed or len(self.near):
            self._sweep()

    def _sweep(self) -> None:
        near = self.judged.near
        sweep.run(self.path, self.solids, self.touch_m, math.inf, near, self._listed, self.judged)
        self.publish()

    def publish(self) -> None:
        """Publish what the kernel has found."""
        judged = self.judged
        listed, touching = judged.found.tolist()
        self.near: Index = judged.near[:listed]
        self.near_gap_m: Array = judged.gaps[:listed]
        self.pairs: Index = judged.pairs[:touching]


@kernel
def near_obstacles(pose: Array, solids: Solids, skin: float, pairs: Index, count: int) -> int:
    """Add (body, -1-k) for all whose rims are within `skin`; return the new count, which may exceed the room."""
    obstacles = solids.obstacles
    for i in range(pose.shape[0]):
        reach = solids.radius[i] + skin
        for k in range(obstacles.shape[0]):
            dx, dy = pose[i, 0] - obstacles[k, 0], pose[i, 1] - obstacles[k, 1]
            far = obstacles[k, 7] + reach
            if dx * dx + dy * dy < far * far and obstacle_gap(pose[i, 0], pose[i, 1], obstacles, k)[0] < reach:
                if count < pairs.shape[0]:
                    pairs[count, 0], pairs[count, 1] = i, -1 - k
                count += 1
    return count


@kernel
def near_bodies(pose: Array, radius: Array, skin: float, pairs: Index, count: int) -> int:
    """Add all pairs of bodies whose rims are within `skin`, each against each; return the new count."""
    n = pose.shape[0]
    for i in range(n):
        x, y, reach = pose[i, 0], pose[i, 1], radius[i] + skin
        for j in range(i + 1, n):
            dx, dy, far = pose[j, 0] - x, pose[j, 1] - y, reach + radius[j]
            if dx * dx + dy * dy < far * far:
                if count < pairs.shape[0]:
                    pairs[count, 0], pairs[count, 1] = i, j
                count += 1
    return count


@kernel
def near_bodies_grid(pose: Array, radius: Array, skin: float, pairs: Index, grid: Index, count: int) -> int:
    """Do the same as `near_bodies` with a cell grid (counting sort); `grid` holds at least 8 n + 64 numbers."""
    n = pose.shape[0]
    x_min, x_max, y_min, y_max = pose[0, 0], pose[0, 0], pose[0, 1], pose[0, 1]
    for i in range(1, n):
        x_min, x_max = min(x_min, pose[i, 0]), max(x_max, pose[i, 0])
        y_min, y_max = min(y_min, pose[i, 1]), max(y_max, pose[i, 1])
    largest = 0.0
    for i in range(n):
        largest = max(largest, radius[i])
    reach = 2.0 * largest + skin
    most = int(math.sqrt(4.0 * n)) + 1  # per axis, so that all cells fit into `grid`
    size = max(reach, (x_max - x_min) / most, (y_max - y_min) / most)
    columns = min(most, int((x_max - x_min) / size) + 1)
    rows = min(most, int((y_max - y_min) / size) + 1)
    cell, order, start = grid[:n], grid[n : 2 * n], grid[2 * n : 2 * n + columns * rows + 1]
    start[:] = 0
    for i in range(n):
        column = min(columns - 1, int((pose[i, 0] - x_min) / size))
        row = min(rows - 1, int((pose[i, 1] - y_min) / size))
        cell[i] = row * columns + column
        start[cell[i] + 1] += 1
    for c in range(columns * rows):
        start[c + 1] += start[c]
    for i in range(n - 1, -1, -1):  # backwards: afterwards start[c + 1] is where cell c begins
        start[cell[i] + 1] -= 1
        order[start[cell[i] + 1]] = i
    for i in range(n):
        x, y, home = pose[i, 0], pose[i, 1], cell[i]
        home_row, home_column = home // columns, home % columns
        for row in range(max(0, home_row - 1), min(rows, home_row + 2)):
            low = row * columns + max(0, home_column - 1)
            high = row * columns + min(columns, home_column + 2)
            first = start[low + 1]
            last = start[high + 1] if high < columns * rows else n
            for slot in range(first, last):
                j = order[slot]
                dx, dy, far = pose[j, 0] - x, pose[j, 1] - y, radius[i] + skin + radius[j]
                if j > i and dx * dx + dy * dy < far * far:
                    if count < pairs.shape[0]:
                        pairs[count, 0], pairs[count, 1] = i, j
                    count += 1
    return count


@kernel
def list_near(pose: Array, solids: Solids, least_skin: float, listed: Candidates) -> bool:
    """List all pairs whose rims are within a skin of at least `least_skin`; return whether there is room for them.

    The skin is `SKIN_RADII` of the mean radius where that is more.
    """
    radius, total = solids.radius, 0.0
    for i in range(radius.shape[0]):
        total += radius[i]
    skin = max(SKIN_RADII * total / max(1, radius.shape[0]), least_skin)
    count = near_obstacles(pose, solids, skin, listed.pairs, 0)
    if pose.shape[0] > BRUTE_FORCE_BODIES:
        count = near_bodies_grid(pose, radius, skin, listed.pairs, listed.grid, count)
    else:
        count = near_bodies(pose, radius, skin, listed.pairs, count)
    if count > listed.pairs.shape[0]:
        listed.slack[1] = -1.0
        return False
    listed.slack[0], listed.slack[1], listed.used[0] = 0.0, skin, count
    return True


@kernel
def closest_bodies(path: Array, at: int, i: int, j: int) -> float:
    """Return the smallest distance of the centres of bodies `i` and `j` from point `at` of the path to the next."""
    x, y = path[at, j, 0] - path[at, i, 0], path[at, j, 1] - path[at, i, 1]
    along_x = path[at + 1, j, 0] - path[at + 1, i, 0] - x
    along_y = path[at + 1, j, 1] - path[at + 1, i, 1] - y
    length = along_x * along_x + along_y * along_y
    if length > 0.0:
        part = min(1.0, max(0.0, -(x * along_x + y * along_y) / length))
        x += part * along_x
        y += part * along_y
    return math.sqrt(x * x + y * y)


@kernel
def closest_on_way(x: float, y: float, along_x: float, along_y: float, obstacles: Array, k: int) -> float:
    """Return the smallest gap of a point to obstacle `k` on its straight way from (x, y).

    The gap to a convex shape has one minimum on a straight way, which halving finds.
    """
    least = min(obstacle_gap(x, y, obstacles, k)[0], obstacle_gap(x + along_x, y + along_y, obstacles, k)[0])
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        third = (high - low) / 3.0
        one = obstacle_gap(x + (low + third) * along_x, y + (low + third) * along_y, obstacles, k)[0]
        two = obstacle_gap(x + (high - third) * along_x, y + (high - third) * along_y, obstacles, k)[0]
        least = min(least, one, two)
        if one < two:
            high -= third
        else:
            low += third
    return least


@kernel
def closest_obstacle(path: Array, at: int, i: int, obstacles: Array, k: int, stop_m: float) -> float:
    """Return the smallest gap of body `i`'s centre to obstacle `k` from point `at` of the path to the next.

    A way that ends further from `stop_m` than it is long is not searched: its smaller end is returned.
    """
    x, y = path[at, i, 0], path[at, i, 1]
    along_x, along_y = path[at + 1, i, 0] - x, path[at + 1, i, 1] - y
    first = obstacle_gap(x, y, obstacles, k)[0]
    last = obstacle_gap(x + along_x, y + along_y, obstacles, k)[0]
    least = min(first, last)
    if least <= stop_m or max(first, last) - math.sqrt(along_x * along_x + along_y * along_y) > stop_m:
        return least
    return closest_on_way(x, y, along_x, along_y, obstacles, k)


@kernel
def may_touch(
    pose: Array, solids: Solids, reach: float, listed: Candidates, near: Index, marked: NDArray[np.bool_]
) -> int:
    """List in `near` the pairs whose rims are within `reach`, and mark their bodies.

    Returns
    -------
    int
        How many; -1 if there is no room for all candidates.
    """
    n = pose.shape[0]
    obstacles, radius, pairs = solids.obstacles, solids.radius, listed.pairs
    moved = 0.0
    for i in range(n):
        dx, dy = pose[i, 0] - listed.anchor[i, 0], pose[i, 1] - listed.anchor[i, 1]
        moved = max(moved, dx * dx + dy * dy)
        marked[i] = False
    if 2.0 * math.sqrt(moved) + listed.slack[0] + reach > listed.slack[1]:
        if not list_near(pose, solids, 2.0 * reach, listed):
            return -1
        for i in range(n):
            listed.anchor[i, 0], listed.anchor[i, 1] = pose[i, 0], pose[i, 1]
    count = 0
    for c in range(listed.used[0]):
        i, j = pairs[c, 0], pairs[c, 1]
        if j >= 0:
            dx, dy, far = pose[j, 0] - pose[i, 0], pose[j, 1] - pose[i, 1], radius[i] + radius[j] + reach
            if dx * dx + dy * dy > far * far:
                continue
            marked[j] = True
        elif obstacle_gap(pose[i, 0], pose[i, 1], obstacles, -1 - j)[0] > radius[i] + reach:
            continue
        marked[i] = True
        near[count, 0], near[count, 1] = i, j
        count += 1
    return count


@kernel
def sweep(
    path: Array, solids: Solids, touch: float, reach: float, candidates: Index, count: int, judged: Judged
) -> None:
    """Find which of the first `count` candidates touch on the path: rims within `touch` of each other.

    Parameters
    ----------
    path : (p, n, 2)
    reach : pairs whose rims were within it at the start are followed
    """
    obstacles, radius = solids.obstacles, solids.radius
    for i in range(judged.contacts.shape[0]):
        judged.contacts[i] = 0
    last = path.shape[0] - 1
    listed, touching = 0, 0
    for c in range(count):
        i, j = candidates[c, 0], candidates[c, 1]
        if j >= 0:
            both = radius[i] + radius[j]
            dx, dy, far = path[0, j, 0] - path[0, i, 0], path[0, j, 1] - path[0, i, 1], both + reach
            if dx * dx + dy * dy > far * far:
                continue
            least = closest_bodies(path, 0, i, j)
            for at in range(1, last):
                least = min(least, closest_bodies(path, at, i, j))
            least -= both
        else:
            if obstacle_gap(path[0, i, 0], path[0, i, 1], obstacles, -1 - j)[0] > radius[i] + reach:
                continue
            least = closest_obstacle(path, 0, i, obstacles, -1 - j, radius[i] + touch)
            for at in range(1, last):
                least = min(least, closest_obstacle(path, at, i, obstacles, -1 - j, radius[i] + touch))
            least -= radius[i]
        judged.near[listed, 0], judged.near[listed, 1], judged.gaps[listed] = i, j, least
        listed += 1
        if least <= touch:
            judged.pairs[touching, 0], judged.pairs[touching, 1] = i, j
            touching += 1
            judged.contacts[i] += 1
            if j >= 0:
                judged.contacts[j] += 1
    judged.found[0], judged.found[1] = listed, touching
