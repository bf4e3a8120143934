"""Resolves deadlocks: detects robots that block each other, and has them sidestep.

A certificate keeps robots apart and nothing else: in a symmetric meeting all of them stop for ever, each waiting for
the others (every certificate does that; Wang, Ames, Egerstedt 2017, V). A robot that is to move and has neither moved
nor turned for `BLOCKED_S` sidesteps: its desired velocity is turned to the right, by an angle and for a time drawn at
random, because a fixed angle only finds the next symmetry. The turned velocity still passes through the filter, so all
its guarantees hold.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from fullswarm.geometry import wrap
from fullswarm.kernels import Array, Flags, Index, bound, kernel

BLOCKED_S = 1.0
WAY_SHARE = 0.15
"""A robot that covers less than this share of the desired distance is blocked, if it does not turn either."""
TURN_RAD = 0.15
TURNING_S = 7.0
"""A robot that turns but does not move for so long is blocked too: half a turn at 0.5 rad/s takes 6 s."""
ANGLE_RAD = (1.0, 2.6)
SIDESTEP_S = (1.0, 3.0)
IDLE_SHARE = 0.05
"""A desired speed below this share of the speed limit counts as none."""


@kernel
def chance(seed: int, draw: int) -> float:
    """Return a number in [0, 1): the same for the same robot and draw, on every machine."""
    mixed = (seed % 2147483647 + draw * 69621) % 2147483647
    for _ in range(3):  # Lehmer's generator; products stay far below 2^63, also as NumPy numbers
        mixed = mixed * 48271 % 2147483647
        mixed ^= mixed >> 11
    return mixed % 1048576 / 1048576.0


class Progress(NamedTuple):
    """How far each robot has come.

    `anchor`, `since_s`: (n, 3), (n,) pose at which it last moved or turned, and when. `place`, `placed_s`: (n, 2), (n,)
    where it last moved, and when. `until_s`, `angle`: (n,) until when it sidesteps, and by how much. `deadlocks`: (n,)
    how often it has. `seed`: (n,) of its angles and times.
    """

    anchor: Array
    since_s: Array
    place: Array
    placed_s: Array
    until_s: Array
    angle: Array
    deadlocks: Index
    seed: Index


@kernel
def sidestep(
    progress: Progress, now_s: float, desired: Array, filtered: Flags, pose: Array, speed_limit: Array
) -> None:
    """Turn the desired velocities (n, 2) of robots that are blocked; see the module."""
    anchor, since_s, place, placed_s, until_s, angle, count, seed = progress
    for i in range(desired.shape[0]):
        x = desired[i, 0]
        y = desired[i, 1]
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
        sidestepping = now_s < until_s[i]
        new = since_s[i] == -math.inf
        gone = math.hypot(pose[i, 0] - place[i, 0], pose[i, 1] - place[i, 1])
        if sidestepping or placed_s[i] == -math.inf or gone > WAY_SHARE * size * BLOCKED_S:
            placed_s[i] = now_s
            place[i, 0] = pose[i, 0]
            place[i, 1] = pose[i, 1]
        turns_only = now_s - placed_s[i] >= TURNING_S
        if sidestepping or new or (not turns_only and (way > WAY_SHARE * size * BLOCKED_S or turned > TURN_RAD)):
            since_s[i] = now_s
            anchor[i, 0] = pose[i, 0]
            anchor[i, 1] = pose[i, 1]
            anchor[i, 2] = pose[i, 2]
        elif turns_only or now_s - since_s[i] >= BLOCKED_S:
            count[i] += 1
            angle[i] = ANGLE_RAD[0] + (ANGLE_RAD[1] - ANGLE_RAD[0]) * chance(seed[i], 2 * count[i])
            until_s[i] = now_s + SIDESTEP_S[0] + (SIDESTEP_S[1] - SIDESTEP_S[0]) * chance(seed[i], 2 * count[i] + 1)
            sidestepping = True
        if sidestepping:
            c = math.cos(angle[i])
            s = math.sin(angle[i])
            desired[i, 0] = c * x + s * y
            desired[i, 1] = -s * x + c * y


class Deadlocks:
    """Detects and resolves the deadlocks of n robots.

    Attributes
    ----------
    deadlock_count : (n,) how often a robot was found blocked since the start
    sidestep_until_s : (n,) until when it sidesteps
    """

    def __init__(self, ids: Sequence[str]) -> None:
        count = len(ids)
        self.sidestep_until_s = np.full(count, -math.inf)
        self.deadlock_count = np.zeros(count, np.int64)
        self.progress = Progress(
            anchor=np.zeros((count, 3)),
            since_s=np.full(count, -math.inf),
            place=np.zeros((count, 2)),
            placed_s=np.full(count, -math.inf),
            until_s=self.sidestep_until_s,
            angle=np.zeros(count),
            deadlocks=self.deadlock_count,
            seed=np.array([zlib.crc32(robot.encode()) for robot in ids], np.int64),
        )
        self._sidestep = bound(partial(sidestep.run, self.progress))

    def resolve(self, now_s: float, desired: Array, filtered: Flags, pose: Array, speed_limit: Array) -> None:
        """Turn the desired velocities of robots that are blocked."""
        self._sidestep(now_s, desired, filtered, pose, speed_limit)
