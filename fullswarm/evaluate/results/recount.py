"""Counts contacts, closest approaches, commands and arrivals of a trial again, from the arrays that it stored.

A second implementation, so that a mistake in the referee does not confirm itself: it imports NumPy and nothing of this
package (a contract of the linter), has its own geometry, and takes its input by the names of the stored arrays
(`fullswarm.evaluate.trial_folder.Evidence` defines them; ``docs/decisions/0032-evidence.md`` says why they suffice).

**What it cannot see.** Positions are stored at the ends of steps. A body that touched nothing in a step is taken to
have gone straight; on an arc with chord c that turns by φ it is up to c/2 tan(φ/4) off (the sagitta), a change of speed
from step to step by d moves it along its way by up to d/8, and rounding by 7 µm. The sum is the *bound* of this body in
this step. A gap that differs from the touching gap by less than the bounds of both bodies is *undecided*. Of a body
that touched something its way through the step is stored, and its bound is the rounding alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Ints = NDArray[np.int64]

GRAIN = 1e-5
UNKNOWN = 2_000_000_000
ROUNDING_M = GRAIN * math.sqrt(0.5)
"""Half a grain in each axis."""
FREE_S = 0.25
SPAN = 64
"""So many steps are looked at together: pairs too far from each other for all of them are left out."""
TOO_FEW = 1e-9
SAID = 5
"""Of each kind of contradiction so many are named."""


@dataclass(slots=True)
class Range:
    """A count: `most` includes what is undecided."""

    least: int = 0
    most: int = 0

    def holds(self, count: int) -> bool:
        """Return whether a count is possible."""
        return self.least <= count <= self.most

    def __str__(self) -> str:
        """Return it for people."""
        return str(self.least) if self.least == self.most else f"{self.least} to {self.most}"


@dataclass(slots=True)
class Recount:
    """What came out."""

    steps: int = 0
    end_s: float = 0.0
    robot_events: Range = field(default_factory=Range)
    obstacle_events: Range = field(default_factory=Range)
    mover_contacts: Range = field(default_factory=Range)  # whoever brought them about
    pushed_events: Range = field(default_factory=Range)  # of `robot_events`, those of pairs that a mover had touched
    pairs_touched: Range = field(default_factory=Range)
    robots_touched: Range = field(default_factory=Range)
    above_limits: int = 0
    commands_known: bool = True
    arrived: Range = field(default_factory=Range)
    all_there_s: list[tuple[float, float]] = field(default_factory=list)  # from when to when all were at their goals
    last_arrival_s: float = math.nan  # when the last of those that were there at the end came; NaN: none was
    closest_m: Floats = field(default_factory=lambda: np.zeros(0))  # (n (n - 1) / 2,)
    wall_m: Floats = field(default_factory=lambda: np.zeros((0, 0)))  # (n, k)
    time_to_contact_s: tuple[float, float] = (math.inf, math.inf)  # between these
    bound_m: Floats = field(default_factory=lambda: np.zeros(0))  # (n,) the largest of each robot
    detour_m: Floats = field(default_factory=lambda: np.zeros(0))  # (n,) how far stored ways are from straight ones
    undecided: int = 0  # pairs and steps that may or may not have been a contact
    contradictions: list[str] = field(default_factory=list)  # within the evidence


class Motion:
    """The stored motion in SI units: rows are steps."""

    def __init__(self, stored: Mapping[str, NDArray[Any]]) -> None:
        grains = np.cumsum(stored["xy"], axis=0, dtype=np.int32)
        self.grains = grains.astype(np.int64)
        self.xy: Floats = np.where(grains == UNKNOWN, np.nan, grains * GRAIN)
        heading = np.cumsum(stored["heading"], axis=0, dtype=np.int32) * GRAIN
        self.count, self.steps = grains.shape[1], max(0, len(grains) - 1)
        self.radius_m: Floats = stored["radius_m"].astype(float)
        self.step_s, self.touch_m = float(stored["step_s"]), float(stored["touch_m"])
        self.chord_m: Floats = np.hypot(*np.moveaxis(np.diff(self.xy, axis=0), 2, 0))
        turn = np.abs(np.diff(heading, axis=0))
        turn = np.minimum(turn, np.abs(2.0 * math.pi - turn))
        self.bent = np.zeros((self.steps, self.count), bool)
        self.bent[stored["bend_step"].astype(int) - 1, stored["bend_robot"].astype(int)] = True
        change = np.zeros_like(self.chord_m)
        if self.steps > 1:  # between steps without a contact: in the others bodies are stopped at once
            free = ~(self.bent[1:] | self.bent[:-1])
            faster = np.where(free, np.abs(np.diff(self.chord_m, axis=0)), 0.0)
            change[1:] = faster
            change[:-1] = np.maximum(change[:-1], faster)
        bound = 0.5 * self.chord_m * np.tan(0.25 * turn) + change / 8.0 + ROUNDING_M
        self.bound_m: Floats = np.where(self.bent, ROUNDING_M, bound)
        self.ways: dict[int, dict[int, Ints]] = {}
        for step, robot, way in zip(
            stored["bend_step"].tolist(), stored["bend_robot"].tolist(), stored["bend"].astype(np.int64), strict=True
        ):
            start = self.grains[step - 1, robot]
            self.ways.setdefault(step - 1, {})[robot] = np.concatenate([start[None], start + np.cumsum(way, axis=0)])
        self.part = np.concatenate([[0.0], stored["part_s"] / self.step_s])

    def spans(self) -> Iterator[tuple[int, int]]:
        """Yield the first step of each span, and the one after its last."""
        for first in range(0, self.steps, SPAN):
            yield first, min(self.steps, first + SPAN)

    def corners(self, first: int, last: int) -> tuple[Ints, Floats]:
        """Return the steps of a span in which anything touched (c,), and the ways of all bodies, (c, p + 1, n, 2)."""
        steps = np.array([step for step in range(first, last) if step in self.ways], np.int64)
        begin, end = self.xy[steps][:, None], self.xy[steps + 1][:, None]
        ways: Floats = begin + (end - begin) * self.part[:, None, None]
        for at, step in enumerate(steps.tolist()):
            for robot, way in self.ways[step].items():
                ways[at, :, robot] = way * GRAIN
        return steps, ways

    def detours_m(self) -> Floats:
        """Return how far the ways of each robot that touched something were from straight ones, at most, (n,)."""
        found = np.zeros(self.count)
        for first, last in self.spans():
            steps, ways = self.corners(first, last)
            begin, end = self.xy[steps][:, None], self.xy[steps + 1][:, None]
            off = _length(ways - begin - (end - begin) * self.part[:, None, None])
            found = np.maximum(found, np.nan_to_num(off).max(axis=(0, 1), initial=0.0))
        return found


class Touches:
    """Which gaps were contacts, collected step by step."""

    def __init__(self, motion: Motion, names: list[str], obstacles: int) -> None:
        self._motion, self._names, self._obstacles = motion, names, obstacles
        shape = motion.steps, motion.count
        # With robots, with obstacles, with movers.
        self.sure, self.maybe = (tuple(np.zeros(shape, bool) for _ in range(3)) for _ in range(2))
        self.met: list[tuple[int, int, int]] = []  # step and robots, certain or not
        self.pairs: set[tuple[int, int]] = set()
        self.pairs_maybe: set[tuple[int, int]] = set()
        self.undecided = 0
        self.unrecorded: list[str] = []

    def add(self, step: Ints, one: Ints, other: Ints, gap_m: Floats, tolerance_m: Floats) -> None:
        """Take in gaps of robots `one` and robots or obstacles (-1-k) `other`; what cannot touch is left out."""
        touch_m = self._motion.touch_m
        some = np.flatnonzero(gap_m <= touch_m + tolerance_m)
        for at in some.tolist():
            s, i, j = int(step[at]), int(one[at]), int(other[at])
            involved = (i, j) if j >= 0 else (i,)
            recorded = all(self._motion.bent[s, each] for each in involved)
            sure = bool(gap_m[at] < touch_m - tolerance_m[at])
            self.undecided += not sure
            if not recorded:
                if sure:
                    self.unrecorded.append(self._text(s, i, j, float(gap_m[at])))
                continue  # undecided, and the referee says that it was none
            kind = 0 if j >= 0 else 1 if -1 - j < self._obstacles else 2
            for each in involved:
                (self.sure if sure else self.maybe)[kind][s, each] = True
            if j >= 0:
                (self.pairs if sure else self.pairs_maybe).add((min(i, j), max(i, j)))
                self.met.append((s, min(i, j), max(i, j)))

    def _text(self, step: int, one: int, other: int, gap_m: float) -> str:
        beyond = -1 - other - self._obstacles
        name = self._names[other] if other >= 0 else f"obstacle {-1 - other}" if beyond < 0 else f"mover {beyond}"
        return (
            f"{self._names[one]} and {name} came within {gap_m:.4f} m at {(step + 1) * self._motion.step_s:.2f} s, "
            "but no contact is recorded"
        )


def recount(stored: Mapping[str, NDArray[Any]]) -> Recount:
    """Return what the stored motion of a trial shows.

    Parameters
    ----------
    stored : the arrays of ``evidence.npz``, with the motion
    """
    motion, names = Motion(stored), [str(each) for each in stored["ids"]]
    found = Recount(steps=motion.steps, end_s=motion.steps * motion.step_s)
    found.bound_m = np.nan_to_num(motion.bound_m).max(axis=0, initial=0.0)
    found.detour_m = motion.detours_m()
    touches, soonest = Touches(motion, names, len(stored["obstacles"])), Soonest(motion.step_s)
    found.closest_m = _pairs(motion, touches, soonest)
    found.wall_m = _obstacles(motion, stored["obstacles"].astype(float), touches, soonest)
    found.time_to_contact_s = soonest.least_s, soonest.most_s
    _movers(motion, stored, touches)
    _count(motion, touches, found)
    _count_pushed(motion, touches, found)
    _check_ways(motion, touches, names, found)
    _commands(stored, names, found)
    _arrivals(motion, stored, found)
    return found


# ------------------------------------------------------------------------------------------------------- gaps
class Soonest:
    """The least time to contact: a gap over the rate at which it shrank in the step before."""

    def __init__(self, step_s: float) -> None:
        self.least_s = self.most_s = math.inf
        self._step_s = step_s

    def add(self, before_m: Floats, after_m: Floats, touching_m: Floats | float) -> None:
        """Take in distances before and after steps, and those at which the bodies touch."""
        off = 2.0 * ROUNDING_M
        closed, gap = before_m - after_m, after_m - touching_m
        with np.errstate(divide="ignore", invalid="ignore"):
            low = np.where(closed + 2.0 * off > 0.0, np.maximum(0.0, gap - off) / (closed + 2.0 * off), np.inf)
            high = np.where(closed - 2.0 * off > 0.0, np.maximum(0.0, gap + off) / (closed - 2.0 * off), np.inf)
        self.least_s = min(self.least_s, float(np.where(np.isnan(low), np.inf, low).min(initial=np.inf)) * self._step_s)
        self.most_s = min(self.most_s, float(np.where(np.isnan(high), np.inf, high).min(initial=np.inf)) * self._step_s)

    def touched(self, gap_m: Floats, tolerance_m: Floats, touch_m: float) -> None:
        """Take in gaps: what touched had no time left."""
        if (gap_m <= touch_m + tolerance_m).any():
            self.least_s = 0.0
        if (gap_m < touch_m - tolerance_m).any():
            self.most_s = 0.0


def _length(vectors: Floats) -> Floats:
    found: Floats = np.sqrt(vectors[..., 0] ** 2 + vectors[..., 1] ** 2)
    return found


def _least_to_origin(start: Floats, end: Floats) -> Floats:
    """Return the smallest distance of the origin to straight ways from `start` (…, 2) to `end`."""
    way = end - start
    square = (way * way).sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        part = np.where(square > 0.0, -(start * way).sum(axis=-1) / square, 0.0)
    return _length(start + np.clip(part, 0.0, 1.0)[..., None] * way)


def _reach(motion: Motion, first: int, last: int) -> tuple[Floats, Floats]:
    """Return how far bodies got from where they were at the start of a span, and their longest step, (n,)."""
    away = _length(motion.xy[first : last + 1] - motion.xy[first])
    ways = [step for step in range(first, last) if step in motion.ways]
    for step in ways:
        for robot, way in motion.ways[step].items():
            away[0, robot] = max(away[0, robot], _length(way * GRAIN - motion.xy[first, robot]).max())
    bound = motion.bound_m[first:last].max(axis=0)
    return away.max(axis=0) + bound, motion.chord_m[first:last].max(axis=0)


def _pairs(motion: Motion, touches: Touches, soonest: Soonest) -> Floats:
    """Return the closest approach of each pair, (n (n - 1) / 2,), and take in all contacts of two robots."""
    one, other = np.triu_indices(motion.count, 1)
    closest = np.full(len(one), np.inf)
    both = motion.radius_m[one] + motion.radius_m[other]
    for first, last in motion.spans():
        away, longest = _reach(motion, first, last)
        room = _length(motion.xy[first, other] - motion.xy[first, one]) - both - away[one] - away[other]
        rate = (longest[one] + longest[other]) / motion.step_s
        near = ~(room > np.maximum(closest, motion.touch_m)) | ~(room > soonest.most_s * rate)
        pairs = np.flatnonzero(near)
        if not len(pairs):
            continue
        i, j, touching = one[pairs], other[pairs], both[pairs]
        apart = motion.xy[first : last + 1, j] - motion.xy[first : last + 1, i]
        distance = _length(apart)
        soonest.add(distance[:-1], distance[1:], touching)
        gap = _least_to_origin(apart[:-1], apart[1:]) - touching
        steps, corners = motion.corners(first, last)
        bent = motion.bent[steps][:, i] | motion.bent[steps][:, j]
        some = np.flatnonzero(bent.any(axis=0))
        if len(some):
            ways = corners[:, :, j[some]] - corners[:, :, i[some]]
            inner = _least_to_origin(ways[:, :-1], ways[:, 1:]).min(axis=1) - touching[some]
            at = steps[:, None] - first, some[None]
            gap[at] = np.where(bent[:, some], inner, gap[at])
        gap = np.where(np.isnan(gap), np.inf, gap)
        tolerance = motion.bound_m[first:last, i] + motion.bound_m[first:last, j]
        tolerance = np.where(np.isnan(tolerance), 0.0, tolerance)
        closest[pairs] = np.minimum(closest[pairs], gap.min(axis=0))
        soonest.touched(gap, tolerance, motion.touch_m)
        row, column = np.nonzero(gap <= motion.touch_m + tolerance)
        touches.add(row + first, i[column], j[column], gap[row, column], tolerance[row, column])
    return closest


def _to_box(x: Floats, y: Floats, half_x: float, half_y: float) -> Floats:
    """Return the distance of points to a box around the origin; 0 inside."""
    found: Floats = np.hypot(np.maximum(np.abs(x) - half_x, 0.0), np.maximum(np.abs(y) - half_y, 0.0))
    return found


def _way_to_box(start: Floats, end: Floats, half_x: float, half_y: float) -> Floats:
    """Return the smallest distance of straight ways (…, 2) to a box around the origin.

    It is at an end of the way or at a corner of the box, or 0 where the way leads through the box.
    """
    least = np.minimum(
        _to_box(start[..., 0], start[..., 1], half_x, half_y), _to_box(end[..., 0], end[..., 1], half_x, half_y)
    )
    for x in (-half_x, half_x):
        for y in (-half_y, half_y):
            corner = np.array([x, y])
            least = np.minimum(least, _least_to_origin(start - corner, end - corner))
    way, half = end - start, np.array([half_x, half_y])
    with np.errstate(divide="ignore", invalid="ignore"):
        one, two = (-half - start) / way, (half - start) / way
    still = way == 0.0
    inside = np.abs(start) <= half
    enter = np.where(still, np.where(inside, -np.inf, np.inf), np.minimum(one, two)).max(axis=-1)
    leave = np.where(still, np.where(inside, np.inf, -np.inf), np.maximum(one, two)).min(axis=-1)
    through = np.maximum(enter, 0.0) <= np.minimum(leave, 1.0)
    return np.where(through, 0.0, least)


def _obstacles(motion: Motion, obstacles: Floats, touches: Touches, soonest: Soonest) -> Floats:
    """Return the closest approach of each robot and obstacle, (n, k), and take in all contacts of the two kinds."""
    closest = np.full((motion.count, len(obstacles)), np.inf)
    for first, last in motion.spans():
        away, longest = _reach(motion, first, last)
        steps, corners = motion.corners(first, last)
        for k, (x, y, half_x, half_y, yaw, corner) in enumerate(obstacles.tolist()):
            turned = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
            touching = motion.radius_m + corner
            local = (motion.xy[first] - (x, y)) @ turned
            room = _to_box(local[:, 0], local[:, 1], half_x, half_y) - touching - away
            near = ~(room > np.maximum(closest[:, k], motion.touch_m)) | ~(
                room > soonest.most_s * longest / motion.step_s
            )
            i = np.flatnonzero(near)
            if not len(i):
                continue
            places = (motion.xy[first : last + 1, i] - (x, y)) @ turned
            distance = _to_box(places[..., 0], places[..., 1], half_x, half_y)
            soonest.add(distance[:-1], distance[1:], touching[i])
            gap = _way_to_box(places[:-1], places[1:], half_x, half_y) - touching[i]
            bent = motion.bent[steps][:, i]
            some = np.flatnonzero(bent.any(axis=0))
            if len(some):
                ways = (corners[:, :, i[some]] - (x, y)) @ turned
                inner = _way_to_box(ways[:, :-1], ways[:, 1:], half_x, half_y).min(axis=1) - touching[i[some]]
                where = steps[:, None] - first, some[None]
                gap[where] = np.where(bent[:, some], inner, gap[where])
            gap = np.where(np.isnan(gap), np.inf, gap)
            tolerance = np.nan_to_num(motion.bound_m[first:last, i])
            closest[i, k] = np.minimum(closest[i, k], gap.min(axis=0))
            soonest.touched(gap, tolerance, motion.touch_m)
            at, column = np.nonzero(gap <= motion.touch_m + tolerance)
            touches.add(at + first, i[column], np.full(len(at), -1 - k), gap[at, column], tolerance[at, column])
    return closest


def _movers(motion: Motion, stored: Mapping[str, NDArray[Any]], touches: Touches) -> None:
    """Take in all contacts of robots and movers, which stand still throughout a step."""
    places = np.cumsum(stored["mover_xy"], axis=0, dtype=np.int32) * GRAIN
    obstacles, everyone = len(stored["obstacles"]), np.arange(motion.count)
    for first, last in motion.spans():
        steps, corners = motion.corners(first, last)
        for mover, radius_m in enumerate(stored["mover_radius_m"].tolist()):
            place, touching = places[first:last, mover][:, None], motion.radius_m + radius_m
            gap = _least_to_origin(motion.xy[first:last] - place, motion.xy[first + 1 : last + 1] - place) - touching
            if len(steps):
                ways = corners - places[steps, mover][:, None, None]
                inner = _least_to_origin(ways[:, :-1], ways[:, 1:]).min(axis=1) - touching
                gap[steps - first] = np.where(motion.bent[steps], inner, gap[steps - first])
            tolerance = motion.bound_m[first:last] + ROUNDING_M
            row, robot = np.nonzero(gap <= motion.touch_m + tolerance)
            other = np.full(len(row), -1 - obstacles - mover)
            touches.add(row + first, everyone[robot], other, gap[row, robot], tolerance[row, robot])


# ------------------------------------------------------------------------------------------------------- counts
def _events(hit: Flags, step_s: float) -> int:
    """Count contacts that began after at least `FREE_S` without one; (steps, n)."""
    total = 0
    for robot in np.flatnonzero(hit.any(axis=0)).tolist():
        steps = np.flatnonzero(hit[:, robot])
        total += 1 + int((np.diff(steps) * step_s >= FREE_S - TOO_FEW).sum())
    return total


def _count(motion: Motion, touches: Touches, found: Recount) -> None:
    for kind, counted in enumerate((found.robot_events, found.obstacle_events, found.mover_contacts)):
        without = _events(touches.sure[kind], motion.step_s)
        with_them = _events(touches.sure[kind] | touches.maybe[kind], motion.step_s)
        counted.least, counted.most = min(without, with_them), max(without, with_them)
    found.pairs_touched = Range(len(touches.pairs), len(touches.pairs | touches.pairs_maybe))
    sure = (touches.sure[0] | touches.sure[1]).any(axis=0)
    maybe = (touches.maybe[0] | touches.maybe[1]).any(axis=0)
    found.robots_touched = Range(int(sure.sum()), int((sure | maybe).sum()))
    found.undecided = touches.undecided
    found.contradictions += touches.unrecorded[:SAID]


def _count_pushed(motion: Motion, touches: Touches, found: Recount) -> None:
    """Count robots' meetings in whose first step one of the two was, or had been for at most `FREE_S`, at a mover.

    Where it is not certain who touched, from none to all may be.
    """
    by_mover = touches.sure[2] | touches.maybe[2]
    window = int(FREE_S / motion.step_s + TOO_FEW)
    met: dict[int, dict[int, list[int]]] = {}
    for step, one, other in touches.met:
        for robot in (one, other):
            met.setdefault(robot, {}).setdefault(step, []).extend((one, other))
    pushed = 0
    for steps in met.values():
        last = -window - 1
        for step in sorted(steps):
            if step - last > window:
                pushed += bool(by_mover[max(0, step - window) : step + 1, steps[step]].any())
            last = step
    certain = not (touches.maybe[0].any() or touches.maybe[2].any())
    found.pushed_events = Range(pushed, pushed) if certain else Range(0, found.robot_events.most)


def _check_ways(motion: Motion, touches: Touches, names: list[str], found: Recount) -> None:
    """Check that who is recorded as touching did, and that ways through a step end where the next one begins."""
    seen = np.any([*touches.sure, *touches.maybe], axis=0)
    alone = np.argwhere(motion.bent & ~seen)[:SAID]
    found.contradictions += [
        f"{names[robot]} is recorded as touching at {(step + 1) * motion.step_s:.2f} s, but was near nothing"
        for step, robot in alone.tolist()
    ]
    ends = [
        f"the way of {names[robot]} at {(step + 1) * motion.step_s:.2f} s does not end where the next step begins"
        for step, ways in motion.ways.items()
        for robot, way in ways.items()
        if np.abs(way[-1] - motion.grains[step + 1, robot]).max() > 1
    ]
    found.contradictions += ends[:SAID]


def _commands(stored: Mapping[str, NDArray[Any]], names: list[str], found: Recount) -> None:
    """Count the commands above the limits: those listed, if the others are not above and the listed ones are."""
    limits, listed = stored["limits"].astype(float), stored["above"].astype(float).reshape(-1, 4)
    found.commands_known, found.above_limits = bool(np.isfinite(limits).all()), len(listed)
    grains = np.cumsum(stored["command"], axis=0, dtype=np.int32).astype(np.int64)
    most = limits * (1.0 + TOO_FEW)
    above = (np.abs(grains * GRAIN) > most).any(axis=2)
    if len(above):
        above[0] = False  # what was in force before the first step
    steps, rows = listed[:, 0].astype(int), listed[:, 1].astype(int)
    marked = np.zeros_like(above)
    marked[steps, rows] = True
    wrong = (np.abs(listed[:, 2:]) <= most[rows]).all(axis=1)
    wrong |= (np.trunc(listed[:, 2:] / GRAIN) != grains[steps, rows]).any(axis=1)
    if wrong.any() or int(marked.sum()) != len(listed):
        found.contradictions.append("the list of commands above the limits holds others, or one twice")
    for step, robot in np.argwhere(above & ~marked)[:SAID].tolist():
        found.contradictions.append(f"a command of {names[robot]} in step {step} is above its limit and not listed")


def _arrivals(motion: Motion, stored: Mapping[str, NDArray[Any]], found: Recount) -> None:
    """Find who was at its goal at the end, and since when; and when first all were."""
    far = _length(motion.xy - stored["goals"].astype(float)) - float(stored["goal_radius_m"])
    if not len(far):
        return
    there = far <= 0.0
    found.arrived = Range(int((far[-1] <= -2.0 * GRAIN).sum()), int((far[-1] <= 2.0 * GRAIN).sum()))
    aimed = np.isfinite(stored["goals"]).all(axis=1)  # robots that take no part have no goal
    everyone = ((there[1:] | ~aimed).all(axis=1) & aimed.any()).astype(np.int8)
    if motion.count:
        change = np.diff(everyone, prepend=0, append=0)
        begin, end = np.flatnonzero(change == 1), np.flatnonzero(change == -1)
        found.all_there_s = [
            ((int(first) + 1) * motion.step_s, int(last) * motion.step_s)
            for first, last in zip(begin, end, strict=True)
        ]
    for robot in np.flatnonzero(there[-1]).tolist():
        away = np.flatnonzero(~there[1:, robot])
        since = (int(away[-1]) + 2 if len(away) else 1) * motion.step_s
        found.last_arrival_s = since if math.isnan(found.last_arrival_s) else max(found.last_arrival_s, since)
