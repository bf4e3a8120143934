"""Collects what the importers find, and makes a scenario of it: discs, polygons and lines become boxes.

A scenario knows boxes only; they hold the shape and a little more.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from pydantic import ValidationError

from fullswarm.errors import ConfigError
from fullswarm.evaluate.scenarios.model import Box, Goal, RandomBoxes, Rectangle, Scenario, Spawn
from fullswarm.evaluate.scenarios.placement import distance_to_box
from fullswarm.geometry import wrap

Xy = tuple[float, float]

OVERSHOOT_M = 0.02
"""How far boxes may reach out of the shape that they stand for."""

MAX_SLICES = 64
"""Slices between two corners of a polygon: beyond it the overshoot grows instead."""

MAX_DIRECTIONS = 12
_EQUAL_M = 1e-9


@dataclass(frozen=True, slots=True)
class Planar:
    """A place and a heading on the floor: metres, radians."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    def point(self, x: float, y: float) -> Xy:
        """Return a point of this frame in the outer one."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        return self.x + cos * x - sin * y, self.y + sin * x + cos * y

    def then(self, inner: Planar) -> Planar:
        """Return what `inner`, given in this frame, is in the outer one."""
        return Planar(*self.point(inner.x, inner.y), self.yaw + inner.yaw)


def rectangle(frame: Planar, size_x: float, size_y: float) -> Box:
    """Return a rectangle around a frame's origin as a box."""
    return frame.x, frame.y, size_x, size_y, wrap(frame.yaw)


def disc_boxes(x: float, y: float, radius: float) -> tuple[Box, ...]:
    """Return boxes turned about the centre that hold a disc and reach out of it by `OVERSHOOT_M` at most.

    Box i of k holds the sectors within π/2k of its axis: it is 2 r long, 2 r sin(π/2k) wide.
    """
    corner = min(1.0 + OVERSHOOT_M / radius, math.sqrt(2.0))
    k = max(1, math.ceil(math.pi / (2.0 * math.asin(min(1.0, math.sqrt(corner * corner - 1.0)))) - 1e-9))
    width = 2.0 * radius * math.sin(math.pi / (2 * k))
    return tuple((x, y, 2.0 * radius, width, wrap(i * math.pi / k)) for i in range(k))


def wall_boxes(points: Sequence[Xy], closed: bool, thickness: float = OVERSHOOT_M) -> tuple[Box, ...]:
    """Return a thin box along each line between two points, half of it on either side."""
    ends = zip(points, [*points[1:], points[0]] if closed else points[1:], strict=False)
    boxes = []
    for (x0, y0), (x1, y1) in ends:
        length = math.hypot(x1 - x0, y1 - y0)
        if length > _EQUAL_M:
            middle = (x0 + x1) / 2.0, (y0 + y1) / 2.0
            boxes.append((*middle, length + thickness, thickness, math.atan2(y1 - y0, x1 - x0)))
    return tuple(boxes)


def signed_area(points: Sequence[Xy]) -> float:
    """Return a polygon's area in m²; negative when its corners go clockwise."""
    following = [*points[1:], points[0]]
    return sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in zip(points, following, strict=True)) / 2.0


def hull(points: Sequence[Xy]) -> list[Xy]:
    """Return the convex hull, counter-clockwise (Andrew's monotone chain)."""
    ordered = sorted(set(points))
    chains: list[list[Xy]] = []
    for sequence in (ordered, ordered[::-1]):
        chain: list[Xy] = []
        for point in sequence:
            while len(chain) > 1 and _cross(chain[-2], chain[-1], point) <= 0.0:
                chain.pop()
            chain.append(point)
        chains.append(chain[:-1])
    return chains[0] + chains[1]


