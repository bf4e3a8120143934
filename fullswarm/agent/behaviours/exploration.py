"""Exploration: robots drive to the border of what has been seen, until all that is reachable has been seen.

Frontiers on a grid of 48 by 48 cells (Yamauchi, A frontier-based approach for autonomous exploration, CIRA 1997): a
cell counts as seen when a robot was within `sight_m` of it, with no known obstacle between. A frontier is a cell that
is seen, free and has an unseen neighbour. Each robot drives to the frontier with the shortest way; those near the
target of a robot before it in the request count as farther away (Burgard, Moors, Stachniss, Schneider, Coordinated
multi-robot exploration, IEEE T-RO 2005). Maps are broadcast in parts and joined, so that repeated and lost broadcasts
make no difference. A robot ends when it knows of no frontier that it can reach. Passages that are narrower than the
robot and two cells may be missed. Motion is that of :mod:`~fullswarm.agent.behaviours.navigate`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from fullswarm.agent.behaviours import navigate
from fullswarm.agent.navigation import geometry
from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array, Flags, Index
from fullswarm.memory import rows

SIDE = 48
"""Cells along each side of the arena; a row of them is one number of a broadcast."""
PARTS = 2
PART = SIDE // PARTS
BITS = 2.0 ** np.arange(SIDE)
PART_S = 0.3
"""A part is broadcast for so long, then the next."""
SPREAD_M = 3.0
"""A frontier so near another robot's target counts as so much farther away."""
LOOK_S, KEEP_S = 1.0, 15.0
"""How often the frontiers are looked at, and for how long a target is kept that is one of them."""
STEPS = [(dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dy, dx) != (0, 0)]


@dataclass
class Memory:
    """What has been seen and where from, knowing how many obstacles; the target, since when, and until when."""

    seen: Flags = rows(SIDE, SIDE, fill=False)
    target_m: Array = rows(2, fill=np.nan)
    chosen_s: Array = rows(fill=-np.inf)
    next_s: Array = rows(fill=-np.inf)
    looked_m: Array = rows(2, fill=np.inf)
    obstacles: Index = rows(fill=0)


@dataclass
class Says:
    """A part of the map: which, and a number with a bit per cell for each row; the target."""

    part: Index = rows(fill=0)
    bits: Array = rows(PART)
    target_m: Array = rows(2)


def velocity(view: View, params: Params, memory: Memory) -> Array:
    """Return the ways to the targets, (n, 2) m/s; zero for a robot that has ended."""
    cell, low = grid(view.bounds_m)
    _join(view, memory)
    heard = view.heard
    for row, here in enumerate(view.position):
        known = view.known(row, str(params.map))
        moved_m = np.abs(here - memory.looked_m[row]).max()
        if moved_m > 0.5 * cell.min() or len(known) != memory.obstacles[row]:
            look(here, cell, low, float(params.sight_m[row, 0]), known, memory.seen[row])
            memory.looked_m[row], memory.obstacles[row] = here, len(known)
        target, now_s = memory.target_m[row], float(view.time_s[row])
        if now_s < memory.next_s[row]:
            continue
        before = (heard.of == row) & (heard.index < view.index[row])
        others = heard.target_m[before]
        clearance_m = float(view.radius[row] + view.margin_m[row]) + navigate.LEAST_SLACK_M
        keep = target if now_s - memory.chosen_s[row] < KEEP_S else np.full(2, np.nan)
        found = choose(here, cell, low, known, clearance_m, memory.seen[row], others, keep)
        memory.next_s[row] = now_s + LOOK_S
        if found is None or not np.array_equal(found, target):
            memory.chosen_s[row] = now_s
            memory.target_m[row] = here if found is None else found
        if found is None and now_s > LOOK_S:
            view.finish([row], "arrived", f"{memory.seen[row].mean():.0%} of the arena seen")
    _say(view, memory)
    to = navigate.drive(view, params, memory.target_m)
    view.blocked.clear()  # a frontier without a way is given up with the next choice
    size = np.linalg.norm(to, axis=1, keepdims=True)
    desired: Array = to / np.maximum(size, 1e-6) * np.minimum(size, params.speed_m_s)
    return desired


def grid(bounds_m: tuple[float, float, float, float]) -> tuple[Array, Array]:
    """Return the size of a cell and the corner of the first one, (2,) m each."""
    low = np.array(bounds_m[:2])
    return (np.array(bounds_m[2:]) - low) / SIDE, low


