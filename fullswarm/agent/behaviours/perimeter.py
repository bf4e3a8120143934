"""Perimeter: robots guard a closed line at equal distances along it, at rest or driving around it.

Each robot takes the nearest point of the line as its place s on it, and moves along by half the difference of the gaps
ahead and behind, which is a consensus on a ring: ``ṡ_i = v + K ((s_{i+1} - s_i) - (s_i - s_{i-1})) / 2``. It drives to
the point of the line that is ``ṡ_i / K`` farther along, K times as fast as that is away. The gaps approach the length
divided by n, the slowest mode at the rate ``K (1 - cos 2π/n)`` (eigenvalues of the ring's Laplacian; Olfati-Saber, Fax,
Murray, Proc. IEEE 2007). If a robot is lost, the others close its gap.
"""

from __future__ import annotations

import functools

import numpy as np

from fullswarm.agent.view import Params, View
from fullswarm.errors import ConfigError
from fullswarm.kernels import Array


def velocity(view: View, params: Params) -> Array:
    """Return the way onto the line and along it, (n, 2) m/s."""
    line = closed_line(tuple(map(tuple, params.corners)))
    s_m, off_m = place_on(line, view.position)
    other_m, _ = place_on(line, view.position[view.of] + view.offset)
    length_m = float(line[2][-1])
    ahead = (other_m - s_m[view.of]) % length_m
    # Of two robots at one place the one later in the request counts as ahead.
    same, later = np.minimum(ahead, length_m - ahead) < 1e-9, view.neighbour_index > view.index[view.of]
    ahead = np.where(same, np.where(later, 0.0, length_m), ahead)
    before_m, behind_m = np.full(len(s_m), length_m), np.full(len(s_m), length_m)
    np.minimum.at(before_m, view.of, ahead)
    np.minimum.at(behind_m, view.of, length_m - ahead)
    speed = params.speed_m_s[:, 0] + 0.5 * params.gain[:, 0] * (before_m - behind_m)
    speed *= np.exp(-off_m)  # a robot far off the line drives to it first
    return params.gain * (point_at(line, s_m + speed / params.gain[:, 0]) - view.position)


Line = tuple[Array, Array, Array]
"""Corners (m, 2), unit directions of the sides (m, 2), arc length at each corner and at the end (m + 1,)."""


@functools.lru_cache(maxsize=16)
def closed_line(corners: tuple[tuple[float, float], ...]) -> Line:
    """Return the polygon with these corners.

    Raises
    ------
    ConfigError
        Fewer than three different corners.
    """
    points = np.array(corners, float)
    sides = np.roll(points, -1, axis=0) - points
    lengths = np.linalg.norm(sides, axis=1)
    kept = lengths > 1e-6
    if kept.sum() < 3:
        raise ConfigError("the line has fewer than three different corners", hint="corners = [[0, 0], [4, 0], [4, 4]]")
    return points[kept], sides[kept] / lengths[kept, None], np.concatenate([[0.0], np.cumsum(lengths[kept])])


def place_on(line: Line, position: Array) -> tuple[Array, Array]:
    """Return for n positions the arc length at the nearest point of a line (n,), and how far that is away (n,)."""
    corners, directions, arc_m = line
    along = np.einsum("nmk,mk->nm", position[:, None] - corners, directions)
    along = np.clip(along, 0.0, np.diff(arc_m))
    points = corners + along[:, :, None] * directions
    off_m = np.linalg.norm(points - position[:, None], axis=2)
    side, each = off_m.argmin(axis=1), np.arange(len(position))
    return (arc_m[side] + along[each, side]) % arc_m[-1], off_m[each, side]


def point_at(line: Line, s_m: Array) -> Array:
    """Return the points (n, 2) of a line at arc lengths (n,)."""
    corners, directions, arc_m = line
    s_m = s_m % arc_m[-1]
    side = np.clip(np.searchsorted(arc_m, s_m, side="right") - 1, 0, len(corners) - 1)
    found: Array = corners[side] + (s_m - arc_m[side])[:, None] * directions[side]
    return found
