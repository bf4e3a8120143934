"""The swarm's centroid on a stick: all move alike, each keeps its place around the centroid."""

from __future__ import annotations

import numpy as np

from fullswarm.core.centralised.law import Memory, Params, number
from fullswarm.kernels import Array, Index


def velocities(positions: Array, headings: Array, params: Params, memory: Memory, rows: Index) -> Array:
    """Return the stick's velocity plus ``K (offset_i - (p_i - centroid))``, (n, 2) m/s.

    `memory["offset"]` keeps the places (one row per robot of the request, NaN: not seen yet) from the first tick.
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
    wished: Array = stick + number(params, "gain", 1.0) * (place - around)
    return wished
