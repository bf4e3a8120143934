"""Resolves deadlocks: detects robots that block each other, and has them sidestep.

A certificate keeps robots apart and nothing else: in a symmetric meeting all of them stop for ever, each waiting for
the others (every certificate does that; Wang, Ames, Egerstedt 2017, V). A robot that is to move and has neither moved
nor turned for `BLOCKED_S` sidesteps: its desired velocity is turned to the right, by an angle and for a time drawn at
random, because a fixed angle only finds the next symmetry. The turned velocity still passes through the filter, so all
its guarantees hold.

Noise of a pose is no motion: a pose that is 3 cm off, now this way and now that, covers metres in a second. So motion
is judged by the odometry, corrected by the pose so slowly (`CORRECTED_S`) that a twentieth of its noise is left, and by
more than `NOISE_SIGMAS` of what is left. How noisy the pose is shows in its distance from the corrected odometry.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from fullswarm.geometry import wrap
from fullswarm.kernels import Array, Flags, Index, bound, kernel, views

BLOCKED_S = 1.0
WAY_SHARE = 0.15
"""A robot that covers less than this share of the desired distance is blocked, if it does not turn either."""
TURN_RAD = 0.15
TURNING_S = 7.0
"""A robot that turns but does not move for so long is blocked too: half a turn at 0.5 rad/s takes 6 s."""
ANGLE_RAD = (1.0, 2.6)
SIDESTEP_S = (1.0, 3.0)
CORRECTED_S = 2.0
"""Time constant with which the odometry follows the pose; wheels that slip are found out in that time."""
LONGEST_S = 0.1
"""One step of it counts for no longer."""
JUMP_M = 0.5
"""A pose farther from the corrected odometry is a new one: the robot was carried, or its estimator began anew."""
NOISE_SIGMAS = 4.0
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
    where it last moved, and when. `smooth`, `smooth_s`: (n, 4), (n,) the odometry, corrected by the pose: x, y,
    heading, and the variance of the pose around it in m²; and when that was. `until_s`, `angle`: (n,) until when it
    sidesteps, and by how much. `deadlocks`: (n,) how often it has. `seed`: (n,) of its angles and times.
    """

    anchor: Array
    since_s: Array
    place: Array
    placed_s: Array
    smooth: Array
    smooth_s: Array
    until_s: Array
    angle: Array
    deadlocks: Index
    seed: Index


@kernel
def follow(i: int, now_s: float, pose: Array, twist: Array, smooth: Array, smooth_s: Array) -> float:
    """Advance the corrected odometry of robot `i`; return the standard deviation of its position, m."""
    passed_s = min(max(now_s - smooth_s[i], 0.0), LONGEST_S)
    smooth_s[i] = now_s
    share = passed_s / CORRECTED_S
    turn = twist[i, 1] * passed_s
    way = twist[i, 0] * passed_s
    heading = smooth[i, 2] + 0.5 * turn
    dx = pose[i, 0] - (smooth[i, 0] + way * math.cos(heading))
    dy = pose[i, 1] - (smooth[i, 1] + way * math.sin(heading))
    off_m2 = dx * dx + dy * dy
    if not off_m2 <= JUMP_M * JUMP_M:  # also when either is not known
        smooth[i, 0] = pose[i, 0]
        smooth[i, 1] = pose[i, 1]
        smooth[i, 2] = pose[i, 2]
        smooth[i, 3] = 0.0
        return 0.0
    smooth[i, 0] = pose[i, 0] - (1.0 - share) * dx
    smooth[i, 1] = pose[i, 1] - (1.0 - share) * dy
    smooth[i, 2] = wrap(smooth[i, 2] + turn + share * wrap(pose[i, 2] - smooth[i, 2] - turn))
    smooth[i, 3] += share * (0.5 * off_m2 - smooth[i, 3])
    return math.sqrt(0.5 * share * smooth[i, 3])


@kernel
def sidestep(
    progress: Progress, now_s: float, desired: Array, filtered: Flags, pose: Array, twist: Array, speed_limit: Array
) -> None:
    """Turn the desired velocities (n, 2) of robots that are blocked; see the module."""
    anchor, since_s, place, placed_s, smooth, smooth_s, until_s, angle, count, seed = progress
    for i in range(desired.shape[0]):
        x = desired[i, 0]
        y = desired[i, 1]
        size = min(math.hypot(x, y), speed_limit[i])
        sigma_m = follow(i, now_s, pose, twist, smooth, smooth_s)
        at_x = smooth[i, 0]
        at_y = smooth[i, 1]
        at_heading = smooth[i, 2]
        if not filtered[i] or not size > IDLE_SHARE * speed_limit[i]:
            since_s[i] = now_s
            until_s[i] = -math.inf
            anchor[i, 0] = at_x
            anchor[i, 1] = at_y
            anchor[i, 2] = at_heading
            placed_s[i] = -math.inf
            continue
        way = math.hypot(at_x - anchor[i, 0], at_y - anchor[i, 1])
        turned = math.fabs(wrap(at_heading - anchor[i, 2]))
        moved_m = max(WAY_SHARE * size * BLOCKED_S, NOISE_SIGMAS * sigma_m)
        sidestepping = now_s < until_s[i]
        new = since_s[i] == -math.inf
        gone = math.hypot(at_x - place[i, 0], at_y - place[i, 1])
        if sidestepping or placed_s[i] == -math.inf or gone > moved_m:
            placed_s[i] = now_s
            place[i, 0] = at_x
            place[i, 1] = at_y
        turns_only = now_s - placed_s[i] >= TURNING_S
        if sidestepping or new or (not turns_only and (way > moved_m or turned > TURN_RAD)):
            since_s[i] = now_s
            anchor[i, 0] = at_x
            anchor[i, 1] = at_y
            anchor[i, 2] = at_heading
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
            smooth=np.full((count, 4), math.nan),
            smooth_s=np.zeros(count),
            until_s=self.sidestep_until_s,
            angle=np.zeros(count),
            deadlocks=self.deadlock_count,
            seed=np.array([zlib.crc32(robot.encode()) for robot in ids], np.int64),
        )
        progress = views(self.progress) if sidestep.run is sidestep.plain else self.progress
        self._sidestep = bound(partial(sidestep.run, progress))

    def resolve(
        self, now_s: float, desired: Array, filtered: Flags, pose: Array, twist: Array, speed_limit: Array
    ) -> None:
        """Turn the desired velocities of robots that are blocked; `twist` (n, 2) is the measured one."""
        self._sidestep(now_s, desired, filtered, pose, twist, speed_limit)
