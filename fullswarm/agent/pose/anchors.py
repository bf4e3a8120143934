"""Positions from distances to radio anchors of known place (ultra-wideband).

While the pose is known, each distance corrects it by itself. Where it is not, or distances keep contradicting it, the
newest distances to three or more anchors give a position, which then counts as a fix without heading.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from fullswarm.agent.pose.estimator import Estimator
from fullswarm.agent.pose.pose_filter import Distance, Taken, Verdict
from fullswarm.config import AgentConfig
from fullswarm.kernels import Array

TOGETHER_S = 0.4
"""Distances that were measured within this time count as one position's."""
LEAST = 3
MOST = 16
STEPS = 20
CLOSE_M = 1e-4
FLAT = 1e-3
"""Anchors whose directions are so nearly on one line (ratio of the eigenvalues of the information) give no position."""
FIT_SIGMA = 4.0
"""A residual beyond this means that a distance is wrong: reflected, or its anchor moved."""


@dataclass(frozen=True, slots=True)
class Position:
    """A position from distances, and when; `sigma_m` along the worse axis, `covariance_m2` (xx, xy, yy)."""

    at_s: float
    x_m: float
    y_m: float
    sigma_m: float
    covariance_m2: tuple[float, float, float]


@dataclass(slots=True)
class Measured:
    """The newest distances of one robot by anchor, and how many in a row did not fit its pose."""

    newest: OrderedDict[str, Distance] = field(default_factory=OrderedDict)
    misfits: int = 0
    misfit_s: float = math.inf  # since when


class Anchors:
    """Takes the distances of an agent's robots in."""

    def __init__(self, config: AgentConfig) -> None:
        self._config = config
        self._robots: dict[int, Measured] = {}

    def take(self, row: int, anchor: str, measured: Distance, estimator: Estimator) -> tuple[Taken, Position | None]:
        """Correct a robot's pose by a distance; return what became of it, and a position if that is to be taken."""
        robot = self._robots.setdefault(row, Measured())
        robot.newest[anchor] = measured
        robot.newest.move_to_end(anchor)
        if len(robot.newest) > MOST:
            robot.newest.popitem(last=False)
        taken = estimator.take_distance(row, measured)
        if taken.verdict is Verdict.ACCEPTED:
            robot.misfits, robot.misfit_s = 0, math.inf
            return taken, None
        if taken.verdict is Verdict.OUTLIER:
            robot.misfits += 1
            robot.misfit_s = min(robot.misfit_s, measured.at_s)
            lasted_s = measured.at_s - robot.misfit_s
            if robot.misfits < self._config.fix_reanchor_count or lasted_s < self._config.fix_reanchor_s:
                return taken, None
        elif taken.verdict is Verdict.TOO_OLD:
            return taken, None
        together = [each for each in robot.newest.values() if abs(measured.at_s - each.at_s) <= TOGETHER_S]
        found = located(together)
        if found is not None:
            robot.newest.clear()  # each distance counts once
        return taken, found


def located(distances: Sequence[Distance]) -> Position | None:
    """Return the position that fits distances best (weighted Gauss-Newton); None: they give none.

    That is with fewer than three anchors, with anchors on one line, and where a distance does not fit the result.
    """
    if len(distances) < LEAST:
        return None
    anchors = np.array([[each.x_m, each.y_m, each.up_m] for each in distances])
    lengths = np.array([each.distance_m for each in distances])
    sigmas = np.array([each.sigma_m for each in distances])
    spread = np.linalg.eigvalsh(np.atleast_2d(np.cov(anchors[:, :2].T)))
    if spread[0] <= FLAT * spread[1]:
        return None  # a mirrored position fits as well
    best: tuple[float, Array, Array] | None = None
    for start in (anchors[:, :2].mean(axis=0), anchors[int(np.argmin(lengths)), :2] + 0.1):
        found = _solved(start, anchors, lengths, sigmas)
        if found is not None and (best is None or found[0] < best[0]):
            best = found
    if best is None or best[0] > FIT_SIGMA:
        return None
    _, place, information = best
    covariance = np.linalg.inv(information)
    (xx, xy), (_, yy) = covariance.tolist()
    worst_m = math.sqrt(float(np.linalg.eigvalsh(covariance)[1]))
    return Position(max(each.at_s for each in distances), float(place[0]), float(place[1]), worst_m, (xx, xy, yy))


def _solved(start: Array, anchors: Array, lengths: Array, sigmas: Array) -> tuple[float, Array, Array] | None:
    """Return the largest residual in standard deviations, the place (2,) and the information (2, 2) there."""
    place = start.copy()
    for _ in range(STEPS):
        offset = place - anchors[:, :2]
        away = np.maximum(np.sqrt((offset**2).sum(axis=1) + anchors[:, 2] ** 2), 1e-6)
        slope = offset / away[:, None] / sigmas[:, None]
        residual = (lengths - away) / sigmas
        information = slope.T @ slope
        if np.linalg.cond(information) > 1.0 / FLAT:
            return None
        step = np.linalg.solve(information, slope.T @ residual)
        place = place + step
        if float(np.hypot(*step)) < CLOSE_M:
            return float(np.abs(residual).max()), place, information
    return None
