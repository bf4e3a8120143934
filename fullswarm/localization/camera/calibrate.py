"""Calibrates a camera: its lens from pictures of the board, its place from floor tags or the board on the floor.

A calibration that is not good enough is refused, with what to do: all poses of robots are no better than it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from fullswarm.errors import ConfigError
from fullswarm.localization.camera.board import SQUARE_M, board
from fullswarm.localization.camera.camera_file import CameraFile, FloorPart, FloorTagPart, LensPart
from fullswarm.localization.camera.finder import Grey, TagFinder
from fullswarm.localization.camera.mounting import Solved, solve, solve_points
from fullswarm.localization.camera.optics import Doubles, Lens, Optics, fit_square, opencv
from fullswarm.localization.camera.plan import FloorTag, TagPlan

LEAST_CORNERS = 10
LEAST_VIEWS, MOST_VIEWS = 12, 60
WORST_LENS_PX = 1.0  # at a width of 1920
SHARE = 0.6
CELLS = 5
"""The board must have been in this share of the parts of the picture, in 5 by 5 parts."""
NEW_VIEW_PX = 40.0
LEAST_TAGS = 4
PICTURES = 15
WORST_FLOOR_M = 0.012
WORST_FLOOR_PX = 4.0
STRAY_M = 0.03
"""A floor tag that does not fit the others by this much was measured or typed wrong."""
TURNED_RAD = math.radians(12.0)


@dataclass(slots=True)
class LensCalibration:
    """Collects views of the board.

    Attributes
    ----------
    looked : pictures so far
    """

    square_m: float = SQUARE_M
    looked: int = 0
    size_px: tuple[int, int] = (0, 0)
    _points: list[Any] = field(default_factory=list)
    _pixels: list[Doubles] = field(default_factory=list)
    _board: Any = None
    _detector: Any = None

    def add(self, grey: Grey, where: str) -> bool:
        """Look at a picture; return whether it is a new view of the board.

        Raises
        ------
        ConfigError
            Its size is not that of the others.
        """
        if self._detector is None:
            self._board = board(self.square_m)
            self._detector = opencv().aruco.CharucoDetector(self._board)
            self.size_px = grey.shape[1], grey.shape[0]
        if (grey.shape[1], grey.shape[0]) != self.size_px:
            raise ConfigError("the pictures differ in size", where=where, hint="use those of one camera, unchanged")
        self.looked += 1
        if len(self._pixels) >= MOST_VIEWS:
            return False
        corners, ids, _, _ = self._detector.detectBoard(grey)
        if ids is None or len(ids) < LEAST_CORNERS:
            return False
        points, pixels = self._board.matchImagePoints(corners, ids)
        if points is None or len(points) < LEAST_CORNERS:
            return False
        flat = points.reshape(-1, 3)
        if np.ptp(flat[:, :2], axis=0).min() < self.square_m / 2.0:  # corners of one line show nothing of a tilt
            return False
        found = pixels.reshape(-1, 2).astype(float)
        if any(_alike(found, each) for each in self._pixels):
            return False
        self._points.append(points)
        self._pixels.append(found)
        return True

    @property
    def views(self) -> int:
        """How many views are kept."""
        return len(self._pixels)

    @property
    def covered(self) -> float:
        """The share of the picture's parts in which the board has been."""
        if not self._pixels:
            return 0.0
        places = np.vstack(self._pixels) / np.array(self.size_px) * CELLS
        cells = {(int(x), int(y)) for x, y in np.clip(places, 0, CELLS - 1)}
        return len(cells) / CELLS**2

    def lens(self, where: str) -> Lens:
        """Return the lens.

        Raises
        ------
        ConfigError
            The views are too few, too much alike, or do not fit a lens.
        """
        if self.views < LEAST_VIEWS:
            raise ConfigError(
                f"the board was found in {self.views} different views of {self.looked} pictures; {LEAST_VIEWS} are "
                "needed", where=where,
                hint="all of the board in the picture, sharp, larger than a quarter of its width, tilted each time",
            )  # fmt: skip
        if self.covered < SHARE:
            raise ConfigError(
                f"the board has been in {self.covered:.0%} of the picture; {SHARE:.0%} are needed", where=where,
                hint="hold it into the corners and along the edges of the picture as well",
            )  # fmt: skip
        cv2 = opencv()
        pixels = [np.ascontiguousarray(each, np.float32).reshape(-1, 1, 2) for each in self._pixels]
        rms, matrix, distortion, _, _ = cv2.calibrateCamera(self._points, pixels, self.size_px, None, None)
        lens = Lens(self.size_px, matrix, np.asarray(distortion, float).ravel()[:5], float(rms), self.views)
        self._refuse_bad(lens, where)
        return lens

    def _refuse_bad(self, lens: Lens, where: str) -> None:
        worst = WORST_LENS_PX * max(1.0, self.size_px[0] / 1920)
        if not lens.rms_px <= worst:
            raise ConfigError(
                f"the lens does not fit: {lens.rms_px:.2f} px of error, {worst:.2f} at most", where=where,
                hint="is the board flat? were the pictures sharp, and the zoom and focus the same all the time?",
            )  # fmt: skip
        width, height = self.size_px
        focal_x, focal_y = lens.matrix[0, 0], lens.matrix[1, 1]
        middle = abs(lens.matrix[0, 2] / width - 0.5), abs(lens.matrix[1, 2] / height - 0.5)
        if not (0.2 * width < focal_x < 10 * width and abs(focal_x / focal_y - 1.0) < 0.1 and max(middle) < 0.2):
            raise ConfigError(
                f"the lens found is no real one (focal length {focal_x:.0f} by {focal_y:.0f} px)", where=where,
                hint="tilt the board in all directions: views that are all parallel do not show the focal length",
            )  # fmt: skip


