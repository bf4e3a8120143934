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


def touch_m(config: WorldConfig) -> float:
    """Return the gap at or below which two bodies of a world touch.

    Bullet keeps two bodies of radius r apart along the line through their centres at the start of a substep. When they
    also move past each other by s in it, as in a graze, a gap of hypot(2 r, s) - 2 r stays.
    """
    substep_s = 1.0 / (config.rate_hz * config.substeps)
    both_m = 2.0 * config.radius_m
    return max(TOUCH_M, 1e-4 + math.hypot(both_m, 2.0 * config.speed_limit_m_s * substep_s) - both_m)


class ContactReferee:
    """Judges the paths of n bodies, step by step.

    Attributes
    ----------
    part_s : (p,) when the parts of a step end, since its start
    path : (p + 1, n, 2) m, written by the engine: centres at the start of a step and after each part of it
    contacts : (n,) bodies and obstacles that each body touched during the last step; the same array at all times
    pairs : (m, 2) which touched; the second is -1-k for obstacle k
    near, near_gap_m : (m, 2), (m,) pairs that were so close that they might have touched, and their smallest gaps
    """

    def __init__(self, config: WorldConfig, obstacles: Array, count: int, part_s: Array) -> None:
        self.radius_m, self.touch_m = float(config.radius_m), touch_m(config)
        self.obstacles = obstacles
        self.part_s, self.path = part_s, np.zeros((len(part_s) + 1, count, 2))
        self.contacts = np.zeros(count, np.int64)
        self.found = np.zeros(2, np.int64)
        self._anchor, self._state = np.full((count, 2), math.inf), np.array([-1.0])
        self._counts, self._grid = np.zeros(1, np.int64), np.zeros(8 * count + 64, np.int64)
        self._marked = np.zeros(count, np.bool_)
        self._listed = 0
        self.allocate(16 * count + 64)
        self._sweep()  # compiles it, where kernels are: not when the first two robots meet

    def allocate(self, capacity: int) -> None:
        """Make room for so many candidates."""
        self.candidates = np.zeros((capacity, 4), np.int64)
        self.near_room, self.gap_room = np.zeros((capacity, 2), np.int64), np.zeros(capacity)
        self.pair_room = np.zeros((capacity, 2), np.int64)

    def reach_m(self, furthest_m: float) -> float:
        """Return the gap from which bodies can touch in a step in which the fastest one drives `furthest_m`."""
        return PUSHED * furthest_m + self.touch_m

    def look_ahead(self, pose: Array, furthest_m: float) -> list[int]:
        """Return the rows of the bodies that may touch something in the next step, in which none drives further."""
        listed = self._look(pose, furthest_m)
        while listed < 0:
            self.allocate(2 * len(self.candidates))
            listed = self._look(pose, furthest_m)
        self._listed = listed
        rows: list[int] = np.flatnonzero(self._marked).tolist() if listed else []
        return rows

    def _look(self, pose: Array, furthest_m: float) -> int:
        return may_touch.run(
            pose, self.obstacles, self.radius_m, self.reach_m(furthest_m), self._anchor, self._state, self._counts,
            self.candidates, self._grid, self.near_room, self._marked,
        )  # fmt: skip

    def judge(self) -> None:
        """Find the contacts on the paths of the bodies that `look_ahead` has listed."""
        if self._listed or len(self.near):
            self._sweep()

    def _sweep(self) -> None:
        sweep.run(
            self.path, self.obstacles, self.radius_m, self.touch_m, math.inf, self.near_room, self._listed,
            self.near_room, self.gap_room, self.pair_room, self.contacts, self.found,
        )  # fmt: skip
        self.publish()

    def publish(self) -> None:
        """Publish what the kernel has found."""
        listed, touching = self.found.tolist()
        self.near: NDArray[np.int64] = self.near_room[:listed]
        self.near_gap_m: Array = self.gap_room[:listed]
        self.pairs: NDArray[np.int64] = self.pair_room[:touching]


@kernel
def near_obstacles(pose: Array, obstacles: Array, reach: float, candidates: Index, count: int) -> int:
    """Add (body, -1-k) for all that are within `reach`; return the new count, which may exceed the room."""
    for i in range(pose.shape[0]):
        for k in range(obstacles.shape[0]):
            dx, dy = pose[i, 0] - obstacles[k, 0], pose[i, 1] - obstacles[k, 1]
            far = obstacles[k, 7] + reach
            if dx * dx + dy * dy < far * far and obstacle_gap(pose[i, 0], pose[i, 1], obstacles, k)[0] < reach:
                if count < candidates.shape[0]:
                    candidates[count, 0], candidates[count, 1] = i, -1 - k
                count += 1
    return count


@kernel
def near_bodies(pose: Array, reach: float, candidates: Index, count: int) -> int:
    """Add all pairs of bodies within `reach`, each against each; return the new count."""
    n = pose.shape[0]
    for i in range(n):
        x, y = pose[i, 0], pose[i, 1]
        for j in range(i + 1, n):
            dx, dy = pose[j, 0] - x, pose[j, 1] - y
            if dx * dx + dy * dy < reach * reach:
                if count < candidates.shape[0]:
                    candidates[count, 0], candidates[count, 1] = i, j
                count += 1
    return count


@kernel
def near_bodies_grid(pose: Array, reach: float, candidates: Index, grid: Index, count: int) -> int:
    """Do the same as `near_bodies` with a cell grid (counting sort); `grid` holds at least 8 n + 64 numbers."""
    n = pose.shape[0]
    x_min, x_max, y_min, y_max = pose[0, 0], pose[0, 0], pose[0, 1], pose[0, 1]
    for i in range(1, n):
        x_min, x_max = min(x_min, pose[i, 0]), max(x_max, pose[i, 0])
        y_min, y_max = min(y_min, pose[i, 1]), max(y_max, pose[i, 1])
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
                dx, dy = pose[j, 0] - x, pose[j, 1] - y
                if j > i and dx * dx + dy * dy < reach * reach:
                    if count < candidates.shape[0]:
                        candidates[count, 0], candidates[count, 1] = i, j
                    count += 1
    return count


