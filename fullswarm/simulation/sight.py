"""What a robot sees of other bodies: those within range of which some part is in its line of sight.

A body hides behind boxes, walls and other bodies. It is seen if one of `RAYS` lines from the robot's centre to points
across its width is free; so what is seen of a place is what a scanner at the robot's centre would report.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fullswarm.kernels import Array, kernel

RAYS = 9
ACROSS = 0.95
"""The outermost rays pass the centre at this share of the radius."""


@kernel
def line_meets_box(x: float, y: float, to_x: float, to_y: float, obstacles: Array, k: int) -> bool:
    """Tell whether the line between two points meets obstacle `k`, a row of ``with_trigonometry``."""
    c, s = obstacles[k, 4], obstacles[k, 5]
    dx, dy = x - obstacles[k, 0], y - obstacles[k, 1]
    along_x, along_y = c * (to_x - x) + s * (to_y - y), c * (to_y - y) - s * (to_x - x)
    local_x, local_y = c * dx + s * dy, c * dy - s * dx
    half_x, half_y = obstacles[k, 2] + obstacles[k, 6], obstacles[k, 3] + obstacles[k, 6]
    low, high = 0.0, 1.0
    for axis in range(2):
        at, way, half = (local_x, along_x, half_x) if axis == 0 else (local_y, along_y, half_y)
        if math.fabs(way) < 1e-12:
            if math.fabs(at) > half:
                return False
            continue
        first, last = (-half - at) / way, (half - at) / way
        low, high = max(low, min(first, last)), min(high, max(first, last))
        if low > high:
            return False
    return True


@kernel
def line_meets_disc(x: float, y: float, to_x: float, to_y: float, disc_x: float, disc_y: float, radius: float) -> bool:
    """Tell whether the line between two points comes nearer than `radius` to a disc's centre."""
    along_x, along_y = to_x - x, to_y - y
    dx, dy = disc_x - x, disc_y - y
    length = along_x * along_x + along_y * along_y
    part = min(1.0, max(0.0, (dx * along_x + dy * along_y) / length)) if length > 0.0 else 0.0
    off_x, off_y = dx - part * along_x, dy - part * along_y
    return off_x * off_x + off_y * off_y < radius * radius


@kernel
def look(
    x: float, y: float, own: int, bodies: Array, obstacles: Array, boxes: int, range_m: float, seen: NDArray[np.bool_]
) -> int:
    """Mark in `seen` (b,) which bodies (b, 3: x, y, radius) are seen from (x, y); return how many.

    Parameters
    ----------
    own : row of the body that looks, which is not seen and hides nothing; -1: none of them
    obstacles, boxes : (k, 8) rows of ``with_trigonometry``, of which the first `boxes` hide what is behind them
    """
    count = 0
    for j in range(bodies.shape[0]):
        seen[j] = False
        dx, dy, radius = bodies[j, 0] - x, bodies[j, 1] - y, bodies[j, 2]
        distance = math.sqrt(dx * dx + dy * dy)
        if j == own or distance - radius > range_m:
            continue
        if distance <= radius:
            seen[j] = True
            count += 1
            continue
        side_x, side_y = -dy / distance, dx / distance
        for ray in range(RAYS):
            # The middle first: it mostly is free.
            step = (ray + 1) // 2 * (1.0 if ray % 2 == 0 else -1.0)
            off = ACROSS * radius * step / ((RAYS - 1) // 2)
            to_x, to_y = bodies[j, 0] + off * side_x, bodies[j, 1] + off * side_y
            free = True
            for b in range(bodies.shape[0]):
                if b in (j, own):
                    continue
                if line_meets_disc(x, y, to_x, to_y, bodies[b, 0], bodies[b, 1], bodies[b, 2]):
                    free = False
                    break
            if free:
                for k in range(boxes):
                    if line_meets_box(x, y, to_x, to_y, obstacles, k):
                        free = False
                        break
            if free:
                seen[j] = True
                count += 1
                break
    return count
