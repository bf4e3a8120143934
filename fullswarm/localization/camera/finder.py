"""Finds tags in pictures, in pixels: where each was seen last, and part by part in the whole picture.

Searching all of a picture takes ten times as long as looking where the tags are expected. So every picture is searched
around each known tag, and one part of it, in turn, for new ones. Each tag found is checked again by its cells: how many
differ from the pattern, and how far black and white are apart.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.localization.camera.optics import Doubles, opencv

Grey = NDArray[np.uint8]

FAMILY = "DICT_APRILTAG_36h11"
"""587 tags of 6 by 6 cells; any two differ in at least 11 cells, however they are turned."""
CELLS = 8  # with the black border
WRONG_CELLS = 2
"""Most cells that may differ from the pattern; 36h11 could correct five."""
LEAST_CONTRAST = 18.0
LEAST_SIDE_PX = 12.0
LARGEST_SIDE_PX = 260.0
COLUMNS, ROWS = 5, 3
"""Parts of the picture that are searched in turn."""
OVERLAP_PX = 130
MISSES = 8
"""A tag that was not found around its last place so often is searched with the parts."""
SEARCH_WINDOWS = (15, 25)
"""Sizes of the neighbourhood, in pixels, against which a pixel counts as dark; in turn."""
LARGEST_STEP_PX = 220.0
STRANGE_ROUNDS = 4
"""Once in so many rounds the parts are searched for tags of no plan, which takes longer."""


@dataclass(frozen=True, slots=True)
class Found:
    """A tag in a picture.

    Attributes
    ----------
    corners : (4, 2) pixels, from the upper left of the sheet clockwise
    wrong_cells : cells that differ from the pattern, of 64
    contrast : of white and black, in grey levels
    quality : 0 to 1
    """

    tag: int
    corners: Doubles
    wrong_cells: int
    contrast: float
    quality: float

    @property
    def centre(self) -> Doubles:
        """Its middle, (2,) pixels."""
        middle: Doubles = self.corners.mean(axis=0)
        return middle

    @property
    def side_px(self) -> float:
        """Its mean side."""
        return float(np.linalg.norm(self.corners - np.roll(self.corners, 1, axis=0), axis=1).mean())


@dataclass(slots=True)
class _Known:
    """Where a tag was."""

    corners: Doubles
    speed_px_s: Doubles
    time_s: float
    misses: int = 0


@dataclass(slots=True)
class Picture:
    """What a picture shows.

    Attributes
    ----------
    tags : by number
    twice : tags that are in this picture at two places
    strange : tags of no plan
    """

    tags: dict[int, Found] = field(default_factory=dict)
    twice: set[int] = field(default_factory=set)
    strange: set[int] = field(default_factory=set)


class TagFinder:
    """Finds the tags of a plan in one camera's pictures.

    Parameters
    ----------
    tags : the numbers of the plan; others are reported as strange
    """

    def __init__(self, tags: Iterable[int]) -> None:
        self._cv2 = opencv()
        aruco = self._cv2.aruco
        self._dictionary = aruco.getPredefinedDictionary(getattr(aruco, FAMILY))
        self._tags = tuple(sorted(set(tags)))
        self._patterns: dict[int, NDArray[np.bool_]] = {}
        # A tag is compared with each of its dictionary: 1.2 ms with the whole family, 0.1 ms with those of a fleet.
        own = aruco.Dictionary(self._dictionary.bytesList[list(self._tags)], CELLS - 2, 5)
        self._search = [self._detector(own, 0.085, window) for window in SEARCH_WINDOWS]
        self._all = self._detector(own, 0.02, SEARCH_WINDOWS[0])
        self._near = [self._detector(own, 0.45, window) for window in SEARCH_WINDOWS]
        self._strange = self._detector(self._dictionary, 0.085, SEARCH_WINDOWS[0])
        self._known: dict[int, _Known] = {}
        self._turn = 0
        self._everything = True

    def search_everything(self) -> None:
        """Search all of the next picture."""
        self._everything = True

    def expect(self, tag: int, corners: Doubles, time_s: float) -> None:
        """State where a tag should be that is not known."""
        if tag not in self._known:
            self._known[tag] = _Known(corners, np.zeros(2), time_s)

    def find(self, grey: Grey, time_s: float) -> Picture:
        """Find the tags of a picture, (h, w), that was taken at a time."""
        seen: list[tuple[int, Doubles]] = []
        for tag, known in self._known.items():
            if tag not in {number for number, _ in seen}:  # a neighbour's part may have shown it
                seen += self._around(grey, tag, known, time_s)
        if self._everything:
            self._everything = False
            seen += self._detect(self._all, grey)
        else:
            seen += self._part(grey)
        picture = self._sorted_out(grey, seen)
        self._remember(picture, time_s)
        return picture

    # ------------------------------------------------------------------ where to look
    def _around(self, grey: Grey, tag: int, known: _Known, time_s: float) -> list[tuple[int, Doubles]]:
        passed_s = max(0.0, time_s - known.time_s)
        # One seen long ago may have turned off in between.
        step = known.speed_px_s * passed_s if known.misses < 3 else np.zeros(2)
        step = np.clip(step, -LARGEST_STEP_PX, LARGEST_STEP_PX)
        low, high = known.corners.min(axis=0) + step, known.corners.max(axis=0) + step
        side = float(np.max(high - low))
        around = 0.3 * side + 8.0 + 0.35 * float(np.abs(step).max()) + 0.3 * side * known.misses
        left, top = np.maximum(0, np.floor(low - around)).astype(int)
        right, bottom = np.ceil(high + around).astype(int)
        part = grey[top : max(0, bottom), left : max(0, right)]
        if min(part.shape) < LEAST_SIDE_PX:
            return []
        first, second = self._near[known.misses % 2], self._near[1 - known.misses % 2]
        seen = self._detect(first, part, left, top)
        if known.misses < 2 and all(tag != number for number, _ in seen):
            seen += self._detect(second, part, left, top)
        return seen

    def _part(self, grey: Grey) -> list[tuple[int, Doubles]]:
        height, width = grey.shape
        number, round_ = self._turn % (COLUMNS * ROWS), self._turn // (COLUMNS * ROWS)
        self._turn += 1
        row, column = divmod(number, COLUMNS)
        top, left = max(0, row * height // ROWS - OVERLAP_PX // 2), max(0, column * width // COLUMNS - OVERLAP_PX // 2)
        bottom, right = (row + 1) * height // ROWS + OVERLAP_PX // 2, (column + 1) * width // COLUMNS + OVERLAP_PX // 2
        part = grey[top:bottom, left:right]
        if round_ % STRANGE_ROUNDS == STRANGE_ROUNDS - 1:
            return self._detect(self._strange, part, left, top, own=False)
        return self._detect(self._search[round_ % 2], part, left, top)

    def _detector(self, dictionary: Any, least: float, window: int) -> Any:
        aruco = self._cv2.aruco
        settings = aruco.DetectorParameters()
        settings.adaptiveThreshWinSizeMin = settings.adaptiveThreshWinSizeMax = window
        settings.minMarkerPerimeterRate, settings.maxMarkerPerimeterRate = least, 4.0
        settings.cornerRefinementMethod = (
            aruco.CORNER_REFINE_CONTOUR
        )  # lines through the edges: a third of the error of corners
        settings.errorCorrectionRate = WRONG_CELLS / 5.0
        settings.minDistanceToBorder = 2
        return aruco.ArucoDetector(dictionary, settings)

    def _detect(
        self, detector: Any, part: Grey, left: int = 0, top: int = 0, *, own: bool = True
    ) -> list[tuple[int, Doubles]]:
        """Return the tags of a part and their corners in the whole picture; `own`: by a detector of the plan's tags."""
        corners, ids, _ = detector.detectMarkers(np.ascontiguousarray(part))
        if ids is None:
            return []
        shift = np.array((left, top), float)
        numbers = [self._tags[each] if own else each for each in ids.ravel().tolist()]
        return [(tag, each.reshape(4, 2).astype(float) + shift) for tag, each in zip(numbers, corners, strict=True)]

    # ------------------------------------------------------------------ what was found
    def _sorted_out(self, grey: Grey, seen: list[tuple[int, Doubles]]) -> Picture:
        """Keep each tag once, check its cells, and note those at two places."""
        picture = Picture()
        checked = self._checked(grey, seen)
        for each in checked:
            if each is None:
                continue
            if each.tag not in self._tags:
                picture.strange.add(each.tag)
                continue
            before = picture.tags.get(each.tag)
            if before is None:
                picture.tags[each.tag] = each
            elif np.abs(before.centre - each.centre).max() > 0.4 * max(before.side_px, each.side_px):
                picture.twice.add(each.tag)
            elif each.wrong_cells < before.wrong_cells:
                picture.tags[each.tag] = each
        return picture

    def _checked(self, grey: Grey, seen: list[tuple[int, Doubles]]) -> list[Found | None]:
        if not seen:
            return []
        samples = _cells(grey, np.array([corners for _, corners in seen]))
        result: list[Found | None] = []
        for (tag, corners), cells in zip(seen, samples, strict=True):
            pattern = self._pattern(tag)
            white, black = cells[pattern], cells[~pattern]
            high, low = float(white.mean()), float(black.mean())
            contrast = high - low
            wrong = int(((cells > (high + low) / 2.0) != pattern).sum())
            if contrast < LEAST_CONTRAST or wrong > WRONG_CELLS:
                result.append(None)
                continue
            spread = float(white.std() + black.std()) / contrast
            quality = max(0.05, (1.0 - wrong / 4.0) * min(1.0, contrast / 60.0) * max(0.2, min(1.0, 1.4 - spread)))
            result.append(Found(tag, corners, wrong, contrast, quality))
        return result

    def _pattern(self, tag: int) -> NDArray[np.bool_]:
        """Return which cells of a tag are white, (8, 8)."""
        if tag not in self._patterns:
            self._patterns[tag] = pattern(self._cv2, self._dictionary, tag)
        return self._patterns[tag]

    def _remember(self, picture: Picture, time_s: float) -> None:
        for tag, each in picture.tags.items():
            before = self._known.get(tag)
            speed = np.zeros(2)
            if before is not None and 0.0 < time_s - before.time_s < 1.0:
                speed = (each.centre - before.corners.mean(axis=0)) / (time_s - before.time_s)
            self._known[tag] = _Known(each.corners, speed, time_s)
        for tag in [tag for tag in self._known if tag not in picture.tags]:
            self._known[tag].misses += 1
            if self._known[tag].misses > MISSES:
                del self._known[tag]


