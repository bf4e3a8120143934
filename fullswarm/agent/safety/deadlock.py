"""Robots that block each other: noticed while they run, and led around each other.

A certificate keeps robots apart and nothing else: in a symmetric meeting all of them stand for ever, each waiting for
the others (every certificate does that; Wang, Ames, Egerstedt 2017, V). A robot that wishes to move and has made
neither way nor turn for `BLOCKED_S` steps aside: for a while its wish is turned to the right, by an angle and for a
time drawn at random, because a fixed angle only finds the next symmetry. The turned wish still passes through the
filter, so nothing that it promises is given up.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fullswarm.geometry import wrap
from fullswarm.kernels import Array, kernel

Counts = NDArray[np.int64]

BLOCKED_S = 1.0
WAY_SHARE = 0.15
"""A robot that makes less than this share of the way that it wishes is blocked, if it does not turn either."""
TURN_RAD = 0.15
TURNING_S = 7.0
"""A robot that turns but makes no way for so long is blocked too: half a turn at 0.5 rad/s takes 6 s."""
ANGLE_RAD = (1.0, 2.6)
ASIDE_S = (1.0, 3.0)
IDLE_SHARE = 0.05
"""A wish below this share of the speed limit is no wish to go anywhere."""


@kernel
def chance(seed: int, draw: int) -> float:
    """Return a number in [0, 1): the same for the same robot and draw, on every machine."""
    mixed = (seed % 2147483647 + draw * 69621) % 2147483647
    for _ in range(3):  # Lehmer's generator; products stay far below 2^63, also as NumPy numbers
        mixed = mixed * 48271 % 2147483647
        mixed ^= mixed >> 11
    return mixed % 1048576 / 1048576.0


@kernel
def step_aside(
    now_s: float, wished: Array, filtered: NDArray[np.bool_], pose: Array, speed_limit: Array, seed: Counts,
    anchor: Array, since_s: Array, place: Array, placed_s: Array, until_s: Array, angle: Array, draws: Counts,
) -> None:  # fmt: skip
    """Turn the wishes (n, 2) of robots that are blocked; see the module.

    Parameters
    ----------
    anchor, since_s : (n, 3), (n,) pose at which the robot last made way or turned, and when
    place, placed_s : (n, 2), (n,) where it last made way, and when
    until_s : (n,) until when it steps aside
    angle, draws : (n,) by how much; how often it has done so
    """
    for i in range(wished.shape[0]):
        x = wished[i, 0]
        y = wished[i, 1]
        size = min(math.hypot(x, y), speed_limit[i])
        if not filtered[i] or not size > IDLE_SHARE * speed_limit[i]:
            since_s[i] = now_s
            until_s[i] = -math.inf
            anchor[i, 0] = pose[i, 0]
            anchor[i, 1] = pose[i, 1]
            anchor[i, 2] = pose[i, 2]
            placed_s[i] = -math.inf
            continue
        way = math.hypot(pose[i, 0] - anchor[i, 0], pose[i, 1] - anchor[i, 1])
        turned = math.fabs(wrap(pose[i, 2] - anchor[i, 2]))
        aside = now_s < until_s[i]
        new = since_s[i] == -math.inf
        gone = math.hypot(pose[i, 0] - place[i, 0], pose[i, 1] - place[i, 1])
        if aside or placed_s[i] == -math.inf or gone > WAY_SHARE * size * BLOCKED_S:
            placed_s[i] = now_s
            place[i, 0] = pose[i, 0]
            place[i, 1] = pose[i, 1]
        turns_only = now_s - placed_s[i] >= TURNING_S
        if aside or new or (not turns_only and (way > WAY_SHARE * size * BLOCKED_S or turned > TURN_RAD)):
            since_s[i] = now_s
            anchor[i, 0] = pose[i, 0]
            anchor[i, 1] = pose[i, 1]
            anchor[i, 2] = pose[i, 2]
        elif turns_only or now_s - since_s[i] >= BLOCKED_S:
            draws[i] += 1
            angle[i] = ANGLE_RAD[0] + (ANGLE_RAD[1] - ANGLE_RAD[0]) * chance(seed[i], 2 * draws[i])
            until_s[i] = now_s + ASIDE_S[0] + (ASIDE_S[1] - ASIDE_S[0]) * chance(seed[i], 2 * draws[i] + 1)
            aside = True
        if aside:
            c = math.cos(angle[i])
            s = math.sin(angle[i])
            wished[i, 0] = c * x + s * y
            wished[i, 1] = -s * x + c * y


class Deadlocks:
    """What `step_aside` remembers of n robots.

    Attributes
    ----------
    draws : (n,) how often a robot was found blocked since the start
    until_s : (n,) until when it steps aside
    """

    def __init__(self, ids: Sequence[str]) -> None:
        count = len(ids)
        self.seed = np.array([zlib.crc32(robot.encode()) for robot in ids], np.int64)
        self.anchor = np.zeros((count, 3))
        self.since_s = np.full(count, -math.inf)
        self.place = np.zeros((count, 2))
        self.placed_s = np.full(count, -math.inf)
        self.until_s = np.full(count, -math.inf)
        self.angle = np.zeros(count)
        self.draws = np.zeros(count, np.int64)

    def resolve(
        self, now_s: float, wished: Array, filtered: NDArray[np.bool_], pose: Array, speed_limit: Array
    ) -> None:
        """Turn the wishes of robots that are blocked."""
        step_aside.run(
            now_s, wished, filtered, pose, speed_limit, self.seed, self.anchor, self.since_s, self.place,
            self.placed_s, self.until_s, self.angle, self.draws,
        )  # fmt: skip
