"""Tracks what moves and is no robot that is received: people, carts, robots without an agent or fallen silent.

In: bodies that the robots see (``Reading.bodies``), and objects whose places a source outside tells (``ObjectFix``).
A seen body where a received robot is reported is that robot, and is left out here. The others are tracked: place and
velocity, by an alpha-beta filter with gating. Out: :class:`Objects`, which the safety filter keeps off alone (an object
does not keep its half of a gap) and which evasion moves out of the way of.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fullswarm.agent.neighbours.estimates import Neighbours
from fullswarm.agent.neighbours.silent import SPARE_M, in_sight
from fullswarm.kernels import Array, Index
from fullswarm.messages import ObjectFix

MOST = 64
"""Objects tracked at most; the nearest to the robots are kept."""
GATE_M = 0.15
"""A seen body is an object that was predicted to be so near, and farther by what its speed may have changed."""
SAME_M = 0.15
"""A seen body so near to where a received robot may be is that robot. Two bodies are never as near as that."""
SETTLE_S = 0.3
"""For so long after an object was seen first its velocity is not known: any up to the assumed limit is possible."""
MISSED_S = 0.3
"""One that is not seen for so long although nothing hides its place has gone."""
LOST_S = 1.0
"""An object that is not seen any more is expected on its way for so long."""
STILL_LOST_S = 10.0
"""One that stood is expected in its place for so long."""
STILL_M_S = 0.1
UNSURE_M_S = 0.1
"""By so much a tracked velocity may be wrong."""
ALPHA, BETA = 0.4, 0.1
"""Of the filter, per look at `LOOK_S`; its velocity follows within about 0.2 s."""
LOOK_S = 0.02


class Objects(NamedTuple):
    """The objects that the filter keeps off, in arrays of `MOST` rows of which the first `used[0]` are used.

    `rows`: (MOST, 6) x, y (m), vx, vy (m/s), radius (m), by how much the velocity may be wrong (m/s).
    `limits`: (2,) assumed greatest speed (m/s) and acceleration (m/s²) of any object.
    """

    rows: Array
    used: Index
    limits: Array


def no_objects() -> Objects:
    """Return room for objects, with none in it."""
    return Objects(np.zeros((MOST, 6)), np.zeros(1, np.int64), np.zeros(2))


@dataclass(slots=True)
class Track:
    """One object: where it is at `time_s`, its velocity, since when it is known, when it was seen last."""

    x_m: float
    y_m: float
    radius_m: float
    time_s: float
    born_s: float
    seen_s: float
    vx: float = 0.0
    vy: float = 0.0

    def predict(self, now_s: float) -> None:
        """Move it on to `now_s`."""
        dt_s = now_s - self.time_s
        self.x_m, self.y_m, self.time_s = self.x_m + dt_s * self.vx, self.y_m + dt_s * self.vy, now_s

    def correct(self, x_m: float, y_m: float, radius_m: float, now_s: float, speed_limit: float) -> None:
        """Take in where it was seen; it was predicted to now."""
        dt_s = max(now_s - self.seen_s, 1e-3)
        # A filter of rare looks trusts each one more.
        looks = max(1.0, dt_s / LOOK_S)
        alpha = 1.0 - (1.0 - ALPHA) ** looks
        beta = min(1.0, BETA * looks)
        off_x, off_y = x_m - self.x_m, y_m - self.y_m
        self.x_m, self.y_m = self.x_m + alpha * off_x, self.y_m + alpha * off_y
        self.vx, self.vy = self.vx + beta * off_x / dt_s, self.vy + beta * off_y / dt_s
        speed = math.hypot(self.vx, self.vy)
        if speed > speed_limit:
            self.vx, self.vy = self.vx * speed_limit / speed, self.vy * speed_limit / speed
        self.radius_m, self.seen_s = max(radius_m, 0.9 * self.radius_m), now_s

    def lost(self, now_s: float) -> bool:
        """Tell whether it was not seen for too long to be expected anywhere."""
        still = math.hypot(self.vx, self.vy) < STILL_M_S
        return now_s - self.seen_s > (STILL_LOST_S if still else LOST_S)


class ObjectTracker:
    """The objects around the robots of one agent.

    Parameters
    ----------
    range_m : how far the robots see bodies
    speed_m_s, accel_m_s2 : assumed limits of any object

    Attributes
    ----------
    objects : as of the last `update`; the same arrays at all times
    any : there is an object, or has been at the last `update`
    obstacles : (b, 6) what hides bodies; set by the owner
    """

    def __init__(self, neighbours: Neighbours, range_m: float, speed_m_s: float, accel_m_s2: float) -> None:
        self._neighbours, self._range_m = neighbours, range_m
        self.obstacles = np.zeros((0, 6))
        self.any = False
        self.objects = no_objects()
        self.objects.limits[:] = speed_m_s, accel_m_s2
        self._tracks: list[Track] = []
        self._told: dict[str, Track] = {}
        self._stamp_s = -math.inf

    def tell(self, fix: ObjectFix, now_s: float) -> None:
        """Take in the place of an object from a source outside."""
        track = self._told.get(fix.object)
        if track is None:
            self.any = True
            if len(self._told) < MOST:
                self._told[fix.object] = Track(fix.x_m, fix.y_m, fix.radius_m, now_s, now_s, now_s)
            return
        track.predict(now_s)
        track.correct(fix.x_m, fix.y_m, fix.radius_m, now_s, float(self.objects.limits[0]))

    def update(self, now_s: float, pose: Array, bodies: Array | None, stamp_s: float) -> None:
        """Take in the bodies (k, 3) that the robots at `pose` (n, 3) saw at `stamp_s`, and predict all to `now_s`.

        None: they did not look. A look is used once.
        """
        if bodies is not None and stamp_s > self._stamp_s:
            self._stamp_s = stamp_s
            strange = self.strange(bodies, now_s)
            if self._tracks or strange.any():
                self._see(stamp_s, pose[:, :2], bodies, strange)
        if self._tracks or self._told or self.any:
            self._publish(now_s, pose[:, :2])

    def strange(self, bodies: Array, now_s: float) -> NDArray[np.bool_]:
        """Tell which of `bodies` (k, 3) are no received robot."""
        strange = np.ones(len(bodies), bool)
        table = self._neighbours
        heard = np.flatnonzero(table.heard(now_s))
        if not len(heard) or not len(bodies):
            return strange
        table.refresh(now_s)
        places, spread_m = table.places[heard], table.spread_m[heard]
        away_m = np.hypot(bodies[:, None, 0] - places[None, :, 0], bodies[:, None, 1] - places[None, :, 1])
        nearest = away_m.argmin(axis=0)  # a robot is one body
        found = away_m[nearest, np.arange(len(heard))] <= SAME_M + spread_m
        strange[nearest[found]] = False
        return strange

    def _see(self, now_s: float, position: Array, bodies: Array, strange: NDArray[np.bool_]) -> None:
        speed_limit, accel = self.objects.limits.tolist()
        for track in self._tracks:
            track.predict(now_s)
        left = bodies[strange].tolist()
        pairs = sorted(
            (math.hypot(track.x_m - x, track.y_m - y), at, row)
            for at, track in enumerate(self._tracks) for row, (x, y, _) in enumerate(left)
        )  # fmt: skip
        used, taken = set[int](), set[int]()
        for away_m, at, row in pairs:
            if at in used or row in taken:
                continue
            track = self._tracks[at]
            age_s = now_s - track.seen_s
            fresh_m = speed_limit * age_s if now_s - track.born_s < SETTLE_S else 0.5 * accel * age_s * age_s
            if away_m <= GATE_M + fresh_m:
                x, y, radius = left[row]
                track.correct(x, y, radius, now_s, speed_limit)
                used.add(at)
                taken.add(row)
        self._tracks += [
            Track(x, y, radius, now_s, now_s, now_s) for row, (x, y, radius) in enumerate(left) if row not in taken
        ]
        known = bodies[~strange]
        self._tracks = [track for track in self._tracks if not self._gone(track, now_s, position, bodies, known)]

    def _gone(self, track: Track, now_s: float, position: Array, bodies: Array, known: Array) -> bool:
        """Tell whether an object that was not seen is not there any more, or was a robot that is received now."""
        unseen_s = now_s - track.seen_s
        if unseen_s <= 0.0:
            return False
        apart_m = np.hypot(known[:, 0] - track.x_m, known[:, 1] - track.y_m)
        if track.lost(now_s) or bool((apart_m < 0.8 * (known[:, 2] + track.radius_m)).any()):
            return True
        if unseen_s <= MISSED_S:
            return False
        at, range_m = np.array([[track.x_m, track.y_m]]), self._range_m - SPARE_M
        eyes = position[np.isfinite(position).all(axis=1)]
        return any(bool(in_sight(eye, at, range_m, bodies, self.obstacles)[0]) for eye in eyes)

    def _publish(self, now_s: float, position: Array) -> None:
        self._told = {name: track for name, track in self._told.items() if not track.lost(now_s)}
        told = list(self._told.values())
        # One that is seen and told of is one object, and the one that is told has a name and no one to hide behind.
        seen = [
            track for track in self._tracks
            if not any(math.hypot(track.x_m - each.x_m, track.y_m - each.y_m) < each.radius_m for each in told)
        ]  # fmt: skip
        tracks = [track for track in (*told, *seen) if not track.lost(now_s)]
        if len(tracks) > MOST:
            known = position[np.isfinite(position).all(axis=1)]
            away = [float(np.hypot(*(known - (each.x_m, each.y_m)).T).min(initial=math.inf)) for each in tracks]
            tracks = [tracks[at] for at in np.argsort(away, kind="stable")[:MOST].tolist()]
        rows = self.objects.rows
        speed_limit, accel = self.objects.limits.tolist()
        for at, track in enumerate(tracks):
            age_s = max(0.0, now_s - track.time_s)
            unseen_s = max(0.0, now_s - track.seen_s)
            settled = track.seen_s - track.born_s >= SETTLE_S
            rows[at, 0] = track.x_m + age_s * track.vx
            rows[at, 1] = track.y_m + age_s * track.vy
            rows[at, 2], rows[at, 3] = track.vx, track.vy
            unsure_m_s = UNSURE_M_S if settled else speed_limit
            # Where it may have got to since it was seen, other than on its way.
            rows[at, 4] = track.radius_m + min(unsure_m_s + 0.5 * accel * unseen_s, 2.0 * speed_limit) * unseen_s
            rows[at, 5] = min(unsure_m_s + accel * unseen_s, 2.0 * speed_limit)
        self.objects.used[0] = len(tracks)
        self.any = bool(tracks or self._tracks or self._told)
