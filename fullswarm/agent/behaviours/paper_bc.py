"""Move to goal behind the paper's own filter: the certificate for holonomic robots, mapped to a unicycle (III.A).

For comparison with the safety filter of this package (Figures 4 and 5 of the paper), on simulated robots only: a
unicycle cannot carry out what the certificate asks for, and robots collide. The half-planes are those of
:mod:`fullswarm.agent.safety.barrier`, ``n·u <= γ g / 2`` for a neighbour and ``n·u <= γ g`` for an obstacle or an edge;
the velocity nearest to the desired one within them is mapped to speed and turn rate, and nothing is checked afterwards:
neither which way the robot faces nor what its brakes can do.
"""

from __future__ import annotations

import math

import numpy as np

from fullswarm.agent.behaviours.move_to_goal import velocity as move_to_goal
from fullswarm.agent.safety.barrier import MAX_ROWS, HalfPlanes, box_gap, project
from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array, kernel

SIMULATED_ONLY = True
"""Robots that are not simulated refuse it (``Tasks.enable``)."""


def velocity(view: View, params: Params) -> Array:
    """Return the velocity nearest to that of ``move_to_goal`` within the certificate, (n, 2) m/s."""
    desired = move_to_goal(view, params)
    bounds, others = np.array(view.bounds_m), view.neighbour_radius
    planes = HalfPlanes(*np.empty((len(HalfPlanes._fields), MAX_ROWS)))
    for i, (x, y) in enumerate(view.position.tolist()):
        first, last = int(view.start[i]), int(view.start[i + 1])
        clearance_m = float(view.radius[i] + params.safety_margin_m[i, 0])
        gain = float(params.barrier_gain_per_s[i, 0])
        count = certify.run(
            x, y, clearance_m, gain, first, last, view.offset, view.distance, others, view.known(i, "own"), bounds,
            planes,
        )  # fmt: skip
        scale = min(1.0, view.speed_limit[i] / max(math.hypot(*desired[i]), 1e-9))
        desired[i] = project.run(scale * float(desired[i, 0]), scale * float(desired[i, 1]), planes, count)
    return desired


@kernel
def certify(
    x: float, y: float, clearance_m: float, gain: float, first: int, last: int, offset: Array, distance: Array,
    other_radius: Array, obstacles: Array, bounds_m: Array, planes: HalfPlanes,
) -> int:  # fmt: skip
    """Fill `planes` with the certificate of the robot at (x, y); return how many half-planes it has.

    Parameters
    ----------
    clearance_m : radius plus margin
    first, last : its pairs in `offset` (e, 2), `distance` (e,) and `other_radius` (e,)
    """
    normal_x, normal_y, limit = planes.normal_x, planes.normal_y, planes.limit
    count = 0
    for pair in range(first, last):
        apart = distance[pair]
        if count < normal_x.shape[0] and apart > 1e-9:
            normal_x[count] = offset[pair, 0] / apart
            normal_y[count] = offset[pair, 1] / apart
            limit[count] = max(0.0, 0.5 * gain * (apart - clearance_m - other_radius[pair]))
            count += 1
    for row in range(obstacles.shape[0]):
        gap, nx, ny = box_gap(x, y, obstacles, row)
        if count < normal_x.shape[0]:
            normal_x[count] = nx
            normal_y[count] = ny
            limit[count] = max(0.0, gain * (gap - clearance_m))
            count += 1
    for side in range(4):
        sign = -1.0 if side < 2 else 1.0
        to_edge = sign * (bounds_m[side] - (x if side % 2 == 0 else y))
        if count < normal_x.shape[0]:
            normal_x[count] = sign if side % 2 == 0 else 0.0
            normal_y[count] = 0.0 if side % 2 == 0 else sign
            limit[count] = max(0.0, gain * (to_edge - clearance_m))
            count += 1
    return count
