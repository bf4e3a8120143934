"""Voronoi static coverage: Lloyd's law on exact bounded cells (paper III.A.5).

Each robot moves to the centroid C_i of the part of the arena that is nearer to it than to any neighbour it senses:
``ṗ = K (C_i - p_i)``. The paper prints ``-K (C_i - p_i)``, which would drive away from the centroid. The cell is the
arena clipped by one half-plane per neighbour: exact for the neighbours received. A robot further away than `hearing_m`
is not received, so the cell is also held within a square of that half-width.
"""

from __future__ import annotations

import math

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array, Index, kernel

MAX_CORNERS = 64


def velocity(view: View, params: Params) -> Array:
    """Return ``K (C_i - p_i)``, (n, 2) m/s."""
    centroid = np.empty_like(view.position)
    reach_m = np.ascontiguousarray(params.hearing_m[:, 0])
    centroids(view.position, view.start, view.offset, np.array(view.bounds_m), reach_m, centroid)
    return params.gain * (centroid - view.position)


@kernel
def clip(corners: Array, count: int, nx: float, ny: float, limit: float, result: Array) -> int:
    """Clip a convex polygon (count, 2) to the half-plane ``n·p <= limit`` (Sutherland-Hodgman).

    Returns
    -------
    int
        How many corners `result` holds; 0 when nothing is left.
    """
    kept = 0
    for k in range(count):
        x = corners[k, 0]
        y = corners[k, 1]
        following = k + 1 if k + 1 < count else 0
        next_x = corners[following, 0]
        next_y = corners[following, 1]
        here = nx * x + ny * y - limit
        there = nx * next_x + ny * next_y - limit
        if here <= 0.0:
            result[kept, 0] = x
            result[kept, 1] = y
            kept += 1
        if (here < 0.0 and there > 0.0) or (here > 0.0 and there < 0.0):
            share = here / (here - there)
            result[kept, 0] = x + share * (next_x - x)
            result[kept, 1] = y + share * (next_y - y)
            kept += 1
        if kept >= result.shape[0] - 2:
            break
    return kept


@kernel
def centroids(position: Array, start: Index, offset: Array, bounds_m: Array, reach_m: Array, centroid: Array) -> None:
    """Compute the centroid of each robot's bounded Voronoi cell, in coordinates relative to the robot.

    Parameters
    ----------
    position : (n, 2) m
    start, offset : pairs of the view
    bounds_m : (4,) the arena
    reach_m : (n,) half-width of the square beyond which a robot does not look
    centroid : (n, 2) m, out; a cell of no area gives the robot's own position
    """
    corners = np.empty((MAX_CORNERS, 2))
    clipped = np.empty((MAX_CORNERS, 2))
    for i in range(position.shape[0]):
        x = position[i, 0]
        y = position[i, 1]
        low_x = max(bounds_m[0] - x, -reach_m[i])
        low_y = max(bounds_m[1] - y, -reach_m[i])
        high_x = min(bounds_m[2] - x, reach_m[i])
        high_y = min(bounds_m[3] - y, reach_m[i])
        corners[0, 0] = low_x
        corners[0, 1] = low_y
        corners[1, 0] = high_x
        corners[1, 1] = low_y
        corners[2, 0] = high_x
        corners[2, 1] = high_y
        corners[3, 0] = low_x
        corners[3, 1] = high_y
        count = 4
        for pair in range(start[i], start[i + 1]):
            nx = offset[pair, 0]
            ny = offset[pair, 1]
            count = clip(corners, count, nx, ny, 0.5 * (nx * nx + ny * ny), clipped)
            for k in range(count):
                corners[k, 0] = clipped[k, 0]
                corners[k, 1] = clipped[k, 1]
        area = 0.0
        moment_x = 0.0
        moment_y = 0.0
        for k in range(count):
            following = k + 1 if k + 1 < count else 0
            cross = corners[k, 0] * corners[following, 1] - corners[following, 0] * corners[k, 1]
            area += cross
            moment_x += (corners[k, 0] + corners[following, 0]) * cross
            moment_y += (corners[k, 1] + corners[following, 1]) * cross
        if count < 3 or math.fabs(area) < 1e-9:
            centroid[i, 0] = x
            centroid[i, 1] = y
        else:
            centroid[i, 0] = x + moment_x / (3.0 * area)
            centroid[i, 1] = y + moment_y / (3.0 * area)
