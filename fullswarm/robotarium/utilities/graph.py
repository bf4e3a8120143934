"""Laplacians of graphs, ``L = D - A``, and neighbours.

Definitions as in Mesbahi, Egerstedt, "Graph Theoretic Methods in Multiagent Networks", Princeton University Press 2010.
Random graphs draw from NumPy's global generator, which scripts seed, and are those of ``rps`` after the same seed.
"""

from __future__ import annotations

import numpy as np

from fullswarm.errors import ConfigError
from fullswarm.kernels import Array, Index
from fullswarm.robotarium.utilities.arguments import columns, not_negative, require

__all__ = [
    "completeGL",
    "cycle_GL",
    "delta_disk_neighbors",
    "lineGL",
    "np",
    "randomGL",
    "random_connectedGL",
    "topological_neighbors",
]


def _whole(value: object) -> int:
    """Return a whole number, of Python or NumPy; -1 if it is something else."""
    return int(value) if isinstance(value, int | np.integer) else -1


def _count(value: int, name: str, least: int = 1) -> int:
    number = _whole(value)
    require(number >= least, name, value, f"a whole number, {least} or more")
    return number


def _laplacian(count: int, first: Index, second: Index) -> Array:
    """Return the Laplacian (N, N) of the edges from `first` to `second`, each edge once."""
    adjacent = np.zeros((count, count))
    adjacent[first, second] = adjacent[second, first] = 1.0
    found: Array = np.diag(adjacent.sum(axis=1)) - adjacent
    return found


def lineGL(N: int) -> Array:  # noqa: N802
    """Return the Laplacian (N, N) of a line of N nodes."""
    nodes = np.arange(_count(N, "N"))
    return _laplacian(N, nodes[:-1], nodes[1:])


def cycle_GL(N: int) -> Array:  # noqa: N802
    """Return the Laplacian (N, N) of a cycle of N nodes; two nodes have one edge, one node has none."""
    nodes = np.arange(_count(N, "N"))
    return _laplacian(N, nodes, np.roll(nodes, -1)) if N > 1 else np.zeros((1, 1))


def completeGL(N: int) -> Array:  # noqa: N802
    """Return the Laplacian (N, N) of the graph with all edges."""
    return _laplacian(_count(N, "N"), *np.triu_indices(N, 1))


def random_connectedGL(v: int, e: int) -> Array:  # noqa: N802
    """Return the Laplacian (v, v) of a random connected graph: a tree of v - 1 edges, and up to `e` more."""
    nodes = np.arange(1, _count(v, "v"))
    parents = np.array([int(np.random.randint(each)) for each in nodes], np.int64)  # noqa: NPY002
    tree = _laplacian(v, parents, nodes)
    # Nothing is drawn where there is nothing to choose, so that a script's next random numbers are those of rps, too.
    return _with_edges(tree, e) if _count(e, "e", 0) > 0 and (tree == 0.0).any() else tree


def randomGL(v: int, e: int) -> Array:  # noqa: N802
    """Return the Laplacian (v, v) of a random graph of `e` edges, or of all edges if there are not so many."""
    return _with_edges(np.zeros((_count(v, "v"), v)), _count(e, "e", 0))


def _with_edges(laplacian: Array, more: int) -> Array:
    """Return the Laplacian with `more` of its missing edges, chosen at random, or all of them."""
    first, second = np.nonzero(np.triu(laplacian == 0.0, 1))
    chosen = np.random.permutation(len(first))[:more]  # noqa: NPY002
    return laplacian + _laplacian(len(laplacian), first[chosen], second[chosen])


def topological_neighbors(L: Array, agent: int) -> Index:
    """Return the neighbours (M,) of a node in the graph of a Laplacian; the Laplacian is left as it is.

    Raises
    ------
    ConfigError
        `L` is not square, or there is no such node.
    """
    laplacian = np.asarray(L)
    if laplacian.ndim != 2 or laplacian.shape[0] != laplacian.shape[1]:
        raise ConfigError(f"has shape {laplacian.shape}, expected (N, N)", where="L")
    row = laplacian[_node(agent, len(laplacian))]
    return np.flatnonzero((row != 0) & (np.arange(len(row)) != agent))


def delta_disk_neighbors(poses: Array, agent: int, delta: float) -> Index:
    """Return the robots (M,) whose positions are within `delta` m of that of robot `agent`, itself left out.

    Parameters
    ----------
    poses : (3, N), or positions (2, N)
    """
    places = np.asarray(poses, float)
    places = columns(places[:2], 2, "poses")
    not_negative(delta=delta)
    away = np.linalg.norm(places - places[:, [_node(agent, places.shape[1])]], axis=0)
    return np.flatnonzero((away <= delta) & (np.arange(len(away)) != agent))


def _node(agent: int, count: int) -> int:
    number = _whole(agent)
    require(0 <= number < count, "agent", agent, f"0 to {count - 1}")
    return number
