"""What a simulated range sensor measures: rays against boxes, walls, movers and the discs of the other robots."""

from __future__ import annotations

import math

import numpy as np

from fullswarm.config import RangesConfig
from fullswarm.kernels import Array, kernel

WHOLE_TURN_RAD = 2.0 * math.pi - 1e-9
RAYS_OF_CONE = 41
"""By which a cone is measured: 1 cm apart at 1 m in a cone of 27 degrees."""


def ray_angles(sensor: RangesConfig) -> Array:
    """Return the directions of a sensor's rays from its own x axis, (k,) rad, counter-clockwise."""
    if sensor.fov_rad >= WHOLE_TURN_RAD:
        return np.linspace(-math.pi, math.pi, sensor.count, endpoint=False)
    if sensor.count == 1:
        return np.zeros(1)
    return np.linspace(-0.5 * sensor.fov_rad, 0.5 * sensor.fov_rad, sensor.count)


@kernel
def box_distance(x: float, y: float, ux: float, uy: float, boxes: Array, k: int) -> float:
    """Return how far along (ux, uy) box `k`, a row of ``with_trigonometry``, is; infinite: the ray misses it."""
    c, s = boxes[k, 4], boxes[k, 5]
    dx, dy = x - boxes[k, 0], y - boxes[k, 1]
    low, high = 0.0, math.inf
    for axis in range(2):
        at = c * dx + s * dy if axis == 0 else c * dy - s * dx
        way = c * ux + s * uy if axis == 0 else c * uy - s * ux
        half = boxes[k, 2 + axis] + boxes[k, 6]
        if math.fabs(way) < 1e-12:
            if math.fabs(at) > half:
                return math.inf
            continue
        first, last = (-half - at) / way, (half - at) / way
        low, high = max(low, min(first, last)), min(high, max(first, last))
        if low > high:
            return math.inf
    return low


@kernel
def disc_distance(x: float, y: float, ux: float, uy: float, disc_x: float, disc_y: float, radius: float) -> float:
    """Return how far along the unit vector (ux, uy) a disc is; infinite: the ray misses it."""
    dx, dy = disc_x - x, disc_y - y
    along = dx * ux + dy * uy
    across = dx * uy - dy * ux
    inside = radius * radius - across * across
    if inside < 0.0:
        return math.inf
    half = math.sqrt(inside)
    if along + half < 0.0:
        return math.inf
    return max(0.0, along - half)


@kernel
def cast(
    x: float, y: float, heading: float, angles: Array, own: int, discs: Array, count: int, boxes: Array, max_m: float,
    distances: Array,
) -> None:  # fmt: skip
    """Fill `distances` (k,) with how far each ray from (x, y) goes; infinite beyond `max_m`.

    Parameters
    ----------
    own : row of the disc that carries the sensor
    discs, count : (m, 3) x, y, radius of the robots, the first `count` rows
    boxes : (b, 8) rows of ``with_trigonometry``; one without half sizes is a disc
    """
    for ray in range(angles.shape[0]):
        distances[ray] = math.inf
    for thing in range(count + boxes.shape[0]):
        k = thing - count
        if thing < count:
            at_x, at_y, reach = discs[thing, 0], discs[thing, 1], discs[thing, 2]
        else:
            at_x, at_y, reach = boxes[k, 0], boxes[k, 1], boxes[k, 7]
        away_x, away_y = at_x - x, at_y - y
        far = max_m + reach
        if thing == own or away_x * away_x + away_y * away_y > far * far:
            continue
        is_disc = thing < count or (boxes[k, 2] == 0.0 and boxes[k, 3] == 0.0)
        for ray in range(angles.shape[0]):
            ux, uy = math.cos(heading + angles[ray]), math.sin(heading + angles[ray])
            away = disc_distance(x, y, ux, uy, at_x, at_y, reach) if is_disc else box_distance(x, y, ux, uy, boxes, k)
            distances[ray] = min(distances[ray], away)
    for ray in range(angles.shape[0]):
        if distances[ray] > max_m:
            distances[ray] = math.inf


class SimulatedSensor:
    """The range sensor of one body.

    Attributes
    ----------
    angles_rad : (k,) of its rays
    """

    def __init__(self, settings: RangesConfig, row: int, rng: np.random.Generator) -> None:
        self.settings, self._row, self._rng = settings, row, rng
        self.angles_rad = ray_angles(settings)
        # Rays side by side stand for each cone.
        off_rad = np.linspace(-0.5, 0.5, RAYS_OF_CONE) * settings.cone_rad if settings.cone_rad > 0.0 else np.zeros(1)
        self._cast_rad = (self.angles_rad[:, None] + off_rad[None, :]).ravel()

    def scan(self, pose: Array, discs: Array, count: int, boxes: Array) -> Array:
        """Return the distances (k,) m that it measures from a body at `pose` (3,); see :func:`cast` for the rest."""
        settings = self.settings
        x, y, heading = pose.tolist()
        c, s = math.cos(heading), math.sin(heading)
        at_x, at_y = x + c * settings.x_m - s * settings.y_m, y + s * settings.x_m + c * settings.y_m
        along = np.empty(len(self._cast_rad))
        cast.run(
            at_x, at_y, heading + settings.yaw_rad, self._cast_rad, self._row, discs, count, boxes, settings.max_m,
            along,
        )  # fmt: skip
        distances: Array = np.min(along.reshape(len(self.angles_rad), -1), axis=1)
        if settings.sigma_m > 0.0:
            distances += self._rng.normal(0.0, settings.sigma_m, len(distances))
            np.maximum(distances, 0.0, out=distances)
        if settings.dropout > 0.0:
            distances[self._rng.random(len(distances)) < settings.dropout] = math.nan
        return distances
