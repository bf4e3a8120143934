"""The neighbour search, as a kernel: which robots sense each other."""

from __future__ import annotations

import math

import numpy as np

from fullswarm.kernels import Array, Index, kernel

BRUTE_FORCE_BELOW = 3000
"""Products n x heard below which trying all pairs beats sorting into cells."""


@kernel
def predict(
    heard: Array, arrival_s: Array, count: int, now_s: float, timeout_s: float, halt_s: float, accel_m_s2: float,
    speed_m_s: float, turn_rad_s: float, predicted: Array, places: Array, spread_m: Array, blur_m: Array,
) -> int:  # fmt: skip
    """Move the heard states on to `now_s`; return how many robots are silent: older than `timeout_s`.

    How far off the prediction may be grows with the square of the age (another acceleration than predicted), but a
    robot is never farther from where it was heard than its speed and the time allow: the smaller disc counts. A
    silent robot is one that stands or is about to: its disc grows until `halt_s` and then stays, for ever.

    Parameters
    ----------
    heard : (m, 6) x, y (m), heading (rad), speed (m/s), turn rate (rad/s), radius (m)
    arrival_s : (m,) when each was heard, on this machine's clock; -inf: never, or forgotten
    halt_s : after so long a robot that fell silent stands
    accel_m_s2, speed_m_s, turn_rad_s : what the others are believed to be able to
    predicted : (m, 2) out, NaN for silent robots
    places, spread_m : (m, 2), (m,) out, centre and radius of the disc that holds the robot's centre
    blur_m : (m,) out, by how much its direction is unknown: the spread, but 0 for a silent robot, which is kept off
        like a wall, so that a robot inside its disc may leave it
    """
    silent = 0
    for row in range(count):
        age_s = max(now_s - arrival_s[row], 0.0)
        if math.isinf(age_s):
            predicted[row, 0] = math.nan
            predicted[row, 1] = math.nan
            places[row, 0] = math.nan
            places[row, 1] = math.nan
            spread_m[row] = 0.0
            blur_m[row] = 0.0
            continue
        speed = heard[row, 3]
        rate = heard[row, 4]
        moved_s = min(age_s, halt_s)
        fastest = max(speed_m_s, math.fabs(speed))
        gained = min(math.fabs(speed) + accel_m_s2 * moved_s, fastest)
        sideways = gained * turn_rad_s
        strongest = math.sqrt(accel_m_s2 * accel_m_s2 + sideways * sideways) + math.fabs(speed * rate)
        near_prediction_m = 0.5 * moved_s * moved_s * strongest
        near_heard_m = fastest * moved_s
        middle = heard[row, 2] + 0.5 * age_s * rate
        x = heard[row, 0] + speed * age_s * math.cos(middle)
        y = heard[row, 1] + speed * age_s * math.sin(middle)
        if age_s <= timeout_s:
            predicted[row, 0] = x
            predicted[row, 1] = y
        else:
            predicted[row, 0] = math.nan
            predicted[row, 1] = math.nan
            silent += 1
        if age_s <= timeout_s and near_prediction_m < near_heard_m:
            places[row, 0] = x
            places[row, 1] = y
            spread_m[row] = near_prediction_m
        else:
            if age_s > halt_s and accel_m_s2 > 0.0:
                near_heard_m += 0.5 * fastest * fastest / accel_m_s2
            places[row, 0] = heard[row, 0]
            places[row, 1] = heard[row, 1]
            spread_m[row] = near_heard_m
        blur_m[row] = spread_m[row] if age_s <= timeout_s else 0.0
    return silent


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
def keep_team(start: Index, other: Index, own_team: Index, teams: Index) -> None:
    """Drop from the edge list robots that are not of a robot's own team.

    Parameters
    ----------
    start, other : as `all_pairs` fills them; both are rewritten in place
    own_team : (n,) team of each own robot; 0: it keeps all its neighbours
    teams : (m,) team of each robot heard
    """
    kept = 0
    for i in range(own_team.shape[0]):
        first = start[i]
        start[i] = kept
        mine = own_team[i]
        for edge in range(first, start[i + 1]):
            row = other[edge]
            if mine == 0 or teams[row] == mine:
                other[kept] = row
                kept += 1
    start[own_team.shape[0]] = kept


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
