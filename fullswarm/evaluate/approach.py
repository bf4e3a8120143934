"""How near two robots ever came to each other. In: true poses after each step, and what a referee saw within it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fullswarm.kernels import Array, Index, kernel


@kernel
def pair_index(i: int, j: int, n: int) -> int:
    """Return where the pair `i` < `j` of `n` robots stands in the order (0, 1), (0, 2), …, (1, 2), … of all pairs."""
    return i * n - i * (i + 1) // 2 + j - i - 1


@kernel
def approach(
    time_s: float, before: Array, pose: Array, radius: Array, near: Index, gaps: Array, least: Array, at_s: Array,
    judged: NDArray[np.bool_],
) -> None:  # fmt: skip
    """Take in one step: pairs in `near` came as close as `gaps` says, others moved straight from `before` to `pose`."""
    n = pose.shape[0]
    furthest = 0.0
    for i in range(n):
        dx, dy = pose[i, 0] - before[i, 0], pose[i, 1] - before[i, 1]
        furthest = max(furthest, dx * dx + dy * dy)
    slack = 2.0 * math.sqrt(furthest)
    for m in range(near.shape[0]):
        if near[m, 1] >= 0:
            pair = pair_index(min(near[m, 0], near[m, 1]), max(near[m, 0], near[m, 1]), n)
            judged[pair] = True
            if gaps[m] < least[pair]:
                least[pair], at_s[pair] = gaps[m], time_s
    pair = -1
    for i in range(n):
        for j in range(i + 1, n):
            pair += 1
            if judged[pair]:
                judged[pair] = False
                continue
            both = radius[i] + radius[j]
            x, y = pose[j, 0] - pose[i, 0], pose[j, 1] - pose[i, 1]
            far = least[pair] + both + slack
            if x * x + y * y >= far * far:
                continue
            x, y = before[j, 0] - before[i, 0], before[j, 1] - before[i, 1]
            along_x = pose[j, 0] - pose[i, 0] - x
            along_y = pose[j, 1] - pose[i, 1] - y
            length = along_x * along_x + along_y * along_y
            if length > 0.0:
                part = min(1.0, max(0.0, -(x * along_x + y * along_y) / length))
                x += part * along_x
                y += part * along_y
            gap = math.sqrt(x * x + y * y) - both
            if gap < least[pair]:
                least[pair], at_s[pair] = gap, time_s
    for i in range(n):
        before[i, 0], before[i, 1] = pose[i, 0], pose[i, 1]


class Approaches:
    """The closest approach of each pair of n robots, from `pose` (n, 3) on.

    Attributes
    ----------
    least_m, at_s : (n (n - 1) / 2,) gap between the rims, and the end of the step in which it was; pairs in the order
        (0, 1), (0, 2), …, (1, 2), …
    """

    def __init__(self, pose: Array, radius_m: Array) -> None:
        n = len(pose)
        self._before, self._radius_m = np.array(pose[:, :2]), np.array(radius_m, float)
        self.least_m, self.at_s = np.full(n * (n - 1) // 2, math.inf), np.zeros(n * (n - 1) // 2)
        self._judged = np.zeros(n * (n - 1) // 2, np.bool_)

    def look(self, time_s: float, pose: Array, near: Index, gaps_m: Array) -> None:
        """Take in one step.

        Parameters
        ----------
        time_s : its end
        pose : (n, 3) true
        near, gaps_m : (m, 2), (m,) pairs that a referee followed within the step (the second row < 0: no robot)
        """
        approach.run(
            time_s, self._before, pose, self._radius_m, near, gaps_m, self.least_m, self.at_s, self._judged
        )  # fmt: skip
