"""Where a robot is on a known map, from its ranges and its odometry: a particle filter (adaptive Monte Carlo).

Particles follow the odometry with its noise and are weighted by how near the ends of the rays are to the map's surfaces
(Thrun, Burgard, Fox, *Probabilistic Robotics*, 2005, chapter 8). Their number follows how widely they spread (Fox,
*Adapting the sample size in particle filters through KLD-sampling*, 2003). When what the robot measures does not fit
the map any more, it was carried: the whole map is searched until one place fits and no other does as well.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from fullswarm.agent.pose.map_field import MapField
from fullswarm.agent.pose.pose_filter import Displacement, OdometryNoise
from fullswarm.geometry import wrap
from fullswarm.kernels import Array

FEWEST, MOST = 300, 3000
BIN_M, BIN_RAD = 0.25, math.radians(15.0)
RAYS = 60
"""Rays of a scan that are used: neighbouring ones tell the same."""
HIT_SIGMA_M = 0.08
"""Standard deviation of a ray's end: of the sensor, the map's and the field's cells."""
RANDOM_SHARE = 0.1
"""Of rays that end at what is not on the map: robots, people, moved chairs."""
SHARPNESS = 0.25
"""Rays are not independent of each other: their log likelihoods count for so much."""
FITS, FITS_NO_MORE = 0.7, 0.5
"""Shares of the rays that end at a surface of the map: where a place is believed, and below which it no longer is."""
LOST_S = 0.8
"""A scan that does not fit may be a crowd of people that passes; for so long it is."""
SURE_SCANS = 5
"""A place that was found anew must fit so many scans before it is believed."""
DRAWN, TRIED = 12_000, 24
"""Places of the whole map that are tried at each scan while the robot is lost, with so many rays."""
BEST, AROUND = 60, 40
OTHER_M, OTHER_RAD = 1.0, 0.8
SEARCHES = 12
"""So many searches in a row must find the same place and no other that fits nearly as well."""
AMBIGUOUS = 0.06
"""Another place, so far off, that fits nearly as well: which of the two it is cannot be said by few searches."""
MANY_SEARCHES, EXACT, SLIGHTLY = 40, 0.9, 0.03
"""By so many in a row it can, where the map explains so much of what is measured, if one fits better by so much on
average. A map with more errors may fit a wrong place better by that."""
WIDEST_M = 0.25
"""Particles that spread wider are no place."""
LEAST_SIGMA_M, LEAST_SIGMA_RAD = 0.02, 0.01


@dataclass(frozen=True, slots=True)
class Located:
    """A place on the map: pose (x, y in m, heading in rad), covariance (m²), sigma of the heading, fitting share."""

    pose: tuple[float, float, float]
    covariance_m2: tuple[float, float, float]
    heading_sigma_rad: float
    fit: float


