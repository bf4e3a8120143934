"""Navigate: to a goal around the obstacles that are known, where a proportional law is caught (paper IV.A, scenario 4).

What is known is up to the request: the map that the robot was given, what it has seen itself, or what the swarm has
seen and shared. The way is a shortest one on a graph whose clearance is exact (``agent/navigation``); the velocity
points at the farthest point of it to which a straight way is as clear as the way itself. Robots that stand in a passage
are led around, and through narrow passages robots drive in turn.
"""

from __future__ import annotations

import math

import numpy as np

from fullswarm.agent.navigation import planner
from fullswarm.agent.navigation.geometry import Bounds
from fullswarm.agent.navigation.right_of_way import EXIT_M, Traffic, give_way
from fullswarm.agent.navigation.roadmap import Clearance, Field
from fullswarm.agent.navigation.route import Lattice, follow
from fullswarm.agent.safety.barrier import box_gap
from fullswarm.agent.view import Params, View
from fullswarm.errors import MissingExtra
from fullswarm.kernels import Array, kernel

LOOK_M = 6.0
PASSAGE_M = 3.0
"""A passage on the way is coordinated from so far before it."""
SLACK_M = 0.12
"""Free space that a way prefers beyond the robot's own radius: the filter keeps a margin, and is slow in it."""
LEAST_SLACK_M = 0.005
"""Free space that a way needs beyond the radius and the filter's margin: with none the filter lets nothing move."""
LANES_M = (SLACK_M, 0.4, 0.8, 1.2)
CROWD_M = 0.7
DETOUR = 1.6
PUSH = 0.5
"""How much a way at an obstacle's edge is bent off it: along the filter's border a robot crawls for ever."""

TIGHT_M_S, TIGHT_PER_S = 0.5, 4.0
"""In a narrow passage a robot desires this speed, and so much more per metre of room that the filter's margin leaves:
the filter allows no more there, and a robot that is far slower than desired counts as blocked."""
LEAST_TURNING = 0.1
"""Where it is narrow a robot turns before it drives: what it drives while it turns leads it off its way. This share of
the desired speed is left, because a robot turns to where it desires to go."""

_trail = np.zeros(256, np.int64)


def velocity(view: View, params: Params) -> Array:
    """Return velocities towards the next waypoints, ``K`` times the way that is left at most, (n, 2) m/s."""
    return drive(view, params, params.goal)


def drive(view: View, params: Params, goals: Array) -> Array:
    """Return velocities towards `goals` (n, 2), (n, 2) m/s; see :func:`velocity`."""
    desired = np.zeros_like(view.position)
    near = view.distance < CROWD_M
    crowd = np.bincount(view.of[near], minlength=len(desired)).tolist()
    traffic = Traffic(view.other, view.predicted, view.states, view.aims)
    start = view.start.tolist()
    view.aim = aim = np.full_like(view.position, math.nan)
    source, goal_of = str(params.map), goals.tolist()
    arrive_of, gain_of = params.arrive_radius_m[:, 0].tolist(), params.gain[:, 0].tolist()
    radius_of, margin_of, heading_of = view.radius.tolist(), view.margin_m.tolist(), view.heading.tolist()
    for row, (x, y) in enumerate(view.position.tolist()):
        goal_x, goal_y = goal_of[row]
        left_m, arrive_m = math.hypot(goal_x - x, goal_y - y), arrive_of[row]
        if not left_m > arrive_m:
            continue
        radius_m, margin_m = radius_of[row], margin_of[row]
        field, known = _lane(view, row, (goal_x, goal_y), source, crowd[row], radius_m, margin_m)
        ways, lattice = field.ways, Lattice(*field.grid, field.preferred_m, LOOK_M, PASSAGE_M)
        to_x, to_y, gate, clear_m, length_m = follow.run(x, y, ways, lattice, _trail)
        if not math.isfinite(length_m):
            least_m = radius_m + margin_m + LEAST_SLACK_M
            view.blocked[row] = planner.no_way(x, y, (goal_x, goal_y), known, view.bounds_m, least_m)
            continue
        if field.short_m > arrive_m:
            view.blocked[row] = planner.goal_closed((goal_x, goal_y), ways.obstacles, radius_m + margin_m)
        ahead_m = math.hypot(to_x - x, to_y - y)
        if ahead_m < 1e-9:
            continue
        speed = gain_of[row] * left_m
        if gate and clear_m < field.preferred_m:
            speed = min(speed, TIGHT_M_S + TIGHT_PER_S * max(clear_m - radius_m - margin_m, 0.0))
        if clear_m < field.preferred_m:
            towards = math.cos(math.atan2(to_y - y, to_x - x) - heading_of[row])
            speed *= max(towards * towards, LEAST_TURNING)
        speed /= ahead_m
        vx, vy = bend.run(x, y, speed * (to_x - x), speed * (to_y - y), radius_m, ways.obstacles)
        aim[row] = to_x, to_y
        if gate:
            aim[row] = _exit(ways.passages, gate)
            vx, vy = give_way.run(
                x, y, vx, vy, radius_m, margin_m, gate, start[row], start[row + 1], ways.passages, traffic
            )
        desired[row] = vx, vy
    return desired


