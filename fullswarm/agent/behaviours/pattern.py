"""Pattern: robots fill the dark parts of a picture, one place each.

The operator's computer turns the picture into dark points (``--set picture=@heart.png``). Each robot spreads as many
places over them as the request has robots, the same on all: farthest points first (Gonzalez, Theor. Comput. Sci. 1985),
then Lloyd's iterations on the points. Who takes which place is auctioned as in
:mod:`~fullswarm.agent.behaviours.task_auction`, with the distances at the start as bids; the place of a robot that is
lost is filled by one without a place, if the request has more robots than the picture has points.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from fullswarm.agent.behaviours import task_auction
from fullswarm.agent.view import Params, View
from fullswarm.kernels import Array, Index
from fullswarm.memory import rows

MERGE = task_auction.MERGE
ITERATIONS = 20


@dataclass
class Memory:
    """Where the robot started, and what an auction needs; its task is its place."""

    start_m: Array = rows(2, fill=np.nan)
    task: Index = rows(fill=-1)
    renew_s: Array = rows()
    next_s: Array = rows(fill=-np.inf)
    beat: Array = rows(task_auction.MOST)
    changed_s: Array = rows(task_auction.MOST)


def velocity(view: View, params: Params, memory: Memory) -> Array:
    """Return the gain times the way to the robot's place, (n, 2) m/s; zero without one."""
    memory.start_m = np.where(np.isnan(memory.start_m), view.position, memory.start_m)
    unit = places(tuple(map(tuple, params.picture)), len(view.members))
    to = np.zeros_like(view.position)
    for row, here in enumerate(view.position):
        fitted = params.centre[row] + params.width_m[row] * unit
        cost = np.linalg.norm(fitted - memory.start_m[row], axis=1)
        mine = task_auction.bid(view, row, memory, cost, float(params.silent_s[row, 0]))
        if mine >= 0:
            to[row] = fitted[mine] - here
    return params.gain * to


@functools.lru_cache(maxsize=8)
def places(points: tuple[tuple[float, float], ...], count: int) -> Array:
    """Return at most `count` places spread over points, all different, for a picture 1 m wide around 0, (k, 2)."""
    ink = np.unique(np.array(points, float), axis=0)
    low, high = ink.min(axis=0), ink.max(axis=0)
    middle, width = 0.5 * (low + high), max(float((high - low).max()), 1e-9)
    ink = (ink - middle) / width
    chosen = [int(np.linalg.norm(ink, axis=1).argmax())]
    nearest = np.linalg.norm(ink - ink[chosen[0]], axis=1)
    while len(chosen) < min(count, len(ink)):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.linalg.norm(ink - ink[chosen[-1]], axis=1))
    found: Array = ink[chosen]
    for _ in range(ITERATIONS):
        owner = np.linalg.norm(ink[:, None] - found, axis=2).argmin(axis=1)
        found = np.array([ink[owner == k].mean(axis=0) for k in range(len(found))])
    return found
