"""Pursuit and evasion: the first robots of the request flee, the others catch them.

A pursuer drives to the middle of the border that its Voronoi cell has in common with that of the nearest evader, or at
the evader itself if they have none: the evader's cell then never grows, and pursuers that are at least as fast catch it
in finite time in a bounded convex arena (Zhou, Zhang, Ding, Huang, Stipanović, Tomlin, Cooperative pursuit with Voronoi
partitions, Automatica 2016). An evader drives to the middle of its cell. It is caught, and ends, when a pursuer is
within `capture_m`; the pursuers end when no evader is left.
"""

from __future__ import annotations

import math

import numpy as np

from fullswarm.agent.behaviours import voronoi_coverage
from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array, Flags

READY_S = 2.0
"""By then the robots of a request know of one another."""
AT_M = 0.05


def velocity(view: View, params: Params) -> Array:
    """Return full speed to the border, to the evader or to the middle of the cell, (n, 2) m/s."""
    evades = view.index < params.evaders[:, 0]
    other_evades = view.neighbour_index < params.evaders[view.of, 0]
    rivals = np.where(evades[view.of], ~other_evades, other_evades)
    to = np.zeros_like(view.position)
    for row in range(len(to)):
        pairs = slice(int(view.start[row]), int(view.start[row + 1]))
        offset, is_rival = view.offset[pairs], rivals[pairs]
        if evades[row]:
            to[row] = flee(view.position[row], offset[is_rival], view.bounds_m)
        elif is_rival.any():
            to[row] = chase(view.position[row], offset, is_rival, view.bounds_m)
    _end(view, params, evades, rivals)
    speed = np.where(evades[:, None], params.evader_m_s, params.speed_m_s)
    desired: Array = speed * to / np.maximum(np.linalg.norm(to, axis=1, keepdims=True), AT_M)
    return desired


def _end(view: View, params: Params, evades: Flags, rivals: Flags) -> None:
    """End the evaders that are caught, and pursuers without evaders."""
    nearest_m = np.full(len(evades), np.inf)
    np.minimum.at(nearest_m, view.of[rivals], view.distance[rivals])
    caught = evades & (nearest_m <= params.capture_m[:, 0])
    for row in np.flatnonzero(caught).tolist():
        pairs = np.flatnonzero(rivals & (view.of == row))
        by = view.neighbour_id[pairs[view.distance[pairs].argmin()]]
        view.finish([row], "arrived", f"caught by {by} after {view.time_s[row]:.1f} s")
    view.finish(~evades & np.isinf(nearest_m) & (view.time_s > READY_S), "arrived", "all evaders are caught")


def flee(here: Array, pursuers: Array, bounds_m: tuple[float, float, float, float]) -> Array:
    """Return the way to the centroid of the evader's cell, (2,) m; `pursuers` (k, 2) are offsets."""
    centroid = np.empty((1, 2))
    start, reach_m = np.array([0, len(pursuers)]), np.full(1, 1e3)
    voronoi_coverage.centroids(here[None], start, np.ascontiguousarray(pursuers), np.array(bounds_m), reach_m, centroid)
    way: Array = centroid[0] - here
    return way


def chase(here: Array, offset: Array, is_evader: Flags, bounds_m: tuple[float, float, float, float]) -> Array:
    """Return the way of a pursuer to the middle of the border with the nearest evader, or to the evader, (2,) m."""
    evaders = offset[is_evader]
    evader: Array = evaders[np.linalg.norm(evaders, axis=1).argmin()]
    middle, apart_m = 0.5 * evader, float(np.linalg.norm(evader))
    if apart_m < 1e-9:
        return evader
    along = np.array([-evader[1], evader[0]]) / apart_m
    # The border is the part of the bisector that no other pursuer is nearer to, and that is inside the arena.
    low, high = -math.inf, math.inf
    others = offset[~is_evader]
    normals = np.vstack([others - 0.0, [[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]]])
    x_min, y_min, x_max, y_max = bounds_m
    walls = np.array([x_max - here[0], here[0] - x_min, y_max - here[1], here[1] - y_min])
    limits = np.concatenate([0.5 * (others**2).sum(axis=1), walls])
    for normal, limit in zip(normals, limits, strict=True):
        slope, room = float(normal @ along), float(limit - normal @ middle)
        if abs(slope) < 1e-12:
            if room < 0.0:
                return evader
        elif slope > 0.0:
            high = min(high, room / slope)
        else:
            low = max(low, room / slope)
    found: Array = middle + 0.5 * (low + high) * along if low < high else evader
    return found
