"""What commands that are given, but have no effect yet, will still do: for makes that state a dead time.

A command acts `dead_time_s` after it was given; until then the body carries out the ones before it, which nothing can
call back. :class:`Commands` keeps those of the last dead time and adds up what they will do. The filter then decides
for the motion at the time when its answer acts, with the rooms reduced by the way until then (``shorten``).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from fullswarm.geometry import clamp
from fullswarm.kernels import Array, Index, kernel, views

FOREVER_S = 1e9
"""Before the first command none was in force for so long."""


class Given(NamedTuple):
    """The set-points that were in force, as rings of k; the newest is at `newest` (1,).

    `speed`, `turn`: (k, n) m/s and rad/s, as a body can follow them: it brakes with its limits. `since_s`, `until_s`:
    (k,) when each was in force. `speed_now`, `turn_now`: (n,) of the newest.
    """

    speed: Array
    turn: Array
    speed_now: Array
    turn_now: Array
    since_s: Array
    until_s: Array
    newest: Index


class Underway(NamedTuple):
    """What the body will have done when a command that is given now has its first effect; (n,) each.

    `speed`, `turn`: m/s and rad/s then. `fastest`: m/s, the greatest until then. `turned`: rad, change of the heading.
    `x`, `y`: m, displacement in the frame of the heading now; `way`: m, length of the path; `swing`: rad, how much it
    turns to and fro on it. `reverses`: 1 if it changes its direction, else 0. `unsure`: rad by which `turned` may be
    off: the dead time began within a command, all of which is in `way`.
    """

    speed: Array
    turn: Array
    fastest: Array
    turned: Array
    x: Array
    y: Array
    way: Array
    swing: Array
    reverses: Array
    unsure: Array


@kernel
def follow(now: float, wanted: float, most: float) -> float:
    """Return what a body that was at `now` is at when `wanted` ends: at least that, and it loses `most` at most."""
    if wanted * now >= 0.0 and math.fabs(wanted) >= math.fabs(now):
        return wanted
    return clamp(wanted, now - most, now + most)


@kernel
def keep(
    given: Given, applied: Array, accel: Array, turn_accel: Array, since_s: float, now_s: float, least_s: float
) -> None:
    """Take in the set-points `applied` (n, 2) that were in force from `since_s` until now.

    Those that follow an entry shorter than `least_s` are averaged with it.
    """
    passed_s = now_s - since_s
    at = given.newest[0]
    before_s = given.until_s[at] - given.since_s[at]
    if before_s >= least_s:
        at = (at + 1) % given.speed.shape[0]
        before_s = 0.0
        given.since_s[at] = since_s
    share = passed_s / (before_s + passed_s)
    for i in range(applied.shape[0]):
        speed = follow(given.speed_now[i], applied[i, 0], accel[i] * passed_s)
        most = turn_accel[i] * passed_s
        turn = clamp(applied[i, 1], given.turn_now[i] - most, given.turn_now[i] + most)
        given.speed[at, i] = speed if share == 1.0 else (1.0 - share) * given.speed[at, i] + share * speed
        given.turn[at, i] = turn if share == 1.0 else (1.0 - share) * given.turn[at, i] + share * turn
        given.speed_now[i] = speed
        given.turn_now[i] = turn
    given.until_s[at] = now_s
    given.newest[0] = at


@kernel
def carry_on(given: Given, dead_time_s: Array, now_s: float, out: Underway) -> None:
    """Fill `out` with what the set-points of the last dead time will do."""
    entries = given.speed.shape[0]
    newest = given.newest[0]
    for i in range(dead_time_s.shape[0]):
        out.speed[i] = given.speed_now[i]
        out.turn[i] = given.turn_now[i]
        back = 0
        # Entries that were in force before the dead time began have had their effect.
        while back < entries and given.until_s[(newest - back) % entries] > now_s - dead_time_s[i] + 1e-6:
            back += 1
        heading = 0.0
        x = 0.0
        y = 0.0
        way = 0.0
        swing = 0.0
        fastest = 0.0
        unsure = 0.0
        ahead = False
        astern = False
        for step in range(back):
            entry = (newest - (back - 1 - step)) % entries
            lasted_s = given.until_s[entry] - given.since_s[entry]
            speed = given.speed[entry, i]
            over_s = clamp(now_s - dead_time_s[i] - given.since_s[entry], 0.0, lasted_s)
            unsure += math.fabs(given.turn[entry, i]) * over_s
            angle = given.turn[entry, i] * (lasted_s - over_s)
            middle = heading + 0.5 * angle
            x += speed * lasted_s * math.cos(middle)
            y += speed * lasted_s * math.sin(middle)
            heading += angle
            way += math.fabs(speed) * lasted_s
            swing += math.fabs(given.turn[entry, i]) * lasted_s
            fastest = max(fastest, math.fabs(speed))
            ahead = ahead or speed > 0.0
            astern = astern or speed < 0.0
        out.fastest[i] = fastest
        out.turned[i] = heading
        out.x[i] = x
        out.y[i] = y
        out.way[i] = way
        out.swing[i] = swing
        out.reverses[i] = 1.0 if ahead and astern else 0.0
        out.unsure[i] = unsure


@kernel
def expect(
    i: int, heading: float, speed: float, tolerance: float, dead_time_s: float, underway: Underway
) -> tuple[float, float, float, float, float, float, float]:
    """Return what robot `i` will be like when a command that is given now has its first effect.

    A body that is faster than its commands, by more than `tolerance`, does not do what it was told: then its measured
    speed counts, straight on.

    Returns
    -------
    tuple
        Speed (m/s), turn rate (rad/s) and heading then; displacement in x and y (m), length of the path (m), and the
        greatest speed on it (m/s).
    """
    cos = math.cos(heading)
    sin = math.sin(heading)
    then = heading + underway.turned[i]
    if math.fabs(speed) > underway.fastest[i] + tolerance:
        way = max(underway.way[i], math.fabs(speed) * dead_time_s)
        along = way if speed > 0.0 else -way
        return speed, underway.turn[i], then, along * cos, along * sin, way, math.fabs(speed)
    x = underway.x[i]
    y = underway.y[i]
    fastest = max(underway.fastest[i], math.fabs(speed))
    return underway.speed[i], underway.turn[i], then, cos * x - sin * y, sin * x + cos * y, underway.way[i], fastest


class Commands:
    """The commands of n robots that have no effect yet.

    Parameters
    ----------
    dead_time_s, accel, turn_accel : (n,) s, m/s², rad/s², as the makes state
    period_s : from tick to tick; some updates come between two

    Attributes
    ----------
    underway : (n,) each; zero for a robot without a dead time
    any : there is a robot with one
    """

    def __init__(self, dead_time_s: Array, accel: Array, turn_accel: Array, period_s: float) -> None:
        count, self._least_s = len(dead_time_s), 0.5 * period_s
        entries = 4 + math.ceil(2.0 * float(dead_time_s.max(initial=0.0)) / period_s)
        self._dead_time_s, self._accel, self._turn_accel = dead_time_s, accel, turn_accel
        self.any = bool((dead_time_s > 0.0).any())
        self._given = Given(
            speed=np.zeros((entries, count)), turn=np.zeros((entries, count)), speed_now=np.zeros(count),
            turn_now=np.zeros(count), since_s=np.full(entries, -FOREVER_S),
            until_s=np.full(entries, -0.5 * FOREVER_S), newest=np.zeros(1, np.int64),
        )  # fmt: skip
        self.underway = Underway(*np.zeros((len(Underway._fields), count)))
        self._viewed = views(self._given), views(self.underway)
        self._since_s = math.inf

    def update(self, applied: Array, now_s: float) -> None:
        """Take in the set-points `applied` (n, 2) since the last call: what was applied then holds until now."""
        if self._since_s < now_s:
            given, out = (self._given, self.underway) if keep.run is not keep.plain else self._viewed
            keep.run(given, applied, self._accel, self._turn_accel, self._since_s, now_s, self._least_s)
            carry_on.run(given, self._dead_time_s, now_s, out)
        self._since_s = now_s