@kernel
def list_near(pose: Array, obstacles: Array, radius: float, skin: float, candidates: Index, grid: Index) -> int:
    """List all pairs whose rims are within `skin`; return how many, which may exceed the room in `candidates`."""
    listed = near_obstacles(pose, obstacles, radius + skin, candidates, 0)
    if pose.shape[0] > BRUTE_FORCE_BODIES:
        return near_bodies_grid(pose, 2.0 * radius + skin, candidates, grid, listed)
    return near_bodies(pose, 2.0 * radius + skin, candidates, listed)


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
def closest_obstacle(path: Array, at: int, i: int, obstacles: Array, k: int, stop_m: float) -> float:
    """Return the smallest gap of body `i`'s centre to obstacle `k` from point `at` of the path to the next.

    The gap to a convex shape has one minimum on a straight way, which halving finds. A way that ends further from
    `stop_m` than it is long is not searched: its smaller end is returned.
    """
    x, y = path[at, i, 0], path[at, i, 1]
    along_x, along_y = path[at + 1, i, 0] - x, path[at + 1, i, 1] - y
    first = obstacle_gap(x, y, obstacles, k)[0]
    last = obstacle_gap(x + along_x, y + along_y, obstacles, k)[0]
    least = min(first, last)
    if least <= stop_m or max(first, last) - math.sqrt(along_x * along_x + along_y * along_y) > stop_m:
        return least
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
def may_touch(
    pose: Array, obstacles: Array, radius: float, reach: float, anchor: Array, state: Array, counts: Index,
    candidates: Index, grid: Index, near: Index, marked: NDArray[np.bool_],
) -> int:  # fmt: skip
    """List in `near` the pairs whose rims are within `reach`, and mark their bodies.

    Parameters
    ----------
    anchor : (n, 2) where the bodies were when `candidates` was made
    state : (1,) how far apart rims may be to be among the candidates (m); -1: there are none yet
    counts : (1,) number of candidates

    Returns
    -------
    int
        How many; -1 if `candidates` is too small.
    """
    n = pose.shape[0]
    moved = 0.0
    for i in range(n):
        dx, dy = pose[i, 0] - anchor[i, 0], pose[i, 1] - anchor[i, 1]
        moved = max(moved, dx * dx + dy * dy)
        marked[i] = False
    if 2.0 * math.sqrt(moved) + reach > state[0]:
        skin = max(SKIN_RADII * radius, 2.0 * reach)
        found = list_near(pose, obstacles, radius, skin, candidates, grid)
        if found > candidates.shape[0]:
            state[0] = -1.0
            return -1
        state[0], counts[0] = skin, found
        for i in range(n):
            anchor[i, 0], anchor[i, 1] = pose[i, 0], pose[i, 1]
    far = 2.0 * radius + reach
    listed = 0
    for c in range(counts[0]):
        i, j = candidates[c, 0], candidates[c, 1]
        if j >= 0:
            dx, dy = pose[j, 0] - pose[i, 0], pose[j, 1] - pose[i, 1]
            if dx * dx + dy * dy > far * far:
                continue
            marked[j] = True
        elif obstacle_gap(pose[i, 0], pose[i, 1], obstacles, -1 - j)[0] > radius + reach:
            continue
        marked[i] = True
        near[listed, 0], near[listed, 1] = i, j
        listed += 1
    return listed


@kernel
def sweep(
    path: Array, obstacles: Array, radius: float, touch: float, reach: float, candidates: Index, count: int,
    near: Index, gaps: Array, pairs: Index, contacts: Index, found: Index,
) -> None:  # fmt: skip
    """Find which of the first `count` candidates touch on the path: rims within `touch` of each other.

    Parameters
    ----------
    path : (p, n, 2)
    near, gaps : (m, 2), (m,) filled with the pairs that were within `reach` at the start, and their smallest gaps (m)
    pairs : (m, 2) filled with those that touch
    contacts : (n,) set to the number of pairs that each body is part of
    found : (2,) set to how many are near, and how many touch
    """
    for i in range(contacts.shape[0]):
        contacts[i] = 0
    last = path.shape[0] - 1
    far = 2.0 * radius + reach
    listed, touching = 0, 0
    for c in range(count):
        i, j = candidates[c, 0], candidates[c, 1]
        if j >= 0:
            dx, dy = path[0, j, 0] - path[0, i, 0], path[0, j, 1] - path[0, i, 1]
            if dx * dx + dy * dy > far * far:
                continue
            least = closest_bodies(path, 0, i, j)
            for at in range(1, last):
                least = min(least, closest_bodies(path, at, i, j))
            least -= 2.0 * radius
        else:
            if obstacle_gap(path[0, i, 0], path[0, i, 1], obstacles, -1 - j)[0] > radius + reach:
                continue
            least = closest_obstacle(path, 0, i, obstacles, -1 - j, radius + touch)
            for at in range(1, last):
                least = min(least, closest_obstacle(path, at, i, obstacles, -1 - j, radius + touch))
            least -= radius
        near[listed, 0], near[listed, 1], gaps[listed] = i, j, least
        listed += 1
        if least <= touch:
            pairs[touching, 0], pairs[touching, 1] = i, j
            touching += 1
            contacts[i] += 1
            if j >= 0:
                contacts[j] += 1
    found[0], found[1] = listed, touching