def _exit(passages: Array, gate: int) -> tuple[float, float]:
    """Return the point behind a passage that a robot on its way through aims at."""
    x, y, axis_x, axis_y, half_m, _ = passages[abs(gate) - 1].tolist()
    along = math.copysign(half_m + EXIT_M, gate)
    return x + along * axis_x, y + along * axis_y


@kernel
def bend(x: float, y: float, vx: float, vy: float, radius_m: float, obstacles: Array) -> tuple[float, float]:
    """Turn a velocity off the obstacles that are nearer than the slack, the more the nearer; its size is kept."""
    size = math.hypot(vx, vy)
    bent_x = vx
    bent_y = vy
    close_m = radius_m + SLACK_M
    for row in range(obstacles.shape[0]):
        across = obstacles[row, 2] + obstacles[row, 3] + obstacles[row, 5] + close_m
        if math.fabs(obstacles[row, 0] - x) >= across or math.fabs(obstacles[row, 1] - y) >= across:
            continue
        gap, nx, ny = box_gap(x, y, obstacles, row)
        nearness = min(1.0, 1.0 - (gap - radius_m) / SLACK_M)
        if nearness > 0.0:
            bent_x -= PUSH * nearness * size * nx
            bent_y -= PUSH * nearness * size * ny
    bent = math.hypot(bent_x, bent_y)
    if bent < 1e-9:
        return vx, vy
    return bent_x * size / bent, bent_y * size / bent


def prepare(given: Array, bounds_m: Bounds, radii_m: Array, margin_m: float) -> None:
    """Load SciPy and build the graphs of ways on a given map (k, 6): in a control period there is no time for it.

    Without SciPy nothing is done; a request to navigate then says what is missing.
    """
    for radius_m in dict.fromkeys(radii_m.tolist()):
        try:
            planner.roadmap_of(given, bounds_m, _clearance(radius_m, margin_m))
        except MissingExtra:
            return


def _clearance(radius_m: float, margin_m: float) -> Clearance:
    least_m = radius_m + margin_m + LEAST_SLACK_M
    return Clearance(least_m, max(radius_m + SLACK_M, least_m))


def _lane(
    view: View, row: int, goal: tuple[float, float], source: str, crowd: int, radius_m: float, margin_m: float
) -> tuple[Field, Array]:
    """Return the ways for a robot; in a crowd they keep farther off the obstacles, or all would queue at one corner."""
    clearance = _clearance(radius_m, margin_m)
    least_m = clearance.least_m
    known = _with_standing(view, row, goal, view.known(row, source), clearance)
    shortest = planner.field_of(goal, known, view.bounds_m, clearance)
    if not crowd:
        return shortest, known
    x, y = view.position[row].tolist()
    longest_m = DETOUR * shortest.way_m(x, y) + CROWD_M
    for lane in range(min(crowd, len(LANES_M) - 1), 0, -1):
        wide_m = radius_m + LANES_M[lane]
        if wide_m > least_m and math.isfinite(longest_m):
            field = planner.field_of(goal, known, view.bounds_m, Clearance(wide_m, wide_m))
            if field.short_m <= 0.0 and field.way_m(x, y) <= longest_m:
                return field, known
    return shortest, known


def _with_standing(view: View, row: int, goal: tuple[float, float], known: Array, clearance: Clearance) -> Array:
    """Return what is known and the robots that stand in passages, unless they leave no way or stand at the goal."""
    discs = view.standing(row)
    if not len(discs):
        return known
    discs = planner.in_passages(discs, known, view.bounds_m, clearance)
    if not len(discs):
        return known
    discs = discs[np.hypot(discs[:, 0] - goal[0], discs[:, 1] - goal[1]) > discs[:, 5] + clearance.least_m]
    if not len(discs):
        return known
    around = np.vstack([known, discs])
    x, y = view.position[row].tolist()
    field = planner.field_of(goal, around, view.bounds_m, clearance)
    # Where they close the only way the robot waits before them: they may drive on, or be carried away.
    return around if math.isfinite(field.way_m(x, y)) else known
