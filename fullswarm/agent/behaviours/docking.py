"""Docking: straight into a dock, or backwards out of it; part of charging, not requested by operators.

Into it a robot follows the line through the dock's pose: it first turns towards a point on the line a little ahead of
it, and drives once it looks there. Out of it it backs along the line until it is `approach_m` before the dock; a robot
that cannot drive backwards turns round first. The twist passes the safety filter like any other.
"""

from __future__ import annotations

import math

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.geometry import wrap
from fullswarm.kernels import Array

AHEAD_M = 0.2
"""The point of the line that a robot steers to lies so far ahead."""
TURN_PER_S, MOST_TURN_RAD_S = 2.0, 1.0
DRIVE_RAD = 0.15
"""A robot that is off its direction by more turns in place."""
SLOW_PER_S = 1.0
"""Speed per metre that is left."""
LEAST_M_S = 0.02
IN, OUT, OUT_FORWARDS = 0.0, 1.0, 2.0
"""Values of the parameter `way`."""


def twist(view: View, params: Params) -> Array:
    """Return twists into the dock at `place` and `heading_rad` or out of it, (n, 2) m/s and rad/s."""
    found = np.zeros((len(view.position), 2))
    for row, (x, y) in enumerate(view.position.tolist()):
        to_x, to_y = params.place[row].tolist()
        heading, way = float(params.dock_rad[row, 0]), float(params.way[row, 0])
        c, s = math.cos(heading), math.sin(heading)
        along, across = (x - to_x) * c + (y - to_y) * s, (y - to_y) * c - (x - to_x) * s
        left_m = -along if way == IN else float(params.approach_m[row, 0]) + along
        speed = min(float(params.speed_m_s[row, 0]), max(SLOW_PER_S * left_m, LEAST_M_S)) if left_m > 0.0 else 0.0
        # Backing out a robot steers by the point behind it, so that it keeps the line, too.
        aim = {IN: -across, OUT: across, OUT_FORWARDS: across}[way]
        looks = heading + math.atan2(aim, AHEAD_M) + (math.pi if way == OUT_FORWARDS else 0.0)
        off = wrap(looks - float(view.heading[row]))
        turn = max(-MOST_TURN_RAD_S, min(MOST_TURN_RAD_S, TURN_PER_S * off))
        if abs(off) > DRIVE_RAD and not (way == OUT and left_m > 0.8 * float(params.approach_m[row, 0])):
            speed = 0.0
        found[row] = (-speed if way == OUT else speed), turn
    return found
