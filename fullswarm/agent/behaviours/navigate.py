"""Navigate: to a goal around the obstacles that are known, where a proportional law is caught (paper IV.A, scenario 4).

What is known is up to the request: the map that the robot was given, what it has seen itself, or what the swarm has
seen and shared. The way is a shortest one on a grid (`agent/routes.py`); the wish points at the farthest point of it
that is in sight.
"""

from __future__ import annotations

import math
from collections import OrderedDict

import numpy as np

from fullswarm.agent import routes
from fullswarm.agent.safety.barrier import box_gap
from fullswarm.agent.tasks import Params
from fullswarm.agent.view import View
from fullswarm.kernels import Array, kernel

LOOK_M = 6.0
SLACK_M = 0.12
"""Free space that a way leaves beyond the robot's own radius: the filter keeps a margin, and grids are coarse."""
LANES_M = (SLACK_M, 0.4, 0.8, 1.2)
CROWD_M = 0.7
DETOUR = 1.6
FIELDS = 128
PUSH = 0.5
"""How much a way at an obstacle's edge is bent off it: along the filter's border a robot crawls for ever."""

_fields: OrderedDict[tuple[object, ...], routes.Field] = OrderedDict()


def velocity(view: View, params: Params) -> Array:
    """Return velocities towards the next waypoints, ``K`` times the way that is left at most, (n, 2) m/s."""
    wished = np.zeros_like(view.position)
    near = view.distance < CROWD_M
    crowd = np.bincount(view.of[near], minlength=len(wished)).tolist()
    for row in range(len(wished)):
        x, y = view.position[row].tolist()
        goal_x, goal_y = params.goal[row].tolist()
        left_m = math.hypot(goal_x - x, goal_y - y)
        if left_m <= float(params.arrive_radius_m[row, 0]):
            continue
        field = _lane(view, row, (goal_x, goal_y), str(params.map), crowd[row])
        to_x, to_y = routes.waypoint.run(
            x, y, field.x_min, field.y_min, field.cell_m, field.free, field.next_cell, field.distance_m,
            goal_x, goal_y, LOOK_M,
        )  # fmt: skip
        ahead_m = math.hypot(to_x - x, to_y - y)
        if ahead_m > 1e-9:
            speed = float(params.gain[row, 0]) * left_m / ahead_m
            vx, vy = speed * (to_x - x), speed * (to_y - y)
            wished[row] = bend.run(x, y, vx, vy, float(view.radius[row]), view.known(row, str(params.map)))
    return wished


@kernel
def bend(x: float, y: float, vx: float, vy: float, radius_m: float, obstacles: Array) -> tuple[float, float]:
    """Turn a wish off the obstacles that are nearer than the slack, the more the nearer; its size is kept."""
    size = math.hypot(vx, vy)
    bent_x = vx
    bent_y = vy
    for row in range(obstacles.shape[0]):
        gap, nx, ny = box_gap(x, y, obstacles, row)
        nearness = min(1.0, 1.0 - (gap - radius_m) / SLACK_M)
        if nearness > 0.0:
            bent_x -= PUSH * nearness * size * nx
            bent_y -= PUSH * nearness * size * ny
    bent = math.hypot(bent_x, bent_y)
    if bent < 1e-9:
        return vx, vy
    return bent_x * size / bent, bent_y * size / bent


def _lane(view: View, row: int, goal: tuple[float, float], source: str, crowd: int) -> routes.Field:
    """Return the ways for a robot; in a crowd they keep farther off the obstacles, or all would queue at one corner."""
    known, radius_m = view.known(row, source), float(view.radius[row])
    x, y = view.position[row].tolist()
    shortest = _field(goal, known, view.bounds_m, radius_m + LANES_M[0])
    longest_m = DETOUR * shortest.way_m(x, y) + CROWD_M
    for lane in range(min(crowd, len(LANES_M) - 1), 0, -1):
        field = _field(goal, known, view.bounds_m, radius_m + LANES_M[lane])
        if field.way_m(x, y) <= longest_m < math.inf:
            return field
    return shortest


def _field(
    goal: tuple[float, float], obstacles: Array, bounds_m: tuple[float, float, float, float], clearance_m: float
) -> routes.Field:
    """Return the field for a goal and a state of knowledge; the newest few are kept."""
    key = (goal, bounds_m, clearance_m, obstacles.tobytes())
    field = _fields.get(key)
    if field is None:
        field = _fields[key] = routes.build(goal, obstacles, bounds_m, clearance_m)
        while len(_fields) > FIELDS:
            _fields.popitem(last=False)
    else:
        _fields.move_to_end(key)
    return field
