"""The shape of a swarm from where its robots are: order, spacing, diameter, Lloyd's cost. Pure functions."""

from __future__ import annotations

import math

import numpy as np

from fullswarm.kernels import Array, kernel
from fullswarm.perf.coverage import Bounds

SAMPLES = 24
"""Points per side at which Lloyd's cost is sampled: the middles of as many strips."""


def values(x_m: Array, y_m: Array, heading_rad: Array, bounds_m: Bounds) -> dict[str, float]:
    """Return all of them by the names of ``metrics.SHAPE_DOC``; those that so few robots do not have are left out."""
    found: dict[str, float] = {}
    position = np.column_stack([x_m, y_m])
    if len(position):
        found["order"] = order(heading_rad)
    if len(position) > 1:
        found["spacing_m"], found["diameter_m"] = spacing_and_diameter(position)
    if len(position):
        found["voronoi_m2"] = voronoi_cost(position, bounds_m)
    return found


def order(heading_rad: Array) -> float:
    """Return the length of the mean heading vector of headings (n,), n > 0: 1 when all look one way."""
    return math.hypot(float(np.cos(heading_rad).mean()), float(np.sin(heading_rad).mean()))


def spacing_and_diameter(position: Array) -> tuple[float, float]:
    """Return the mean distance to the nearest neighbour and the largest distance of two of (n, 2), n > 1; metres."""
    least, most = squared_distances(position, position, among=True)
    return float(np.sqrt(least).mean()), math.sqrt(most)


def voronoi_cost(position: Array, bounds_m: Bounds, samples: int = SAMPLES) -> float:
    """Return the mean over the arena of the squared distance to the nearest of (n, 2), n > 0, in m².

    Cortés et al. 2004, (2), for an even density, over the area: at rest in Lloyd's algorithm it is least.
    """
    x_min, y_min, x_max, y_max = bounds_m
    middles = (np.arange(samples) + 0.5) / samples
    points = np.empty((samples, samples, 2))
    points[..., 0] = x_min + (x_max - x_min) * middles[:, None]
    points[..., 1] = y_min + (y_max - y_min) * middles[None, :]
    return float(squared_distances(points.reshape(-1, 2), position, among=False)[0].mean())


@kernel
def scan(ours: Array, theirs: Array, among: bool, least: Array) -> float:
    """Do what `squared_distances` says, compiled: no table, which takes a thousand robots longer than the sums."""
    most = 0.0
    for i in range(ours.shape[0]):
        least[i] = math.inf
        for j in range(theirs.shape[0]):
            dx = ours[i, 0] - theirs[j, 0]
            dy = ours[i, 1] - theirs[j, 1]
            apart = dx * dx + dy * dy
            if apart > most:
                most = apart
            if apart < least[i] and not (among and i == j):
                least[i] = apart
    return most


def squared_distances(ours: Array, theirs: Array, *, among: bool) -> tuple[Array, float]:
    """Return the least squared distance of each of `ours` (m, 2) to `theirs` (n, 2), (m,), and the largest of all.

    `among`: they are the same, and no robot is its own neighbour.
    """
    if scan.run is not scan.plain:
        least = np.empty(len(ours))
        return least, scan.run(ours, theirs, among, least)
    dx = ours[:, 0, None] - theirs[None, :, 0]
    dy = ours[:, 1, None] - theirs[None, :, 1]
    apart = dx * dx + dy * dy
    most = float(apart.max())
    if among:
        np.fill_diagonal(apart, np.inf)
    return apart.min(axis=1), most
