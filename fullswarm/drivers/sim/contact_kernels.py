"""Which bodies touch: exact geometry along the paths of a world step, the same loops for every engine.

A path has one point per body at the start of the step and one after each physics substep (the kinematic engine adds
one before it pushes); between two points bodies move straight. A pair is (row, other row), or (row, -1-k) for
obstacle k, whose columns are those of :func:`fullswarm.drivers.sim.kinematic.with_trigonometry`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fullswarm.kernels import Array, Index, kernel

BRUTE_FORCE_BODIES = 40
SKIN_RADII = 1.5  # how far apart two bodies may be, in radii, to stay on the list
HALVINGS = 40  # of an interval in which a distance has one minimum


@kernel
def obstacle_gap(x: float, y: float, obstacles: Array, k: int) -> tuple[float, float, float]:
    """Return the distance of a point to obstacle `k` (< 0 inside) and the outward normal there (x, y)."""
    dx, dy = x - obstacles[k, 0], y - obstacles[k, 1]
    c, s = obstacles[k, 4], obstacles[k, 5]
    local_x, local_y = c * dx + s * dy, c * dy - s * dx
    half_x, half_y, corner = obstacles[k, 2], obstacles[k, 3], obstacles[k, 6]
    off_x = local_x - max(-half_x, min(half_x, local_x))
    off_y = local_y - max(-half_y, min(half_y, local_y))
    gap = math.sqrt(off_x * off_x + off_y * off_y)
    if gap > 0.0:
        nx, ny = off_x / gap, off_y / gap
    else:  # inside: out through the nearest side
        deep_x, deep_y = half_x - abs(local_x), half_y - abs(local_y)
        gap = -min(deep_x, deep_y)
        nx, ny = 0.0, 0.0
        if deep_x < deep_y:
            nx = 1.0 if local_x >= 0.0 else -1.0
        else:
            ny = 1.0 if local_y >= 0.0 else -1.0
    return gap - corner, c * nx - s * ny, s * nx + c * ny


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
    """Do the same with a cell grid (counting sort); `grid` holds at least 8 n + 64 numbers."""
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
        found = near_obstacles(pose, obstacles, radius + skin, candidates, 0)
        if n > BRUTE_FORCE_BODIES:
            found = near_bodies_grid(pose, 2.0 * radius + skin, candidates, grid, found)
        else:
            found = near_bodies(pose, 2.0 * radius + skin, candidates, found)
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
    """Tell which of the first `count` candidates touch on the path: rims within `touch` of each other.

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