def _alike(one: Doubles, other: Doubles) -> bool:
    centre = np.abs(one.mean(axis=0) - other.mean(axis=0)).max()
    spread = np.abs(np.ptp(one, axis=0) - np.ptp(other, axis=0)).max()
    return bool(max(centre, spread) < NEW_VIEW_PX)


def lens_part(lens: Lens) -> LensPart:
    """Return a lens as it is in a camera's file."""
    return LensPart(
        width_px=lens.size_px[0],
        height_px=lens.size_px[1],
        matrix=_rows(lens.matrix),
        distortion=tuple(float(each) for each in lens.distortion),
        rms_px=lens.rms_px,
        views=lens.views,
    )


def floor_from_tags(file: CameraFile, pictures: Iterable[Grey], plan: TagPlan, where: str) -> FloorPart:
    """Find a camera's place from the floor tags of a plan, seen in some pictures.

    Raises
    ------
    ConfigError
        Fewer than four of the tags are seen, or they do not fit together.
    """
    corners, size_px, strange = _mean_corners(pictures, plan, where)
    seen = {tag: plan.floor[tag] for tag in corners}
    if len(plan.floor) < LEAST_TAGS:
        hint = "state where they lie: [tags] floor = [[501, 0.3, 0.3, 0.0], ...]: number, x, y, direction of the top"
        raise ConfigError(f"the fleet file has {len(plan.floor)} floor tags; {LEAST_TAGS} are needed", hint=hint)
    if len(seen) < LEAST_TAGS:
        missing = ", ".join(str(each) for each in sorted(plan.floor.keys() - seen.keys()))
        more = f"; tags {', '.join(map(str, sorted(strange)))} of no plan are seen" if strange else ""
        raise ConfigError(
            f"{len(seen)} floor tags are seen, {LEAST_TAGS} are needed; not seen: {missing}{more}", where=where,
            hint="is each all in the picture, sharp, and without glare? is the floor lit well enough?",
        )  # fmt: skip
    lens, cv2 = file.lens_of(size_px, where), opencv()
    solved = solve(lens, cv2, seen, corners)
    if solved is None:
        raise ConfigError("no place of the camera explains the floor tags", where=where, hint="check [tags] floor")
    _refuse_stray(lens, cv2, seen, corners, solved, where)
    optics = Optics(lens, solved.rotation, solved.position_m)
    found = {}
    for tag, each in seen.items():
        fit = fit_square(optics.places(corners[tag], 0.0))
        if abs(math.remainder(fit.heading_rad - each.heading_rad, 2.0 * math.pi)) > TURNED_RAD:
            raise ConfigError(
                f"floor tag {tag} is turned by {math.degrees(fit.heading_rad - each.heading_rad):.0f} deg against the "
                "fleet file", where=where, hint="turn the sheet, or correct the last number of its line in [tags]",
            )  # fmt: skip
        found[tag] = FloorTag(tag, fit.x_m, fit.y_m, fit.heading_rad, each.size_m)
    # Where they really lie, so that a pose that is found again is the same as this one.
    return _floor_part(solved, found, where)


