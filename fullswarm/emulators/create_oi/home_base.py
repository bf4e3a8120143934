"""The Home Base of an emulated Create: where it is, whether the robot stands on it, and how the robot drives into it.

A real robot follows two infrared beams of its Home Base, the red and the green buoy, along the line between them
(Create 2 Open Interface, packets 17, 52 and 53). Here it follows that line from where the beams would be seen, and
where they are not it turns in place, as one that looks for them does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from fullswarm.drivers.base import Pose
from fullswarm.geometry import wrap
from fullswarm.simulation.bodies import BodyState

REACH_M = 2.0
"""How far the beams reach; indoors they do so by half a room."""
BEAM_RAD = math.radians(50.0)
"""Half the angle of the beams."""
CONTACT_M, ALIGNED_RAD = 0.03, 0.2
AHEAD_M = 0.15
SPEED_M_S, SEARCH_RAD_S = 0.1, 0.8


def on_base(state: BodyState, bases: Sequence[Pose]) -> bool:
    """Tell whether a body stands on one of the Home Bases; each is the pose of a robot that does."""
    return any(
        math.hypot(state.x_m - base.x_m, state.y_m - base.y_m) <= CONTACT_M
        and abs(wrap(state.heading_rad - base.heading_rad)) <= ALIGNED_RAD
        for base in bases
    )


def seek(state: BodyState, bases: Sequence[Pose]) -> tuple[float, float]:
    """Return how a robot drives that looks for its base: m/s and rad/s."""
    for base in sorted(bases, key=lambda each: math.hypot(state.x_m - each.x_m, state.y_m - each.y_m)):
        c, s = math.cos(base.heading_rad), math.sin(base.heading_rad)
        dx, dy = state.x_m - base.x_m, state.y_m - base.y_m
        along, across = dx * c + dy * s, dy * c - dx * s
        if math.hypot(dx, dy) > REACH_M or abs(wrap(math.atan2(across, -along))) > BEAM_RAD:
            continue
        off = wrap(base.heading_rad + math.atan2(-across, AHEAD_M) - state.heading_rad)
        turn = max(-1.0, min(1.0, 2.0 * off))
        return (SPEED_M_S if abs(off) < 0.3 else 0.0), turn
    return 0.0, SEARCH_RAD_S
