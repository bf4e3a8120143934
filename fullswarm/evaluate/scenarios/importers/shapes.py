"""Discs, polygons and lines as boxes: all that a scenario knows. The boxes hold the shape and a little more."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from fullswarm.evaluate.scenarios.model import Box
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
        """Return what `inner`, told in this frame, is in the outer one."""
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