def polygon_boxes(points: Sequence[Xy]) -> tuple[tuple[Box, ...], float]:
    """Return boxes that hold a polygon, and how far in metres they reach out of it at most.

    It is cut into slices along the direction of one of its edges: the one that needs fewest boxes, so that
    rectangles and what is made of them come out exactly.

    Raises
    ------
    ValueError
        Fewer than three corners, no area, or edges that cross.
    """
    corners = _without_repeats(points)
    if len(corners) < 3 or abs(signed_area(corners)) < 1e-8:
        raise ValueError("a polygon needs three corners and an area")
    following = [*corners[1:], corners[0]]
    # The direction alone counts: 0 and π slice alike. A circle of 200 corners needs no 200 trials.
    exact = [math.atan2(y1 - y0, x1 - x0) % math.pi for (x0, y0), (x1, y1) in zip(corners, following, strict=True)]
    angles = {round(angle, 6): angle for angle in exact}
    choices = [_sliced(corners, angle) for _, angle in sorted(angles.items())[:MAX_DIRECTIONS]]
    return min(choices, key=lambda choice: (len(choice[0]), choice[1]))


def _without_repeats(points: Sequence[Xy]) -> list[Xy]:
    kept: list[Xy] = []
    for point in points:
        if not kept or math.dist(kept[-1], point) > _EQUAL_M:
            kept.append(point)
    while len(kept) > 1 and math.dist(kept[0], kept[-1]) <= _EQUAL_M:
        kept.pop()
    return kept


def _cross(a: Xy, b: Xy, c: Xy) -> float:
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])


def _sliced(corners: Sequence[Xy], angle: float) -> tuple[tuple[Box, ...], float]:
    """Cut along `angle`, between the heights of all corners."""
    unturn, turn = Planar(yaw=-angle), Planar(yaw=angle)
    turned = [unturn.point(*corner) for corner in corners]
    edges = list(zip(turned, [*turned[1:], turned[0]], strict=True))
    levels: list[float] = []
    for level in sorted(y for _, y in turned):
        if not levels or level - levels[-1] > _EQUAL_M:
            levels.append(level)
    boxes: list[Box] = []
    worst = 0.0
    for low, high in pairwise(levels):
        for left, right in _pairs(edges, low, high):
            slant = max(abs(left[1] - left[0]), abs(right[1] - right[0]))
            # A slice of height h sticks out of an edge by h cos of the angle between them.
            steep = (high - low) * slant / math.hypot(slant, high - low)
            wanted = max(1, math.ceil(steep / OVERSHOOT_M - 1e-6))
            n = min(wanted, MAX_SLICES) if slant > _EQUAL_M else 1
            worst = max(worst, steep / n)
            boxes.extend(_slice(left, right, (low, high), i / n, (i + 1) / n, turn) for i in range(n))
    return tuple(boxes), worst


def _pairs(edges: Sequence[tuple[Xy, Xy]], low: float, high: float) -> list[tuple[Xy, Xy]]:
    """Return for each solid piece between two heights its left and its right edge: x at `low`, x at `high`."""
    middle = (low + high) / 2.0
    crossing = []
    for (x0, y0), (x1, y1) in edges:
        if min(y0, y1) < middle < max(y0, y1):
            slope = (x1 - x0) / (y1 - y0)
            crossing.append((x0 + slope * (low - y0), x0 + slope * (high - y0)))
    crossing.sort(key=sum)
    for left, right in pairwise(crossing):
        if left[0] > right[0] + 1e-6 or left[1] > right[1] + 1e-6:
            raise ValueError("edges of the polygon cross")
    return list(zip(crossing[::2], crossing[1::2], strict=True))


def _slice(left: Xy, right: Xy, heights: Xy, start: float, end: float, turn: Planar) -> Box:
    def at(edge: Xy, share: float) -> float:
        return edge[0] + share * (edge[1] - edge[0])

    x_min, x_max = min(at(left, start), at(left, end)), max(at(right, start), at(right, end))
    low, high = (heights[0] + share * (heights[1] - heights[0]) for share in (start, end))
    centre = turn.point((x_min + x_max) / 2.0, (low + high) / 2.0)
    return *centre, x_max - x_min, high - low, wrap(turn.yaw)


Disc = tuple[float, float, float]
"""Centre x, y and radius in metres."""