def floor_from_board(
    file: CameraFile,
    pictures: Iterable[Grey],
    at: tuple[float, float, float],
    plan: TagPlan,
    where: str,
    square_m: float = SQUARE_M,
) -> FloorPart:
    """Find a camera's place from the board on the floor, and with it the places of the floor tags that are seen.

    Parameters
    ----------
    at : x, y in m of the board's lower left corner (of the squares, its printed title upward), and the direction in rad
        of its lower edge

    Raises
    ------
    ConfigError
        The board is not seen well enough.
    """
    kept = list(pictures)
    model = board(square_m)
    detector = opencv().aruco.CharucoDetector(model)
    points: list[Doubles] = []
    pixels: list[Doubles] = []
    for grey in kept:
        corners, ids, _, _ = detector.detectBoard(grey)
        if ids is None or len(ids) < LEAST_CORNERS:
            continue
        flat, seen = model.matchImagePoints(corners, ids)
        points.append(flat.reshape(-1, 3).astype(float))
        pixels.append(seen.reshape(-1, 2).astype(float))
    if not points:
        hint = "all of it in the picture, flat on the floor; one square must be at least 15 pixels wide"
        raise ConfigError("the board is not seen", where=where, hint=hint)
    flat = np.vstack(points)
    height = model.getChessboardSize()[1] * square_m
    x_m, y_m, turn = at
    along, across = flat[:, 0], height - flat[:, 1]  # the board's own y runs down its print
    cos, sin = math.cos(turn), math.sin(turn)
    placed = np.column_stack((x_m + cos * along - sin * across, y_m + sin * along + cos * across, np.zeros(len(flat))))
    size_px = kept[0].shape[1], kept[0].shape[0]
    lens = file.lens_of(size_px, where)
    solved = solve_points(lens, opencv(), placed, np.vstack(pixels))
    if solved is None or solved.rms_px > WORST_FLOOR_PX:
        raise ConfigError("no place of the camera explains the board", where=where, hint="is it flat on the floor?")
    optics = Optics(lens, solved.rotation, solved.position_m)
    found = {}
    for tag, corners in _mean_corners(kept, plan, where)[0].items():
        fit = fit_square(optics.places(corners, 0.0))
        size_m = plan.floor[tag].size_m
        found[tag] = FloorTag(tag, fit.x_m, fit.y_m, fit.heading_rad, size_m)
    return _floor_part(solved, found, where)


def _mean_corners(
    pictures: Iterable[Grey], plan: TagPlan, where: str
) -> tuple[dict[int, Doubles], tuple[int, int], set[int]]:
    """Return the median corners of the floor tags, the pictures' size, and tags of no plan."""
    finder = TagFinder(tuple(plan))
    every: dict[int, list[Doubles]] = {}
    size_px, strange, count = (0, 0), set(), 0
    for count, grey in enumerate(pictures, 1):
        size_px = grey.shape[1], grey.shape[0]
        finder.search_everything()
        picture = finder.find(grey, count / 10.0)
        strange |= picture.strange
        for tag, each in picture.tags.items():
            if tag in plan.floor:
                every.setdefault(tag, []).append(each.corners)
        if count >= PICTURES:
            break
    if not count:
        raise ConfigError("there is no picture", where=where)
    enough = {tag: found for tag, found in every.items() if len(found) >= max(1, count // 3)}
    return {tag: np.median(np.array(found), axis=0) for tag, found in enough.items()}, size_px, strange


def _refuse_stray(
    lens: Lens, cv2: Any, tags: Mapping[int, FloorTag], corners: Mapping[int, Doubles], solved: Solved, where: str
) -> None:
    """Refuse tags that do not fit together; name the one without which the others do."""
    if solved.rms_m <= WORST_FLOOR_M and solved.rms_px <= WORST_FLOOR_PX:
        return
    best: tuple[float, int, float] | None = None
    for tag in tags if len(tags) > LEAST_TAGS - 1 else ():
        rest = solve(lens, cv2, {each: tags[each] for each in tags if each != tag}, corners)
        if rest is None or (best is not None and rest.rms_m >= best[0]):
            continue
        middle = Optics(lens, rest.rotation, rest.position_m).places(corners[tag], 0.0).mean(axis=0)
        best = rest.rms_m, tag, math.hypot(middle[0] - tags[tag].x_m, middle[1] - tags[tag].y_m)
    hint = "measure where the tags lie again, to the middle of each; are all sizes right, and the prints true to scale?"
    if best is not None and best[0] <= WORST_FLOOR_M < STRAY_M <= best[2]:
        hint = f"floor tag {best[1]} seems to lie {100 * best[2]:.0f} cm from where the fleet file says"
    raise ConfigError(
        f"the floor tags do not fit together: {1000 * solved.rms_m:.0f} mm of error, most {1000 * WORST_FLOOR_M:.0f}",
        where=where,
        hint=hint,
    )


def _floor_part(solved: Solved, tags: Mapping[int, FloorTag], where: str) -> FloorPart:
    if solved.position_m[2] < 0.3:
        raise ConfigError("the camera would be on the floor", where=where, hint="are the tags' places in metres?")
    return FloorPart(
        position_m=tuple(float(each) for each in solved.position_m),
        rotation=_rows(solved.rotation),
        rms_px=solved.rms_px,
        rms_mm=1000.0 * solved.rms_m,
        tag=tuple(
            FloorTagPart(
                tag=tag,
                x_m=each.x_m,
                y_m=each.y_m,
                heading_rad=each.heading_rad,
                size_m=each.size_m,
                residual_mm=1000.0 * solved.by_tag_m.get(tag, 0.0),
            )
            for tag, each in tags.items()
        ),
    )


def _rows(matrix: Doubles) -> Any:
    return tuple(tuple(float(value) for value in row) for row in matrix)
