"""Moves robots out of the way of objects: people, carts, whatever moves and does not keep its half of a gap.

The safety filter alone lets a robot stop in front of an object that comes towards it. Where there is room, it should
rather step aside. If the desired velocity leads too near to a moving object within `HORIZON_S`, it is replaced by the
one of some candidates (directions all around, two speeds, slower ones, standing) that costs the least: far from what
was desired, a long turn, an early or deep conflict, a wall (velocity obstacles: Fiorini, Shiller, *Motion planning in
dynamic environments using velocity obstacles*, 1998, with sampled velocities and the turn that a unicycle needs first).
Only the desired velocity changes; the filter has the last word.
"""

from __future__ import annotations

import math

import numpy as np

from fullswarm.agent.neighbours.objects import Objects
from fullswarm.agent.safety.barrier import Arena, box_gap
from fullswarm.geometry import wrap
from fullswarm.kernels import Array, Flags, kernel

HORIZON_S = 4.0
MOVING_M_S = 0.15
"""A slower object is one that stands; the filter slides along it."""
SPARE_M = 0.2
"""Gap that evasion keeps beyond the filter's margin."""
DIRECTIONS = 16
AHEAD_S = 1.0
"""How far ahead a candidate must be free of walls and boxes, at its speed."""
KEEP = 0.3
"""How much cheaper the direction of the last tick is: two that cost the same must not alternate."""
CONFLICT, TURN, BARRED = 6.0, 0.25, 4.0
"""Costs of a conflict at once (one at the horizon costs none), of a half turn, and of a wall; the greatest possible
change of the desired velocity costs 2."""


@kernel
def conflict(x: float, y: float, ux: float, uy: float, turning_s: float, clearance_m: float, objects: Objects) -> float:
    """Return how soon and how deep a velocity leads into a moving object: 0 not within the horizon, 1 and more at once.

    The robot moves with (ux, uy) after `turning_s`; `clearance_m`: its radius and the gap to keep.
    """
    rows = objects.rows
    worst = 0.0
    for k in range(objects.used[0]):
        vx = rows[k, 2]
        vy = rows[k, 3]
        if vx * vx + vy * vy < MOVING_M_S * MOVING_M_S:
            continue
        keep_m = clearance_m + rows[k, 4]
        for phase in range(2):
            # First it stands and turns, then it moves.
            start_s = 0.0 if phase == 0 else turning_s
            end_s = turning_s if phase == 0 else HORIZON_S
            if end_s <= start_s:
                continue
            dx = rows[k, 0] + vx * start_s - x
            dy = rows[k, 1] + vy * start_s - y
            rx = vx - (ux if phase == 1 else 0.0)
            ry = vy - (uy if phase == 1 else 0.0)
            square = rx * rx + ry * ry
            at_s = min(max(-(dx * rx + dy * ry) / square, 0.0), end_s - start_s) if square > 1e-12 else 0.0
            nearest = math.hypot(dx + at_s * rx, dy + at_s * ry)
            if nearest < keep_m:
                soon = 1.0 - (start_s + at_s) / HORIZON_S
                worst = max(worst, soon * (0.3 + (keep_m - nearest) / keep_m))
    return worst


@kernel
def barred(x: float, y: float, clearance_m: float, arena: Arena) -> bool:
    """Tell whether a disc at (x, y) would overlap a box or the edge of the arena."""
    obstacles, bounds_m = arena
    if min(x - bounds_m[0], y - bounds_m[1], bounds_m[2] - x, bounds_m[3] - y) < clearance_m:
        return True
    for row in range(obstacles.shape[0]):
        across = math.hypot(obstacles[row, 2], obstacles[row, 3]) + obstacles[row, 5] + clearance_m
        if math.fabs(obstacles[row, 0] - x) > across or math.fabs(obstacles[row, 1] - y) > across:
            continue
        if box_gap(x, y, obstacles, row)[0] < clearance_m:
            return True
    return False


@kernel
def evade(
    desired: Array, filtered: Flags, pose: Array, clearance: Array, speed_limit: Array, turn_limit: Array,
    objects: Objects, arena: Arena, chosen: Array,
) -> None:  # fmt: skip
    """Replace desired velocities (n, 2) that lead into a moving object.

    Parameters
    ----------
    clearance : (n,) radius and margin
    chosen : (n, 2) in and out: the velocity that replaces the desired one, zero while none does
    """
    for i in range(desired.shape[0]):
        ux = desired[i, 0]
        uy = desired[i, 1]
        x = pose[i, 0]
        y = pose[i, 1]
        heading = pose[i, 2]
        if not filtered[i] or not math.isfinite(ux + uy + x + y + heading):
            chosen[i, 0] = 0.0
            chosen[i, 1] = 0.0
            continue
        top = speed_limit[i]
        size = math.hypot(ux, uy)
        if size > top:
            ux *= top / size
            uy *= top / size
            size = top
        keep_m = clearance[i] + SPARE_M
        if conflict(x, y, ux, uy, 0.0, keep_m, objects) <= 0.0:
            chosen[i, 0] = 0.0
            chosen[i, 1] = 0.0
            continue
        before = math.hypot(chosen[i, 0], chosen[i, 1])
        best = math.inf
        best_x = 0.0
        best_y = 0.0
        for at in range(2 * DIRECTIONS + 4):
            if at < 2 * DIRECTIONS:
                angle = 2.0 * math.pi * (at // 2) / DIRECTIONS
                speed = top if at % 2 == 0 else 0.5 * top
                cx = speed * math.cos(angle)
                cy = speed * math.sin(angle)
            else:
                speed = size * (at - 2 * DIRECTIONS) / 3.0
                cx = ux * (at - 2 * DIRECTIONS) / 3.0
                cy = uy * (at - 2 * DIRECTIONS) / 3.0
            turn = math.fabs(wrap(math.atan2(cy, cx) - heading)) if speed > 0.0 else 0.0
            turning_s = min(turn / turn_limit[i], HORIZON_S)
            cost = math.hypot(cx - ux, cy - uy) / top + TURN * turn / math.pi
            cost += CONFLICT * conflict(x, y, cx, cy, turning_s, keep_m, objects)
            if speed > 0.0 and barred(x + AHEAD_S * cx, y + AHEAD_S * cy, clearance[i], arena):
                cost += BARRED
            if before > 0.0 and speed > 0.0:
                cost -= KEEP * (cx * chosen[i, 0] + cy * chosen[i, 1]) / (before * speed)
            if cost < best:
                best = cost
                best_x = cx
                best_y = cy
        desired[i, 0] = best_x
        desired[i, 1] = best_y
        chosen[i, 0] = best_x
        chosen[i, 1] = best_y


class Evasion:
    """Keeps what `evade` needs from tick to tick, for n robots.

    Attributes
    ----------
    chosen : (n, 2) m/s, the velocities that replaced the desired ones in the last tick; zero: none did
    """

    def __init__(self, objects: Objects, clearance_m: Array, speed_limit: Array, turn_limit: Array) -> None:
        self.objects = objects
        self._clearance_m, self._speed_limit, self._turn_limit = clearance_m, speed_limit, turn_limit
        self.chosen = np.zeros((len(clearance_m), 2))

    def apply(self, desired: Array, filtered: Flags, pose: Array, obstacles: Array, bounds_m: Array) -> None:
        """Replace the desired velocities (n, 2) of robots that should step aside."""
        if not self.objects.used[0]:
            return
        arena = Arena(obstacles, bounds_m)
        evade.run(
            desired, filtered, pose, self._clearance_m, self._speed_limit, self._turn_limit, self.objects, arena,
            self.chosen,
        )  # fmt: skip
