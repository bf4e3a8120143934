"""Judges whether each robot is at standstill, by its odometry and its measured velocity, over its make's window.

One judgement for health reports and e-stop receipts. A velocity alone does not tell: the filter of an autopilot shows
0.05 m/s of a vehicle that stands, and may show none of one that creeps; its position does not wander as fast.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fullswarm.drivers.base import Description, FleetReading
from fullswarm.geometry import wrap
from fullswarm.kernels import Array, Flags, kernel

# Columns of what is known of a make, and of a remembered reading.
SPEED, TURN, WINDOW, WAY, ANGLE = range(5)
STAMP, X, Y, HEADING, LINEAR, ANGULAR = range(6)
ROUNDING_S = 1e-6


class Standstill:
    """Remembers as many readings of each robot as its make's window needs.

    Parameters
    ----------
    rate_hz : readings are taken in so often at most

    Attributes
    ----------
    standing : (n,) the newest readings show a robot that stands; True before the first
    since_s : (n,) stamp of the oldest reading on which that rests; inf while it is False
    """

    def __init__(self, makes: Sequence[Description], rate_hz: float) -> None:
        count, noise = len(makes), [each.standstill for each in makes]
        self._makes = np.array(
            [[each.speed_m_s, each.turn_rad_s, each.window_s, each.way_m, each.angle_rad] for each in noise]
        ).reshape(count, 5)
        depth = 2 + math.ceil(max((each.window_s for each in noise), default=0.0) * rate_hz)
        self._past = np.full((count, depth, 6), -math.inf)
        self._newest, self._held = np.zeros(count, np.int64), np.zeros(count, np.int64)
        self.standing = np.ones(count, bool)
        self.since_s = np.full(count, math.inf)

    def look(self, reading: FleetReading) -> None:
        """Take in the newest readings; one that was seen before changes nothing."""
        judge.run(
            reading.stamp_s, reading.odometry, reading.twist, self._makes, self._past, self._newest, self._held,
            self.standing, self.since_s,
        )  # fmt: skip


@kernel
def judge(
    stamp_s: Array, odometry: Array, twist: Array, makes: Array, past: Array, newest: NDArray[np.int64],
    held: NDArray[np.int64], standing: Flags, since_s: Array,
) -> None:  # fmt: skip
    """Fill `standing` and `since_s` (n,); `past` (n, k, 6) is a ring of readings, `newest` the place of the last."""
    depth = past.shape[1]
    for i in range(stamp_s.shape[0]):
        if not stamp_s[i] > past[i, newest[i], STAMP]:
            continue
        head = (newest[i] + 1) % depth
        newest[i] = head
        held[i] = min(held[i] + 1, depth)
        past[i, head, STAMP] = stamp_s[i]
        past[i, head, X] = odometry[i, 0]
        past[i, head, Y] = odometry[i, 1]
        past[i, head, HEADING] = odometry[i, 2]
        past[i, head, LINEAR] = twist[i, 0]
        past[i, head, ANGULAR] = twist[i, 1]
        rests = False
        speed = 0.0
        turn = 0.0
        count = 0
        oldest_s = stamp_s[i]
        for back in range(held[i]):
            at = (head - back) % depth
            way_m = math.hypot(past[i, at, X] - odometry[i, 0], past[i, at, Y] - odometry[i, 1])
            if not way_m <= makes[i, WAY] or math.fabs(wrap(past[i, at, HEADING] - odometry[i, 2])) > makes[i, ANGLE]:
                break
            speed += past[i, at, LINEAR]
            turn += past[i, at, ANGULAR]
            count += 1
            oldest_s = past[i, at, STAMP]
            if stamp_s[i] - oldest_s >= makes[i, WINDOW] - ROUNDING_S:
                rests = True
                break
        if rests:
            rests = math.fabs(speed) < makes[i, SPEED] * count and math.fabs(turn) < makes[i, TURN] * count
        standing[i] = rests
        since_s[i] = oldest_s if rests else math.inf
