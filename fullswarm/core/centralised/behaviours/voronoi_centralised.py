"""Coverage of the whole arena (III.A.5): Lloyd's law on exact cells, each robot to the centroid of its own.

The cells are bounded exactly by mirroring the robots at the four walls: the wall is then the border between a robot
and its mirror image.
"""

from __future__ import annotations

import numpy as np

from fullswarm.core.centralised import need
from fullswarm.core.centralised.view import View
from fullswarm.kernels import Array
from fullswarm.parameters import Params

APART_M = 1e-4
"""Robots on the same spot (or on a wall) are taken to be this far apart, or one of them would have no cell."""


def velocity(view: View, params: Params) -> Array:
    """Return ``K (C_i - p_i)``, (n, 2) m/s."""
    corners = np.asarray(params.bounds, float).reshape(-1, 2)
    low, high = corners.min(axis=0), corners.max(axis=0)
    pull: Array = params.gain * (centroids(view.position, low, high) - view.position)
    return pull


def centroids(positions: Array, low: Array, high: Array) -> Array:
    """Return the centroids (n, 2) of the cells of `positions` (n, 2) within the box from `low` to `high`, in m."""
    spatial, shapely = need("scipy.spatial"), need("shapely")
    count = len(positions)
    inside = np.clip(_apart(positions), low + APART_M, high - APART_M)
    mirrored = [inside]
    for axis in (0, 1):
        for wall in (low[axis], high[axis]):
            image = inside.copy()
            image[:, axis] = 2.0 * wall - image[:, axis]
            mirrored.append(image)
    diagram = spatial.Voronoi(np.concatenate(mirrored))
    result = np.empty((count, 2))
    for robot in range(count):
        corners = [corner for corner in diagram.regions[diagram.point_region[robot]] if corner >= 0]
        cell = shapely.MultiPoint(diagram.vertices[corners]).convex_hull
        result[robot] = cell.centroid.x, cell.centroid.y
    return result


def _apart(positions: Array) -> Array:
    """Move robots that share a spot a little, each in its own direction, the same way every time."""
    spots = np.round(positions / APART_M)
    _, first = np.unique(spots, axis=0, return_index=True)
    if len(first) == len(positions):
        return positions
    doubles = np.setdiff1d(np.arange(len(positions)), first)
    moved = positions.copy()
    angles = 2.399963 * (doubles + 1.0)  # the golden angle: no two directions agree
    reach = 10.0 * APART_M * (doubles + 1.0)
    moved[doubles] += reach[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return moved
