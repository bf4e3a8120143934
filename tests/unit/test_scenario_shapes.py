"""Discs, polygons and lines as boxes: they hold the shape, and reach out of it by 2 cm at most."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from fullswarm.evaluate.scenarios import Box, distance_to_box
from fullswarm.evaluate.scenarios.importers.draft import (
    OVERSHOOT_M,
    Planar,
    disc_boxes,
    hull,
    polygon_boxes,
    signed_area,
    wall_boxes,
)

SHAPELY = pytest.importorskip("shapely")
CORNER = st.floats(0.3, 3.0)


def corners(box: Box) -> list[tuple[float, float]]:
    frame = Planar(box[0], box[1], box[4])
    return [frame.point(i * box[2] / 2, j * box[3] / 2) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]


def union(boxes: tuple[Box, ...]) -> Any:
    return SHAPELY.unary_union([SHAPELY.Polygon(corners(box)) for box in boxes])


@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(0.01, 20.0))
@settings(max_examples=60, deadline=None)
def test_a_discs_boxes_hold_it_and_little_more(x: float, y: float, radius: float) -> None:
    boxes = disc_boxes(x, y, radius)
    for angle in np.linspace(-math.pi, math.pi, 101):
        px, py = x + radius * math.cos(angle), y + radius * math.sin(angle)
        assert min(distance_to_box(px, py, box) for box in boxes) < 1e-9
    farthest = max(math.dist((x, y), corner) for box in boxes for corner in corners(box))
    assert farthest <= max(radius + OVERSHOOT_M, radius * math.sqrt(2)) + 1e-9
    assert farthest <= radius + OVERSHOOT_M + 1e-9 or radius < OVERSHOOT_M / (math.sqrt(2) - 1) + 1e-9
    assert len(boxes) <= 40


@pytest.mark.parametrize("turn", [0.0, 0.3, 1.2, 2.9])
def test_what_is_made_of_rectangles_comes_out_exactly(turn: float) -> None:
    shape = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (1.0, 1.0), (1.0, 3.0), (0.0, 3.0)]
    turned = [Planar(4.0, -2.0, turn).point(*point) for point in shape]
    boxes, overshoot = polygon_boxes(turned)
    assert len(boxes) == 2
    assert overshoot < 1e-9
    assert union(boxes).symmetric_difference(SHAPELY.Polygon(turned)).area < 1e-9


@given(st.lists(CORNER, min_size=3, max_size=8), st.floats(0, 6.28), st.booleans())
@settings(max_examples=60, deadline=None)
def test_a_polygons_boxes_hold_it_and_little_more(radii: list[float], turn: float, clockwise: bool) -> None:
    angles = [turn + 2 * math.pi * i / len(radii) for i in range(len(radii))]
    points = [(r * math.cos(a), r * math.sin(a)) for r, a in zip(radii, angles, strict=True)]
    points = points[::-1] if clockwise else points
    assume(abs(signed_area(points)) > 1e-3)
    boxes, overshoot = polygon_boxes(points)
    rest, limit = SHAPELY.Polygon(points), max(overshoot, 1e-6) * 1.001
    around = rest.buffer(limit, join_style="mitre", mitre_limit=50)
    for box in boxes:  # one by one: a union of boxes that only just touch is beyond floating point
        outline = SHAPELY.Polygon(corners(box))
        rest = rest.difference(outline.buffer(1e-7))
        assert outline.difference(around).area < 1e-6
    assert rest.area < 1e-9
    assert overshoot <= 0.1


def test_a_bow_tie_is_told_and_has_a_hull() -> None:
    bow = [(0.0, 0.0), (2.0, 2.0), (2.0, 0.0), (0.0, 2.0)]
    with pytest.raises(ValueError, match=r"cross|area"):
        polygon_boxes(bow)
    assert SHAPELY.Polygon(hull(bow)).area == pytest.approx(4.0)


@pytest.mark.parametrize("points", [[], [(0.0, 0.0), (1.0, 0.0)], [(0.0, 0.0), (1.0, 1.0), (2.0, 2.0)]])
def test_a_polygon_without_area_is_refused(points: list[tuple[float, float]]) -> None:
    with pytest.raises(ValueError, match="area"):
        polygon_boxes(points)


def test_lines_become_thin_walls() -> None:
    points = [(0.0, 0.0), (2.0, 0.0), (2.0, 1.0)]
    assert wall_boxes(points, closed=False)[0] == pytest.approx((1.0, 0.0, 2.02, 0.02, 0.0))
    assert len(wall_boxes(points, closed=False)) == 2
    assert len(wall_boxes(points, closed=True)) == 3
    line = SHAPELY.LineString([*points, points[0]])
    assert union(wall_boxes(points, closed=True)).buffer(1e-9).contains(line)
