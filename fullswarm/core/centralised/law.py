"""What a centralised law is: a function over all robots of a request.

``velocities(positions, headings, params, memory, rows) -> (n, 2)`` desired planar velocities in m/s, for the n robots
whose state is fresh: `positions` (n, 2) m, `headings` (n,) rad, `rows` (n,) their places in the request's list of
robots, `params` the request's parameters. A law does no I/O and reads no clock; what it must keep from tick to tick
of one request lies in `memory`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from fullswarm.core.centralised import need
from fullswarm.kernels import Array, Index
from fullswarm.messages import Value

Params = Mapping[str, Value]
Memory = dict[str, Array]
Law = Callable[[Array, Array, Params, Memory, Index], Array]

MODULES = {"formation_assigned": "formation", "voronoi_centralised": "voronoi", "teleop_centroid": "teleop"}


def law(name: str) -> Law:
    """Return the centralised law `name`; ``KeyError`` when there is none."""
    velocities: Law = need(f"fullswarm.core.centralised.{MODULES[name]}").velocities
    return velocities


def number(params: Params, name: str, usual: float = 0.0) -> float:
    """Return a parameter that is a number; `usual` when it is not given."""
    value = params.get(name, usual)
    return float(value) if isinstance(value, int | float) else usual
