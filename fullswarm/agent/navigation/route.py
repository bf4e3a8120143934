"""Follows a field of ways: the farthest point of the way that a robot can drive to straight, and the next passage."""

from __future__ import annotations

import math
from typing import NamedTuple

from fullswarm.agent.navigation.geometry import gap_to, is_free
from fullswarm.agent.navigation.roadmap import NOWHERE, SPAN_M, Ways
from fullswarm.kernels import Index, kernel

TOLERANCE_M = 0.002
"""By so much a straight way may be narrower than the way itself: a robot is never exactly on it."""
REACHES = (1, 5)
"""How many cells around a robot are searched for the node at which its way begins."""


class Lattice(NamedTuple):
    """The cells of :class:`~fullswarm.agent.navigation.roadmap.Grid` as numbers for kernels, and a field's preference.

    `look_m`: how far ahead along the way a waypoint may lie; `ahead_m`: how far ahead a passage is looked for.
    """

    x_min: float
    y_min: float
    cell_m: float
    columns: int
    rows: int
    preferred_m: float
    look_m: float
    ahead_m: float


@kernel
def entry(x: float, y: float, own_clear_m: float, ways: Ways, lattice: Lattice) -> int:
    """Return the node at which the way from (x, y) begins: by way of it the goal is nearest; -1 where there is none.

    The way to it keeps the clearance that the robot has now. Where no node can be seen so, the nearest one counts.
    """
    x_min, y_min, cell_m, columns, rows, preferred_m, _, _ = lattice
    column = min(max(int(math.floor((x - x_min) / cell_m)), 0), columns - 1)
    row = min(max(int(math.floor((y - y_min) / cell_m)), 0), rows - 1)
    nearest = NOWHERE
    for reach in REACHES:
        refused = -1.0
        nearest_m = math.inf
        for _ in range(8):
            best = NOWHERE
            best_m = math.inf
            for r in range(max(0, row - reach), min(rows, row + reach + 1)):
                cell = r * columns
                low = ways.first[cell + max(0, column - reach)]
                high = ways.first[cell + min(columns - 1, column + reach) + 1]
                for place in range(low, high):
                    node = ways.nodes[place]
                    cost_m = ways.cost_m[node]
                    if not math.isfinite(cost_m):
                        continue
                    away_m = math.hypot(ways.x[node] - x, ways.y[node] - y)
                    total_m = cost_m + away_m
                    if refused < total_m < best_m:
                        best_m = total_m
                        best = node
                    if away_m < nearest_m:
                        nearest_m = away_m
                        nearest = node
            if best == NOWHERE:
                break
            clear_m = min(preferred_m, own_clear_m, ways.clear_m[best]) - TOLERANCE_M
            if is_free(x, y, ways.x[best], ways.y[best], clear_m, ways.obstacles):
                return best
            refused = best_m
        if nearest != NOWHERE:
            return nearest
    return nearest


@kernel
def follow(x: float, y: float, ways: Ways, lattice: Lattice, trail: Index) -> tuple[float, float, int, float]:
    """Return where to drive to straight from (x, y), and the first passage on the way.

    Parameters
    ----------
    trail : (k,) scratch

    Returns
    -------
    tuple
        x, y of the farthest point of the way to which a straight way is as clear as the way itself, m; which passage
        is crossed first within `ahead_m`, as `Ways.gate`, 0 for none; the length of the way, m: infinite, with the
        robot's own place, where none is known.
    """
    own_clear_m = gap_to(x, y, ways.obstacles, SPAN_M)
    node = entry(x, y, own_clear_m, ways, lattice)
    if node == NOWHERE:
        return x, y, 0, math.inf
    begin = node
    total_m = math.hypot(ways.x[node] - x, ways.y[node] - y)
    length_m = total_m + ways.length_m[node]
    gate = 0
    count = 0
    most = trail.shape[0]
    gone_m = total_m
    while count < most:
        trail[count] = node
        count += 1
        following = ways.following[node]
        if following < 0:
            break
        if gate == 0 and gone_m <= lattice.ahead_m and ways.gate[node] != 0:
            gate = ways.gate[node]
        gone_m = total_m + ways.length_m[begin] - ways.length_m[following]
        if gone_m > lattice.look_m + lattice.cell_m and (gate != 0 or gone_m > lattice.ahead_m):
            break
        node = following
    # Steps of doubling length along the way as long as the end is in sight, then halving: few checks find the end.
    limit_m = min(lattice.preferred_m, own_clear_m)
    seen = 0
    seen_clear_m = min(limit_m, ways.clear_m[begin])
    step = 1
    growing = True
    while step > 0:
        there = min(seen + step, count - 1)
        found = False
        if there > seen:
            clear_m = seen_clear_m
            for k in range(seen, there):
                clear_m = min(clear_m, ways.way_clear_m[trail[k]])
            node = trail[there]
            if is_free(x, y, ways.x[node], ways.y[node], clear_m - TOLERANCE_M, ways.obstacles):
                found = True
                seen = there
                seen_clear_m = clear_m
        if found and growing and seen < count - 1:
            step *= 2
        else:
            growing = False
            step //= 2
    node = trail[seen]
    return ways.x[node], ways.y[node], gate, length_m