MARGIN_M = 1.0
"""Free floor around everything, where a file does not give the size of its world."""

MAX_M = 1e6
"""What is farther away is a slip, or not finite."""

START_ROOM_M = 0.5
"""Of the spawn region around the outermost start."""

SPAWN_INSET_M = 0.5
LEAST_SIDE_M = 0.1
MAX_BOXES, MAX_RANDOM_BOXES = 20_000, 1000
DEFAULT_GOAL_RADIUS_M = 1.0


@dataclass(frozen=True, slots=True)
class Imported:
    """A scenario made of another simulator's file, and all that could not be taken over as it was."""

    scenario: Scenario
    notes: tuple[str, ...] = ()
    starts: tuple[Planar, ...] = ()
    """Where the file puts its robots. A scenario keeps the region around them only."""


@dataclass(slots=True)
class Draft:
    """Obstacles, starts and goals as an importer finds them."""

    where: str
    boxes: list[Box] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    starts: list[Planar] = field(default_factory=list)
    start_regions: list[Rectangle] = field(default_factory=list)
    goals: list[Disc] = field(default_factory=list)
    random_boxes: RandomBoxes | None = None
    bounds: Rectangle | None = None
    walls: bool = False
    time_limit_s: float | None = None
    _approximated: Counter[str] = field(default_factory=Counter)

    def note(self, text: str) -> None:
        """Keep a note, once."""
        if text not in self.notes:
            self.notes.append(text)

    def rectangle(self, frame: Planar, size_x: float, size_y: float, what: str) -> None:
        """Add a rectangle around the origin of `frame`."""
        self._check(what, (size_x, size_y), (frame.x, frame.y, frame.yaw))
        self._add(rectangle(frame, size_x, size_y))

    def disc(self, x: float, y: float, radius: float, what: str) -> None:
        """Add a disc, as boxes."""
        self._check(what, (radius,), (x, y))
        self._add(*disc_boxes(x, y, radius))
        self._approximated["discs"] += 1

    def polygon(self, points: Sequence[Xy], what: str) -> None:
        """Add a polygon, as boxes; one whose edges cross is filled up to its convex hull."""
        self._check(what, (), [each for point in points for each in point])
        try:
            boxes, overshoot = polygon_boxes(points)
        except ValueError:
            try:
                boxes, overshoot = polygon_boxes(hull(points))
            except ValueError as error:
                raise ConfigError(f"{what}: {error}", where=self.where) from error
            self.note(f"{what}: its edges cross; its convex hull stands for it")
        self._add(*boxes)
        if overshoot > 1e-6:
            self._approximated["polygons"] += 1
        if overshoot > OVERSHOOT_M * 1.01:
            self.note(f"{what}: its boxes reach {overshoot:.3f} m out of it")

    def lines(self, points: Sequence[Xy], closed: bool, what: str) -> None:
        """Add lines without thickness, as walls 2 cm thin."""
        self._check(what, (), [each for point in points for each in point])
        self._add(*wall_boxes(points, closed))
        self._approximated["lines"] += 1

    def scatter(self, count: int, size: Xy, region: Rectangle, what: str) -> bool:
        """Let the seed place boxes in the part of a region inside the arena; return whether a scenario can hold them.

        A scenario has one kind of random boxes: the first.
        """
        self._check(what, size, region)
        inside = region if self.bounds is None else _clipped(region, self.bounds)
        if not (inside[0] < inside[2] and inside[1] < inside[3]):
            raise ConfigError(f"{what}: their region lies out of the arena", where=self.where)
        if self.random_boxes is not None:
            self.note(f"{what}: a scenario has one kind of random boxes; these are left out")
            return False
        if count > MAX_RANDOM_BOXES:
            self.note(f"{what}: {MAX_RANDOM_BOXES} of them, a scenario's most")
        self.random_boxes = RandomBoxes(count=min(count, MAX_RANDOM_BOXES), size_m=size, region_m=inside)
        return True

    def finish(self, name: str, description: str) -> Imported:
        """Return the scenario; what the file does not specify is chosen here and noted.

        Raises
        ------
        ConfigError
            There is nothing in the file, or it makes no scenario.
        """
        bounds = self.bounds or self._around_everything()
        sides = bounds[2] - bounds[0], bounds[3] - bounds[1]
        if min(sides) < LEAST_SIDE_M or max(map(abs, bounds)) > MAX_M:
            size = f"{sides[0]:g} x {sides[1]:g} m"
            raise ConfigError(f"an arena of {size} from {bounds[0]:g}, {bounds[1]:g}", where=self.where)
        self._keep_inside(bounds)
        spawn_region = self._spawn_region(bounds)
        goal = self._goal(bounds)
        for kind, count in sorted(self._approximated.items()):
            how = "walls 2 cm thin" if kind == "lines" else f"boxes that reach {OVERSHOOT_M * 100:.0f} cm out of them"
            self.note(f"{kind} ({count}) became {how}")
        try:
            scenario = Scenario(
                name=name.strip() or "imported",
                description=description,
                bounds_m=bounds,
                walls=self.walls,
                boxes=tuple(self.boxes),
                random_boxes=self.random_boxes,
                spawn=Spawn(region_m=spawn_region),
                goal=goal,
                **({} if self.time_limit_s is None else {"time_limit_s": self.time_limit_s}),
            )
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            what = ".".join(str(each) for each in first["loc"])
            raise ConfigError(f"this makes no scenario: {what} {first['msg']}".strip(), where=self.where) from error
        return Imported(scenario, tuple(self.notes), tuple(self.starts))

    def _check(self, what: str, sizes: Sequence[float], places: Sequence[float]) -> None:
        # Not a number is not below the limit either.
        if not all(abs(each) <= MAX_M for each in (*sizes, *places)):
            raise ConfigError(f"{what}: larger or farther away than {MAX_M / 1000:g} km", where=self.where)
        if sizes and min(sizes) <= 0.0:
            raise ConfigError(f"{what}: a size must be above zero", where=self.where)

    def _add(self, *boxes: Box) -> None:
        if len(self.boxes) + len(boxes) > MAX_BOXES:
            raise ConfigError(f"more than {MAX_BOXES} boxes", where=self.where, hint="simplify the world first")
        self.boxes.extend(boxes)

    def _around_everything(self) -> Rectangle:
        points = [corner for box in self.boxes for corner in _corners(box)]
        points += [(start.x, start.y) for start in self.starts]
        points += [corner for x0, y0, x1, y1 in self.start_regions for corner in ((x0, y0), (x1, y1))]
        points += [(x + side * r, y + side * r) for x, y, r in self.goals for side in (-1.0, 1.0)]
        if not points:
            raise ConfigError("there is neither an obstacle nor a robot in it", where=self.where)
        low, high = np.min(points, axis=0) - MARGIN_M, np.max(points, axis=0) + MARGIN_M
        bounds = tuple(round(float(each), 6) for each in (*low, *high))
        self.note(f"the file has no limits: the arena is all that is in it and {MARGIN_M:g} m around")
        return bounds[0], bounds[1], bounds[2], bounds[3]

    def _keep_inside(self, bounds: Rectangle) -> None:
        inside = [each for each in self.starts if _contains(bounds, each.x, each.y)]
        if len(inside) < len(self.starts):
            self.note(f"{len(self.starts) - len(inside)} robots stand out of the arena: left out")
            self.starts = inside

        kept = [box for box in self.boxes if _touches(bounds, box)]
        if len(kept) < len(self.boxes):
            self.note(f"{len(self.boxes) - len(kept)} boxes lie out of the arena: left out")
            self.boxes = kept

    def _spawn_region(self, bounds: Rectangle) -> Rectangle:
        regions = [_grown((each.x, each.y, each.x, each.y), START_ROOM_M) for each in self.starts]
        regions += self.start_regions
        if regions:
            columns = list(zip(*regions, strict=True))
            region = (min(columns[0]), min(columns[1]), max(columns[2]), max(columns[3]))
            clipped = _clipped(region, bounds)
            if clipped[0] < clipped[2] and clipped[1] < clipped[3]:
                if self.starts:
                    self.note(
                        f"{len(self.starts)} robots have start poses: the spawn region is around them, the seed "
                        "chooses the places in it"
                    )
                return clipped
        inset = min(SPAWN_INSET_M, 0.25 * min(bounds[2] - bounds[0], bounds[3] - bounds[1]))
        self.note("the file has no robots: they start anywhere in the arena; narrow spawn.region_m")
        return _grown(bounds, -inset)

    def _goal(self, bounds: Rectangle) -> Goal:
        if not self.goals:
            radius = min(DEFAULT_GOAL_RADIUS_M, 0.25 * min(bounds[2] - bounds[0], bounds[3] - bounds[1]))
            centre = (bounds[0] + bounds[2]) / 2.0, (bounds[1] + bounds[3]) / 2.0
            self.note("the file has no goal: a disc in the middle of the arena; change goal.centre_m")
            goal = Goal(centre_m=centre, radius_m=radius)
        elif mirrored := self._mirrored():
            goal = mirrored
        else:
            goal = self._around_goals()
        x = min(max(goal.centre_m[0], bounds[0]), bounds[2])
        y = min(max(goal.centre_m[1], bounds[1]), bounds[3])
        if (x, y) != goal.centre_m:
            self.note("the goal lies out of the arena: moved to its edge")
            goal = Goal(centre_m=(x, y), radius_m=goal.radius_m)
        if any(distance_to_box(x, y, box) <= 0.0 for box in self.boxes):
            self.note("the middle of the goal lies in an obstacle; change goal.centre_m")
        return goal

    def _mirrored(self) -> Goal | None:
        """Return an antipodal goal when every robot shall go to its start mirrored at one point."""
        if len(self.goals) != len(self.starts) or len(self.starts) < 2:
            return None
        middles = [((g[0] + s.x) / 2.0, (g[1] + s.y) / 2.0) for g, s in zip(self.goals, self.starts, strict=True)]
        if max(math.dist(middles[0], each) for each in middles) > 0.01 or len({each[:2] for each in self.goals}) < 2:
            return None
        return Goal(centre_m=middles[0], radius_m=max(0.1, *(each[2] for each in self.goals)), antipodal=True)

    def _around_goals(self) -> Goal:
        distinct = sorted(set(self.goals))
        x = sum(each[0] for each in distinct) / len(distinct)
        y = sum(each[1] for each in distinct) / len(distinct)
        radius = max(math.dist((x, y), each[:2]) + each[2] for each in distinct)
        if len(distinct) > 1:
            self.note(f"{len(distinct)} goals became one disc around them")
        return Goal(centre_m=(x, y), radius_m=max(radius, 0.1))


def _corners(box: Box) -> list[Xy]:
    frame = Planar(box[0], box[1], box[4])
    return [frame.point(i * box[2] / 2.0, j * box[3] / 2.0) for i in (-1, 1) for j in (-1, 1)]


def _touches(bounds: Rectangle, box: Box) -> bool:
    """Return whether the upright rectangle around a box reaches into the arena."""
    xs, ys = zip(*_corners(box), strict=True)
    return bool(max(xs) > bounds[0] and min(xs) < bounds[2] and max(ys) > bounds[1] and min(ys) < bounds[3])


def _contains(bounds: Rectangle, x: float, y: float) -> bool:
    return bounds[0] <= x <= bounds[2] and bounds[1] <= y <= bounds[3]


def _grown(region: Rectangle, by: float) -> Rectangle:
    return region[0] - by, region[1] - by, region[2] + by, region[3] + by


def _clipped(region: Rectangle, bounds: Rectangle) -> Rectangle:
    return (
        max(region[0], bounds[0]),
        max(region[1], bounds[1]),
        min(region[2], bounds[2]),
        min(region[3], bounds[3]),
    )
