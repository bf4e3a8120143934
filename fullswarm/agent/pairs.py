"""Who senses whom: the neighbour search, as a kernel."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fullswarm.kernels import kernel

Array = NDArray[np.float64]
Index = NDArray[np.int64]

BRUTE_FORCE_BELOW = 3000
"""Products n x heard below which trying all pairs beats sorting into cells."""


@kernel
def predict(
    heard: Array, arrival_s: Array, count: int, now_s: float, timeout_s: float, accel_m_s2: float, turn_rad_s: float,
    predicted: Array, spread_m: Array,
) -> None:  # fmt: skip
    """Move the heard states on to `now_s` along their heading; those older than `timeout_s` become NaN.

    How far off that may be grows with the square of the age: the others may have braked, sped up or turned.

    Parameters
    ----------
    heard : (m, 6) x, y (m), heading (rad), speed (m/s), turn rate (rad/s), radius (m)
    arrival_s : (m,) when each was heard, on this machine's clock
    accel_m_s2, turn_rad_s : what the others are believed to be able to
    predicted : (m, 2) out
    spread_m : (m,) out, how far from there they may be
    """
    for row in range(count):
        age_s = now_s - arrival_s[row]
        spread_m[row] = 0.5 * age_s * age_s * math.hypot(accel_m_s2, heard[row, 3] * turn_rad_s)
        if age_s > timeout_s:
            predicted[row, 0] = math.nan
            predicted[row, 1] = math.nan
        else:
            middle = heard[row, 2] + 0.5 * age_s * heard[row, 4]
            step_m = heard[row, 3] * age_s
            predicted[row, 0] = heard[row, 0] + step_m * math.cos(middle)
            predicted[row, 1] = heard[row, 1] + step_m * math.sin(middle)


@kernel
def all_pairs(
    position: Array, own_row: Index, predicted: Array, count: int, reach_m: float, start: Index, other: Index
) -> int:
    """Find the heard robots within `reach_m` of each own robot by trying all.

    Parameters
    ----------
    position : (n, 2) own positions
    own_row : (n,) row of each own robot among the heard ones, -1 if not heard
    start : (n + 1,) out: neighbours of robot i are ``other[start[i]:start[i + 1]]``
    other : (capacity,) out: rows among the heard

    Returns
    -------
    int
        How many pairs there are; more than the capacity means that `other` is too short.
    """
    found = 0
    capacity = other.shape[0]
    reach_squared = reach_m * reach_m
    for i in range(position.shape[0]):
        start[i] = min(found, capacity)
        x = position[i, 0]
        y = position[i, 1]
        mine = own_row[i]
        for row in range(count):
            dx = predicted[row, 0] - x
            dy = predicted[row, 1] - y
            if dx * dx + dy * dy <= reach_squared and row != mine:
                if found < capacity:
                    other[found] = row
                found += 1
    start[position.shape[0]] = min(found, capacity)
    return found


@kernel
def cell_pairs(
    position: Array, own_row: Index, predicted: Array, count: int, reach_m: float, start: Index, other: Index
) -> int:
    """Do what :func:`all_pairs` does in time linear in the swarm, by sorting into cells of `reach_m`."""
    low_x = math.inf
    low_y = math.inf
    high_x = -math.inf
    high_y = -math.inf
    for row in range(count):
        if not math.isnan(predicted[row, 0]):
            low_x = min(low_x, predicted[row, 0])
            high_x = max(high_x, predicted[row, 0])
            low_y = min(low_y, predicted[row, 1])
            high_y = max(high_y, predicted[row, 1])
    if low_x > high_x:
        start[:] = 0
        return 0
    # Cells no smaller than the reach, and no more of them than a few per robot.
    side = max(reach_m, max(high_x - low_x, high_y - low_y) / (2.0 * math.sqrt(count) + 1.0))
    columns = int((high_x - low_x) / side) + 1
    rows = int((high_y - low_y) / side) + 1
    begin = np.zeros(columns * rows + 1, np.int64)
    for row in range(count):
        if not math.isnan(predicted[row, 0]):
            cell = int((predicted[row, 1] - low_y) / side) * columns + int((predicted[row, 0] - low_x) / side)
            begin[cell + 1] += 1
    for cell in range(columns * rows):
        begin[cell + 1] += begin[cell]
    member = np.empty(count, np.int64)
    fill = begin[:-1].copy()
    for row in range(count):
        if not math.isnan(predicted[row, 0]):
            cell = int((predicted[row, 1] - low_y) / side) * columns + int((predicted[row, 0] - low_x) / side)
            member[fill[cell]] = row
            fill[cell] += 1
    found = 0
    capacity = other.shape[0]
    reach_squared = reach_m * reach_m
    for i in range(position.shape[0]):
        start[i] = min(found, capacity)
        x = position[i, 0]
        y = position[i, 1]
        first_column = max(0, int(math.floor((x - reach_m - low_x) / side)))
        last_column = min(columns - 1, int(math.floor((x + reach_m - low_x) / side)))
        first_row = max(0, int(math.floor((y - reach_m - low_y) / side)))
        last_row = min(rows - 1, int(math.floor((y + reach_m - low_y) / side)))
        for cell_row in range(first_row, last_row + 1):
            for column in range(first_column, last_column + 1):
                cell = cell_row * columns + column
                for k in range(begin[cell], begin[cell + 1]):
                    row = member[k]
                    dx = predicted[row, 0] - x
                    dy = predicted[row, 1] - y
                    if dx * dx + dy * dy <= reach_squared and row != own_row[i]:
                        if found < capacity:
                            other[found] = row
                        found += 1
    start[position.shape[0]] = min(found, capacity)
    return found


@kernel
def describe(
    position: Array, start: Index, other: Index, predicted: Array, heard: Array, of: Index, offset: Array,
    distance: Array, heading: Array,
) -> None:  # fmt: skip
    """Fill what a law may know of each edge: whose it is, offset (e, 2), distance (e,), neighbour's heading (e,)."""
    for i in range(position.shape[0]):
        for edge in range(start[i], start[i + 1]):
            row = other[edge]
            dx = predicted[row, 0] - position[i, 0]
            dy = predicted[row, 1] - position[i, 1]
            of[edge] = i
            offset[edge, 0] = dx
            offset[edge, 1] = dy
            distance[edge] = math.sqrt(dx * dx + dy * dy)
            heading[edge] = heard[row, 2]


@kernel
def fold(start: Index, values: Array, total: Array) -> None:
    """Add up edge values (e, 2) per robot into `total` (n, 2)."""
    for i in range(total.shape[0]):
        x = 0.0
        y = 0.0
        for edge in range(start[i], start[i + 1]):
            x += values[edge, 0]
            y += values[edge, 1]
        total[i, 0] = x
        total[i, 1] = y