class MapLocalizer:
    """One robot on a map.

    Parameters
    ----------
    start : pose and standard deviations (m, rad) of where it was put; None: anywhere
    radius_m : footprint

    Attributes
    ----------
    lost : it does not know where it is: nothing fits, or two places do
    fit : share of the newest scan's rays that end at a surface of the map
    """

    def __init__(
        self, field: MapField, radius_m: float, noise: OdometryNoise, rng: np.random.Generator,
        start: tuple[Array, float, float] | None = None,
    ) -> None:  # fmt: skip
        self._field, self._radius_m, self._noise, self._rng = field, radius_m, noise, rng
        self.lost, self.fit = start is None, 0.0
        self._particles = np.zeros((0, 3))
        self._weights = np.zeros(0)
        self._misfit_s = 0.0
        self._leads: deque[float] = deque(maxlen=MANY_SEARCHES)  # by how much the best place fitted better than others
        self._sure = SURE_SCANS if start is not None else 0
        if start is not None:
            pose, sigma_m, sigma_rad = start
            self._particles = pose + rng.normal(size=(FEWEST, 3)) * (sigma_m, sigma_m, sigma_rad)
            self._weights = np.full(FEWEST, 1.0 / FEWEST)

    def move(self, motion: Displacement) -> None:
        """Move all particles as the wheels did, each with an error of its own."""
        particles, count = self._particles, len(self._particles)
        if not count:
            return
        position_m2, heading_rad2 = self._noise.variances(motion)
        ahead = motion.ahead_m + self._rng.normal(0.0, math.sqrt(position_m2), count)
        left = motion.left_m + self._rng.normal(0.0, math.sqrt(position_m2), count)
        turn = motion.turn_rad + self._rng.normal(0.0, math.sqrt(heading_rad2), count)
        c, s = np.cos(particles[:, 2]), np.sin(particles[:, 2])
        particles[:, 0] += c * ahead - s * left
        particles[:, 1] += s * ahead + c * left
        particles[:, 2] += turn

    def see(self, points: Array, free: Array, since_s: float) -> Located | None:
        """Take in a scan; return where the robot is, or None while that is not known.

        Parameters
        ----------
        points : (k, 2) m, where rays ended, in the frame of the robot's body
        free : (m, 2) m, points that rays passed through
        since_s : time since the last scan
        """
        if len(points) < 5:
            return None  # nothing is near enough to be measured: that is no contradiction
        used = points[np.linspace(0, len(points) - 1, min(RAYS, len(points))).astype(np.int64)]
        if self.lost or not len(self._particles):
            self._search(used, free)
        elif not self._weigh(used):
            self._misfit_s += since_s
            if self._misfit_s > LOST_S:
                self.lost, self._sure = True, 0
            return None
        else:
            self._misfit_s = 0.0
        return self._place()

    def _weigh(self, points: Array) -> bool:
        """Weigh the particles by a scan and draw them anew; tell whether the scan fits the map where they are."""
        fits = self._fits(self._particles, points)
        likelihood = np.log(fits * (1.0 - RANDOM_SHARE) + RANDOM_SHARE).sum(axis=1)
        weights = self._weights * np.exp(SHARPNESS * (likelihood - likelihood.max()))
        self._weights = weights / weights.sum()
        self.fit = float(self._weights @ fits.mean(axis=1))
        if self.fit >= FITS_NO_MORE and 1.0 / float((self._weights**2).sum()) < 0.5 * len(self._weights):
            self._draw()
        self._sure = self._sure + 1 if self.fit >= FITS else max(0, self._sure - 1)
        return self.fit >= FITS_NO_MORE

    def _fits(self, poses: Array, points: Array) -> Array:
        """Return how well each ray fits from each pose, (poses, rays), 0 to 1."""
        c, s = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
        x = poses[:, 0, None] + c * points[:, 0] - s * points[:, 1]
        y = poses[:, 1, None] + s * points[:, 0] + c * points[:, 1]
        away_m = self._field.surface_m(x, y)
        fits: Array = np.exp(-0.5 * (away_m / HIT_SIGMA_M) ** 2)
        return fits

    def _draw(self) -> None:
        """Draw particles by their weights (low variance sampling), as many as their spread needs."""
        bins = np.floor(self._particles / (BIN_M, BIN_M, BIN_RAD)).astype(np.int64)
        used = len(np.unique(bins[self._weights > 0.1 / len(self._weights)], axis=0))
        count = int(min(MOST, max(FEWEST, 60 * used)))
        steps = (self._rng.random() + np.arange(count)) / count
        chosen = np.searchsorted(np.cumsum(self._weights), steps).clip(0, len(self._weights) - 1)
        self._particles, self._weights = self._particles[chosen], np.full(count, 1.0 / count)

    def _search(self, points: Array, free: Array) -> None:
        """Look for the robot anywhere on the map; believe a place only when no other was found in many searches."""
        places = self._field.free_places(DRAWN, self._radius_m, self._rng)
        if not len(places):
            return
        drawn = np.column_stack([places, self._rng.uniform(-math.pi, math.pi, len(places))])
        few = points[np.linspace(0, len(points) - 1, min(TRIED, len(points))).astype(np.int64)]
        # A wide likelihood first, so that a place near the true one stands out. What was found before stays in.
        candidates = np.vstack([drawn, self._particles])
        best = _niches(candidates, self._surface(candidates, few, 0.25).mean(axis=1))
        for step_m, step_rad in ((0.15, 0.12), (0.05, 0.04), (0.02, 0.015)):
            near = np.repeat(best, AROUND, axis=0)
            near += self._rng.normal(size=near.shape) * (step_m, step_m, step_rad)
            near = np.vstack([best, near])
            best = _niches(near, self._surface(near, points, max(HIT_SIGMA_M, step_m)).mean(axis=1))
        fits = self._fits(best, points).mean(axis=1) * (1.0 - self._blocked(best, free))
        order = np.argsort(-fits)
        best, fits = best[order], fits[order]
        self.fit = float(fits[0])
        before = self._particles[0] if len(self._particles) else None
        self._particles, self._weights = best, np.full(len(best), 1.0 / len(best))
        other = np.hypot(*(best[:, :2] - best[0, :2]).T) > OTHER_M
        other |= np.abs(np.arctan2(np.sin(best[:, 2] - best[0, 2]), np.cos(best[:, 2] - best[0, 2]))) > OTHER_RAD
        if before is None or math.hypot(*(best[0, :2] - before[:2])) >= OTHER_M or self.fit < FITS:
            self._leads.clear()
        self._leads.append(self.fit - float(fits[other].max(initial=0.0)))
        if not self._alone():
            return
        self._particles = best[0] + self._rng.normal(size=(FEWEST, 3)) * (0.03, 0.03, 0.02)
        self._weights = np.full(FEWEST, 1.0 / FEWEST)
        self.lost, self._sure, self._misfit_s = False, 0, 0.0
        self._leads.clear()

    def _alone(self) -> bool:
        """Tell whether the place that fits best is the only one."""
        leads = tuple(self._leads)
        if self.fit < FITS or len(leads) < SEARCHES:
            return False
        clear = min(leads[-SEARCHES:]) >= AMBIGUOUS
        return clear or (len(leads) == MANY_SEARCHES and self.fit >= EXACT and sum(leads) >= SLIGHTLY * len(leads))

    def _blocked(self, poses: Array, free: Array) -> Array:
        """Return which share of the points that rays passed through would be inside an obstacle, (poses,)."""
        if not len(free):
            return np.zeros(len(poses))
        c, s = np.cos(poses[:, 2, None]), np.sin(poses[:, 2, None])
        x = poses[:, 0, None] + c * free[:, 0] - s * free[:, 1]
        y = poses[:, 1, None] + s * free[:, 0] + c * free[:, 1]
        share: Array = self._field.inside(x, y).mean(axis=1)
        return share

    def _surface(self, poses: Array, points: Array, sigma_m: float) -> Array:
        return self._fits(poses, points) ** ((HIT_SIGMA_M / sigma_m) ** 2)

    def _place(self) -> Located | None:
        """Return the middle of the particles, if they are one place that has fitted often enough."""
        if self.lost or self._sure < SURE_SCANS or self.fit < FITS_NO_MORE:
            return None
        x, y, heading = self._particles.T
        weights = self._weights
        middle_x, middle_y = float(weights @ x), float(weights @ y)
        sin, cos = float(weights @ np.sin(heading)), float(weights @ np.cos(heading))
        middle_rad = math.atan2(sin, cos)
        dx, dy = x - middle_x, y - middle_y
        xx, xy, yy = float(weights @ (dx * dx)), float(weights @ (dx * dy)), float(weights @ (dy * dy))
        if math.sqrt(xx + yy) > WIDEST_M:
            return None
        off = np.arctan2(np.sin(heading - middle_rad), np.cos(heading - middle_rad))
        spread_rad = math.sqrt(float(weights @ (off * off)) + LEAST_SIGMA_RAD**2)
        least_m2 = LEAST_SIGMA_M**2
        return Located(
            (middle_x, middle_y, wrap(middle_rad)), (xx + least_m2, xy, yy + least_m2), spread_rad, self.fit
        )  # fmt: skip


def _niches(poses: Array, fits: Array) -> Array:
    """Return the best `BEST` poses, one of each square metre and direction: a second place must not be crowded out."""
    order = np.argsort(-fits)
    keys = np.floor(poses[order] / (OTHER_M, OTHER_M, OTHER_RAD)).astype(np.int64)
    _, first = np.unique(keys, axis=0, return_index=True)
    chosen: Array = poses[order[np.sort(first)[:BEST]]]
    return chosen
