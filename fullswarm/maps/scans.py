"""Packs scans of range sensors for the bus, as rays at equal angles, and unpacks them.

Distances are whole millimetres in two bytes each: a scan of 360 rays takes 720 bytes. Sensors measure at angles that
are nearly equal (a lidar whose motor is uneven) or not at all (a few beams): those rays are put into equal bins, and of
several in one bin the nearest counts.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fullswarm.kernels import Array, Index
from fullswarm.messages import MOST_RAYS, SensorScan

NOTHING, UNKNOWN = 0xFFFE, 0xFFFF
"""Instead of a distance: nothing within the sensor's range; not measured."""
FARTHEST_M = 1e-3 * (NOTHING - 1)
"""Of a distance that can be stated, 65.5 m; what is farther counts as nothing."""
BIN_RAD = math.radians(1.0)
"""Bins of rays at unequal angles are no wider than this, so that no ray is turned by more than half of it."""
EVEN = 0.02
"""Steps are equal when no ray is farther from its place than this share of a step."""


class Bins(NamedTuple):
    """A scan as rays at equal angles, counter-clockwise."""

    first_rad: float
    step_rad: float  # 0 of a single ray
    distances_m: Array  # (k,), infinite: nothing within range; NaN: not measured


def even(angles_rad: Array, distances_m: Array) -> Bins:
    """Return rays (k,) in the order of measurement as rays at equal angles, (m,) with m of `MOST_RAYS` at most."""
    if not len(angles_rad):
        return Bins(0.0, 0.0, np.zeros(0))
    way = np.unwrap(angles_rad)
    if len(way) > 1 and way[-1] < way[0]:
        way, distances_m = way[::-1], distances_m[::-1]
    count, first_rad = len(way), float(way[0])
    step_rad = (float(way[-1]) - first_rad) / max(1, count - 1)
    off_rad = np.abs(way - (first_rad + step_rad * np.arange(count))).max()
    if count <= MOST_RAYS and (count == 1 or (step_rad > 0.0 and off_rad <= EVEN * step_rad)):
        return Bins(_wrapped(first_rad), step_rad, np.asarray(distances_m, np.float64))
    return _binned(way, distances_m)


def _binned(way: Array, distances_m: Array) -> Bins:
    """Return rays at unequal angles (k,) rad in bins: the nearest in each, NaN where none was measured."""
    if np.ptp(way) > 2.0 * math.pi:  # beams in no order, or more than a turn
        way = np.remainder(way, 2.0 * math.pi)
    first_rad, span_rad = float(way.min()), float(np.ptp(way))
    if not span_rad > 0.0:
        return Bins(_wrapped(first_rad), 0.0, np.array([np.fmin.reduce(distances_m)]))
    count = min(max(len(way), math.ceil(span_rad / BIN_RAD) + 1), MOST_RAYS)
    step_rad = span_rad / (count - 1)
    into: Index = np.rint((way - first_rad) / step_rad).astype(np.int64)
    found = np.full(count, np.nan)
    np.fmin.at(found, into, distances_m)
    return Bins(_wrapped(first_rad), step_rad, found)


def _wrapped(angle_rad: float) -> float:
    return math.remainder(angle_rad, 2.0 * math.pi)


def thinned(bins: Bins, most: int) -> Bins:
    """Return a scan with `most` rays at most: of rays side by side the nearest."""
    count = len(bins.distances_m)
    if count <= most:
        return bins
    each = math.ceil(count / most)
    padded = np.full(math.ceil(count / each) * each, np.nan)
    padded[:count] = bins.distances_m
    nearest = np.fmin.reduce(padded.reshape(-1, each), axis=1)
    return Bins(bins.first_rad + 0.5 * (each - 1) * bins.step_rad, each * bins.step_rad, nearest)


def pack(distances_m: Array) -> bytes:
    """Return distances (k,) m as they are on the bus; infinite: nothing is there; NaN: not measured."""
    near = distances_m <= FARTHEST_M  # NaN is not
    packed = np.where(np.isnan(distances_m), UNKNOWN, NOTHING)
    packed[near] = np.rint(1e3 * np.maximum(distances_m[near], 0.0))
    return packed.astype("<u2").tobytes()


def unpack(scan: SensorScan) -> Bins:
    """Return the rays of a scan of the bus; half of a ray at its end is left out."""
    packed = np.frombuffer(scan.distances, "<u2", len(scan.distances) // 2)
    distances_m = 1e-3 * packed
    distances_m[packed == NOTHING] = math.inf
    distances_m[packed == UNKNOWN] = math.nan
    return Bins(scan.first_rad, scan.step_rad, distances_m)


def sensor_at(scan: SensorScan) -> tuple[float, float, float] | None:
    """Return where a sensor was when it measured: x, y, heading in the world; None: the robot did not know."""
    if scan.robot_at is None:
        return None
    x_m, y_m, heading_rad = scan.robot_at
    ahead_m, left_m, turned_rad = scan.mount
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    return x_m + c * ahead_m - s * left_m, y_m + s * ahead_m + c * left_m, heading_rad + turned_rad