def _join(view: View, memory: Memory) -> None:
    """Take in the parts of maps that were received."""
    heard = view.heard
    for of, part, bits in zip(heard.of.tolist(), heard.part.tolist(), heard.bits, strict=True):
        cells = (bits[:, None] // BITS) % 2.0 >= 1.0
        first = PART * (int(part) % PARTS)
        memory.seen[of, first : first + PART] |= cells


def _say(view: View, memory: Memory) -> None:
    """Broadcast one part after another."""
    part = np.floor(view.time_s / PART_S).astype(np.int64) % PARTS
    parts = memory.seen.reshape(-1, PARTS, PART, SIDE)[np.arange(len(part)), part]
    view.say(part=part, bits=parts @ BITS, target_m=np.where(np.isnan(memory.target_m), 1e6, memory.target_m))


def look(here: Array, cell: Array, low: Array, sight_m: float, known: Array, seen: Flags) -> None:
    """Mark in `seen` the cells whose middle is within `sight_m` of `here` (2,), with no obstacle (k, 6) between.

    What is inside an obstacle that is known counts as seen.
    """
    y, x = np.nonzero(~seen)
    middle = low + (np.stack([x, y], axis=1) + 0.5) * cell
    near = np.linalg.norm(middle - here, axis=1) <= sight_m
    y, x, middle = y[near], x[near], middle[near]
    visible = geometry.free_ways(np.broadcast_to(here, middle.shape), middle, 0.0, known)
    visible |= geometry.gaps(middle, known, 1.0) <= 0.0
    seen[y[visible], x[visible]] = True


def ways_from(here: Array, cell: Array, low: Array, free: Flags) -> Array:
    """Return the lengths of ways over free cells, of eight neighbours each, inf where there is none, (SIDE, SIDE) m."""
    x, y = np.clip(((here - low) / cell).astype(np.int64), 0, SIDE - 1)
    ways = np.full((SIDE + 2, SIDE + 2), np.inf)
    ways[y + 1, x + 1] = 0.0
    inside, changed = ways[1:-1, 1:-1], True
    while changed:
        best = inside.copy()
        for dy, dx in STEPS:
            there = ways[1 + dy : SIDE + 1 + dy, 1 + dx : SIDE + 1 + dx]
            np.minimum(best, there + math.hypot(dx * cell[0], dy * cell[1]), out=best)
        best[~free] = np.inf
        best[y, x] = 0.0
        changed = bool((best < inside).any())
        inside[:] = best
    return inside.copy()


def choose(
    here: Array, cell: Array, low: Array, known: Array, clearance_m: float, seen: Flags, others: Array, keep: Array
) -> Array | None:
    """Return the frontier with the shortest way, (2,) m, farther near the targets of others; None: there is none.

    The one nearest to `keep` (2,) is taken instead if it is within a cell of it.
    """
    y, x = np.divmod(np.arange(SIDE * SIDE), SIDE)
    middle = low + (np.stack([x, y], axis=1) + 0.5) * cell
    high = low + SIDE * cell
    room_m = np.minimum((middle - low).min(axis=1), (high - middle).min(axis=1))
    room_m = np.minimum(room_m, geometry.gaps(middle, known, 10.0))
    ways = ways_from(here, cell, low, seen & (room_m >= clearance_m).reshape(SIDE, SIDE))
    unseen = np.pad(~seen, 1)
    beside = unseen[:-2, 1:-1] | unseen[2:, 1:-1] | unseen[1:-1, :-2] | unseen[1:-1, 2:]
    frontier = (beside & np.isfinite(ways)).ravel()
    # What is still not seen from beside it is behind a wall.
    for k in np.flatnonzero(frontier & (np.linalg.norm(middle - here, axis=1) < cell.min())).tolist():
        top, left = max(k // SIDE - 1, 0), max(k % SIDE - 1, 0)
        seen[top : k // SIDE + 2, left : k % SIDE + 2] = True
        frontier[k] = False
    if not frontier.any():
        return None
    off_m = np.linalg.norm(middle[frontier] - keep, axis=1)
    if off_m.min() < cell.max():
        kept: Array = middle[frontier][off_m.argmin()]
        return kept
    cost = ways.ravel()[frontier]
    for other in others:
        cost = cost + np.maximum(SPREAD_M - np.linalg.norm(middle[frontier] - other, axis=1), 0.0)
    found: Array = middle[frontier][cost.argmin()]
    return found
