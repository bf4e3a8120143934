"""The centralised control laws: functions over all robots of a request, by name in :data:`CENTRALISED`.

``law(positions, headings, params, memory, rows) -> (n, 2)`` desired planar velocities in m/s, for the n robots
whose state is fresh: `positions` (n, 2) m, `headings` (n,) rad, `rows` (n,) their places in the request's list of
robots, `params` the request's parameters. A law does no I/O and reads no clock; what it must keep from tick to tick
of one request lies in `memory`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from fullswarm.core.centralised import need
from fullswarm.kernels import Array, Index
from fullswarm.messages import Value

Params = Mapping[str, Value]
Memory = dict[str, Array]
Law = Callable[[Array, Array, Params, Memory, Index], Array]

CLEARLY = 0.9
"""The new sum of squares must be below this share of the present one."""

APART_M = 1e-4
"""Robots on the same spot (or on a wall) are taken to be this far apart, or one of them would have no cell."""


def number(params: Params, name: str, usual: float = 0.0) -> float:
    """Return a parameter that is a number; `usual` when it is not given."""
    value = params.get(name, usual)
    return float(value) if isinstance(value, int | float) else usual


def formation_assigned(positions: Array, headings: Array, params: Params, memory: Memory, rows: Index) -> Array:
    """Drive a formation with the best assignment: which robot takes which target is decided for all at once (III.A.4).

    The Hungarian method on squared distances: the sum is least, and straight paths of such an assignment do not cross.
    A new assignment replaces the present one only when it is clearly better, so that noise changes no assignment.

    Returns
    -------
    Array
        ``K (E_a(i) - p_i)``, (n, 2) m/s; `memory["target"]` keeps the target index of each row (or -1).
    """
    del headings
    targets = np.asarray(params["targets"], float).reshape(-1, 2)
    kept = memory.get("target")
    if kept is None or len(kept) <= rows.max(initial=-1):
        kept = memory["target"] = np.full(max(len(targets), rows.max(initial=-1) + 1), -1.0)
    chosen = assign(positions, targets, kept[rows].astype(np.int64))
    kept[:] = -1.0
    kept[rows] = chosen
    return number(params, "gain") * (targets[chosen] - positions)


def assign(positions: Array, targets: Array, kept: Index) -> Index:
    """Return a target index per robot.

    Parameters
    ----------
    positions : (n, 2) m
    targets : (m, 2) m, m >= n
    kept : (n,) present targets; -1: none
    """
    cost = ((positions[:, None, :] - targets[None, :, :]) ** 2).sum(axis=2)
    optimize = need("scipy.optimize")
    row, column = optimize.linear_sum_assignment(cost)
    best = np.empty(len(positions), np.int64)
    best[row] = column
    valid = bool((kept >= 0).all()) and bool((kept < len(targets)).all()) and len(set(kept.tolist())) == len(kept)
    everyone = np.arange(len(positions))
    if valid and cost[everyone, best].sum() >= CLEARLY * cost[everyone, kept].sum():
        return kept
    return best


def teleop_centroid(positions: Array, headings: Array, params: Params, memory: Memory, rows: Index) -> Array:
    """Drive the swarm's centroid by a stick: all move alike, each keeps its place around the centroid.

    Returns
    -------
    Array
        The stick's velocity plus ``K (offset_i - (p_i - centroid))``, (n, 2) m/s; `memory["offset"]` keeps the places
        (one row per robot of the request, NaN: not seen yet) from the first tick.
    """
    del headings
    size = int(rows.max(initial=-1)) + 1
    offset = memory.get("offset")
    if offset is None or len(offset) < size:
        grown = np.full((size, 2), np.nan)
        if offset is not None:
            grown[: len(offset)] = offset
        offset = memory["offset"] = grown
    around = positions - positions.mean(axis=0)
    new = np.isnan(offset[rows, 0])
    offset[rows[new]] = around[new]
    place = offset[rows] - offset[rows].mean(axis=0)  # robots may have dropped out since
    stick = np.array([number(params, "vx"), number(params, "vy")]) * number(params, "speed_m_s", 0.5)
    desired: Array = stick + number(params, "gain", 1.0) * (place - around)
    return desired


def voronoi_centralised(positions: Array, headings: Array, params: Params, memory: Memory, rows: Index) -> Array:
    """Cover the whole arena (III.A.5): Lloyd's law on exact cells, each robot to the centroid of its own.

    The cells are bounded exactly by mirroring the robots at the four walls: the wall is then the border between a robot
    and its mirror image.

    Returns
    -------
    Array
        ``K (C_i - p_i)``, (n, 2) m/s.
    """
    del headings, memory, rows
    corners = np.asarray(params["bounds"], float).reshape(-1, 2)
    low, high = corners.min(axis=0), corners.max(axis=0)
    return number(params, "gain") * (centroids(positions, low, high) - positions)


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


CENTRALISED: dict[str, Law] = {law.__name__: law for law in (formation_assigned, voronoi_centralised, teleop_centroid)}