def pattern(cv2: Any, dictionary: Any, tag: int) -> NDArray[np.bool_]:
    """Return which cells of a tag are white, (8, 8), as printed."""
    white: NDArray[np.bool_] = cv2.aruco.generateImageMarker(dictionary, tag, CELLS) > 0
    return white


def _cells(grey: Grey, corners: Doubles) -> Doubles:
    """Return the grey in the middle of each cell of tags with corners (n, 4, 2): (n, 8, 8), between pixels linearly."""
    (x0, y0), (x1, y1), (x2, y2), (x3, y3) = (corners[:, k].T for k in range(4))
    # The projective map of the unit square onto four points (Heckbert, Fundamentals of Texture Mapping, 1989, 2.2.3).
    sx, sy = x0 - x1 + x2 - x3, y0 - y1 + y2 - y3
    dx1, dy1, dx2, dy2 = x1 - x2, y1 - y2, x3 - x2, y3 - y2
    det = dx1 * dy2 - dx2 * dy1
    det = np.where(np.abs(det) < 1e-9, 1e-9, det)
    g, h = (sx * dy2 - dx2 * sy) / det, (dx1 * sy - sx * dy1) / det
    middle = (np.arange(CELLS) + 0.5) / CELLS
    u, v = (each.ravel() for each in np.meshgrid(middle, middle))

    def column(each: Doubles) -> Doubles:
        return each[:, None]

    scale = column(g) * u + column(h) * v + 1.0
    x = (column(x1 - x0 + g * x1) * u + column(x3 - x0 + h * x3) * v + column(x0)) / scale
    y = (column(y1 - y0 + g * y1) * u + column(y3 - y0 + h * y3) * v + column(y0)) / scale
    height, width = grey.shape
    left, top = np.clip(np.floor(x).astype(int), 0, width - 2), np.clip(np.floor(y).astype(int), 0, height - 2)
    dx, dy = np.clip(x - left, 0.0, 1.0), np.clip(y - top, 0.0, 1.0)
    upper = grey[top, left] * (1.0 - dx) + grey[top, left + 1] * dx
    lower = grey[top + 1, left] * (1.0 - dx) + grey[top + 1, left + 1] * dx
    cells: Doubles = (upper * (1.0 - dy) + lower * dy).reshape(len(corners), CELLS, CELLS)
    return cells
