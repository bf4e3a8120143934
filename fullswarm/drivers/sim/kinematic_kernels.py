"""The loops of the kinematic engine (see :func:`advance`).

Scratch columns of a body: 0, 1 cos and sin of its heading; 2, 3 those of half a substep's turn; 4 chord of one
substep (m); 5, 6 sum of the pushes it got in this step (m); 7 the last pass that pushed it. A candidate is (row,
other row or -1-k for obstacle k, touched in this step, scratch).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fullswarm.drivers.base import Array
from fullswarm.kernels import kernel

Ints = NDArray[np.int64]

SCRATCH_COLUMNS = 8
BRUTE_FORCE_BODIES = 40
SKIN_RADII = 1.5  # how far apart two bodies may be, in radii, to stay on the list
TOUCH_M = 1e-6  # bodies pushed to exact touch still touch in the next step
SETTLED_M = 1e-5  # an overlap that need not be pushed out within the same substep
PASSES = 12.0  # of pushing per substep; a free pair needs one, a pile more


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
def near_obstacles(pose: Array, obstacles: Array, reach: float, candidates: Ints, count: int) -> int:
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
def near_bodies(pose: Array, reach: float, candidates: Ints, count: int) -> int:
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
def near_bodies_grid(pose: Array, reach: float, candidates: Ints, grid: Ints, count: int) -> int:
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
def shift(pose: Array, scratch: Array, i: int, dx: float, dy: float, turn: float) -> None:
    """Move body `i` aside, book the push, and note in which pass (`turn`) it moved."""
    pose[i, 0] += dx
    pose[i, 1] += dy
    scratch[i, 5] += dx
    scratch[i, 6] += dy
    scratch[i, 7] = turn


@kernel
def push(pose: Array, obstacles: Array, scratch: Array, i: int, j: int, radius: float, turn: float) -> float:
    """Push body `i` and body (or obstacle) `j` apart if they overlap; return the gap before (m)."""
    if j < 0:
        gap, nx, ny = obstacle_gap(pose[i, 0], pose[i, 1], obstacles, -1 - j)
        gap -= radius
        if gap < 0.0:
            shift(pose, scratch, i, -gap * nx, -gap * ny, turn)
        return gap
    dx, dy = pose[i, 0] - pose[j, 0], pose[i, 1] - pose[j, 1]
    distance = math.sqrt(dx * dx + dy * dy)
    gap = distance - 2.0 * radius
    if gap < 0.0:
        nx, ny = 1.0, 0.0
        if distance > 1e-12:
            nx, ny = dx / distance, dy / distance
        shift(pose, scratch, i, -0.5 * gap * nx, -0.5 * gap * ny, turn)
        shift(pose, scratch, j, 0.5 * gap * nx, 0.5 * gap * ny, turn)
    return gap


@kernel
def first_pass(
    pose: Array, obstacles: Array, scratch: Array, candidates: Ints, count: int, radius: float, close_m: float
) -> int:
    """Push every overlapping candidate apart and flag it; list those nearer than `close_m`, return how many.

    The list is kept in the candidates' last column.
    """
    far = 2.0 * radius + close_m
    close = 0
    for c in range(count):
        i, j = candidates[c, 0], candidates[c, 1]
        if j >= 0:
            dx, dy = pose[i, 0] - pose[j, 0], pose[i, 1] - pose[j, 1]
            if dx * dx + dy * dy > far * far:
                continue
        gap = push(pose, obstacles, scratch, i, j, radius, 1.0)
        if gap < close_m:
            candidates[close, 3] = c
            close += 1
            if gap <= TOUCH_M:
                candidates[c, 2] = 1
    return close


@kernel
def relax(pose: Array, obstacles: Array, scratch: Array, candidates: Ints, close: int, radius: float) -> None:
    """Go on pushing what the first pass pushed into each other, at most `PASSES` times."""
    turn, moved = 1.0, True
    while moved and turn < PASSES:
        turn += 1.0
        moved = False
        for at in range(close):
            # To and fro, so that a push travels along a chain of bodies in either direction.
            c = candidates[close - 1 - at if turn % 2.0 == 0.0 else at, 3]
            i, j = candidates[c, 0], candidates[c, 1]
            if scratch[i, 7] < turn - 1.0 and (j < 0 or scratch[j, 7] < turn - 1.0):
                continue
            if push(pose, obstacles, scratch, i, j, radius, turn) < -SETTLED_M:
                moved = True


@kernel
def book(candidates: Ints, count: int, contacts: Ints, pairs: Ints) -> int:
    """Count the flagged candidates per body and list them; return how many there are."""
    touching = 0
    for c in range(count):
        if candidates[c, 2] != 0:
            i, j = candidates[c, 0], candidates[c, 1]
            pairs[touching, 0], pairs[touching, 1] = i, j
            touching += 1
            contacts[i] += 1
            if j >= 0:
                contacts[j] += 1
    return touching


@kernel
def prepare(pose: Array, twists: Array, scratch: Array, step_s: float) -> float:
    """Fill the scratch columns for substeps of `step_s`; return the highest speed (m/s)."""
    fastest = 0.0
    for i in range(pose.shape[0]):
        half = 0.5 * twists[i, 1] * step_s
        scratch[i, 0], scratch[i, 1] = math.cos(pose[i, 2]), math.sin(pose[i, 2])
        c, s = math.cos(half), math.sin(half)
        scratch[i, 2], scratch[i, 3] = c, s
        # The chord of the arc; near half = 0 the series avoids 0 / 0.
        ratio = s / half if abs(half) > 1e-4 else 1.0 - half * half / 6.0
        scratch[i, 4] = twists[i, 0] * step_s * ratio
        scratch[i, 5], scratch[i, 6] = 0.0, 0.0
        fastest = max(fastest, abs(twists[i, 0]))
    return fastest


@kernel
def move(pose: Array, scratch: Array) -> None:
    """Move every body along its arc by one substep; the heading itself is set at the end of the step."""
    for i in range(pose.shape[0]):
        c, s, half_c, half_s = scratch[i, 0], scratch[i, 1], scratch[i, 2], scratch[i, 3]
        middle_c, middle_s = c * half_c - s * half_s, s * half_c + c * half_s
        scratch[i, 7] = 0.0
        pose[i, 0] += scratch[i, 4] * middle_c
        pose[i, 1] += scratch[i, 4] * middle_s
        scratch[i, 0] = middle_c * half_c - middle_s * half_s
        scratch[i, 1] = middle_s * half_c + middle_c * half_s


@kernel
def advance(
    pose: Array,
    twists: Array,
    measured: Array,
    contacts: Ints,
    pairs: Ints,
    obstacles: Array,
    scratch: Array,
    candidates: Ints,
    grid: Ints,
    state: Array,
    counts: Ints,
    radius: float,
    dt: float,
    substeps: int,
) -> int:
    """Advance all bodies by `dt` seconds in `substeps` parts.

    Returns
    -------
    int
        Rows of `pairs` that are filled; -1 if `candidates` is too small, with nothing changed.
    """
    n = pose.shape[0]
    fastest = prepare(pose, twists, scratch, dt / substeps)
    # A pushed body moves no faster than the one that pushes: twice the free way covers it.
    ahead = 2.0 * fastest * dt + 1e-3
    if 2.0 * (state[0] + ahead) > state[1]:
        skin = max(SKIN_RADII * radius, 2.5 * ahead)
        found = near_obstacles(pose, obstacles, radius + skin, candidates, 0)
        if n > BRUTE_FORCE_BODIES:
            found = near_bodies_grid(pose, 2.0 * radius + skin, candidates, grid, found)
        else:
            found = near_bodies(pose, 2.0 * radius + skin, candidates, found)
        if found > candidates.shape[0]:
            state[1] = -1.0
            return -1
        counts[0] = found
        state[0], state[1] = 0.0, skin
    count = counts[0]
    for c in range(count):
        candidates[c, 2] = 0
    close_m = 4.0 * fastest * dt / substeps + 1e-3
    for _ in range(substeps):
        move(pose, scratch)
        if count > 0:
            close = first_pass(pose, obstacles, scratch, candidates, count, radius, close_m)
            if close > 0:
                relax(pose, obstacles, scratch, candidates, close, radius)
    for i in range(n):
        contacts[i] = 0
    touching = book(candidates, count, contacts, pairs)
    pushed = 0.0
    for i in range(n):
        px, py = scratch[i, 5], scratch[i, 6]
        measured[i, 0] = twists[i, 0] + (px * scratch[i, 0] + py * scratch[i, 1]) / dt
        measured[i, 1] = twists[i, 1]
        heading = pose[i, 2] + twists[i, 1] * dt
        if heading > math.pi or heading < -math.pi:
            heading = math.atan2(math.sin(heading), math.cos(heading))
        pose[i, 2] = heading
        pushed = max(pushed, abs(px) + abs(py))
    state[0] += fastest * dt + pushed
    return touching
