"""Notices by the floor tags that a camera has moved, and finds its new pose from them.

A pose of a robot is only as good as that of the camera: no fix goes out of a picture in which the floor tags do not
confirm where the camera is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from fullswarm.localization.camera.finder import Found
from fullswarm.localization.camera.optics import Doubles, Optics, opencv, square
from fullswarm.localization.camera.plan import FloorTag

TOLERANCE_PX = 2.5
"""A floor tag that is further from its place contradicts the calibration: 7 mm at 350 pixels per metre."""
UNSEEN_S = 1.0
MOVED_S = 0.15
STILL_S = 0.5
"""The camera hangs still for so long before its new pose counts."""
STILL_PX = 1.5
WORST_RMS_PX = 2.0
LEAST_TAGS = 2
"""Floor tags from which a pose is computed; one alone shows tilt badly."""


@dataclass(frozen=True, slots=True)
class Solved:
    """A camera's pose from floor tags, and how well it explains them."""

    rotation: Doubles
    position_m: Doubles
    rms_px: float
    rms_m: float
    by_tag_m: dict[int, float]


def solve(optics_lens: Any, cv2: Any, tags: Mapping[int, FloorTag], corners: Mapping[int, Doubles]) -> Solved | None:
    """Return the pose of a camera that sees floor tags with these corners, (4, 2) pixels each; None: there is none.

    Parameters
    ----------
    optics_lens : its :class:`~fullswarm.localization.camera.optics.Lens`
    """
    shared = [tag for tag in corners if tag in tags]
    if not shared:
        return None
    points = np.vstack([square(t.x_m, t.y_m, t.heading_rad, t.size_m, 0.0) for t in (tags[tag] for tag in shared)])
    return solve_points(optics_lens, cv2, points, np.vstack([corners[tag] for tag in shared]), shared)


def solve_points(
    lens: Any, cv2: Any, points_m: Doubles, pixels: Doubles, tags: list[int] | None = None
) -> Solved | None:
    """Return the pose of a camera that sees points of the floor, (n, 3), at pixels, (n, 2); None: there is none."""
    image = np.ascontiguousarray(pixels, float).reshape(-1, 1, 2)
    found, turn, shift = cv2.solvePnP(points_m, image, lens.matrix, lens.distortion, flags=cv2.SOLVEPNP_SQPNP)
    if not found:
        return None
    turn, shift = cv2.solvePnPRefineLM(points_m, image, lens.matrix, lens.distortion, turn, shift)
    rotation, _ = cv2.Rodrigues(turn)
    position = (-rotation.T @ shift).ravel()
    if not np.isfinite(position).all() or position[2] <= 0.05:
        return None
    optics = Optics(lens, rotation, position)
    away_px = np.linalg.norm(optics.pixels(points_m) - pixels, axis=1)
    away_m = np.linalg.norm(optics.places(pixels, 0.0) - points_m[:, :2], axis=1)
    by_tag = {tag: float(np.mean(away_m[4 * k : 4 * k + 4])) for k, tag in enumerate(tags or ())}
    rms_px, rms_m = float(np.sqrt(np.mean(away_px**2))), float(np.sqrt(np.mean(away_m**2)))
    return Solved(rotation, position, rms_px, rms_m, by_tag) if math.isfinite(rms_m) else None


@dataclass(slots=True)
class MountWatch:
    """Compares the floor tags of each picture with where they should be.

    Parameters
    ----------
    optics : as calibrated
    tags : floor tags of the calibration; none: nothing can be noticed

    Attributes
    ----------
    optics : as the floor tags show it now
    problem : why there are no fixes; empty: there are
    moved : how often a new pose was found
    """

    optics: Optics
    tags: dict[int, FloorTag]
    problem: str = field(default="", init=False)
    moved: int = field(default=0, init=False)
    _expected: dict[int, Doubles] = field(init=False)
    _stray: list[int] = field(default_factory=list, init=False)
    _found_again: str = field(default="", init=False)
    _confirmed_s: float = field(default=-math.inf, init=False)
    _seen_s: float = field(default=-math.inf, init=False)
    _contradicted_s: float | None = field(default=None, init=False)
    _still: tuple[float, Doubles] | None = field(default=None, init=False)  # since when, corners of all tags

    def __post_init__(self) -> None:
        self._expected = self._corners()

    def _corners(self) -> dict[int, Doubles]:
        return {
            tag: self.optics.pixels(square(each.x_m, each.y_m, each.heading_rad, each.size_m, 0.0))
            for tag, each in self.tags.items()
        }

    @property
    def note(self) -> str:
        """What operators should know besides."""
        if self._stray:
            tags = ", ".join(str(each) for each in self._stray)
            return f"floor tag {tags} is not where it was: put it back, or calibrate"
        return self._found_again

    @property
    def expected(self) -> dict[int, Doubles]:
        """Corners of the floor tags in the picture, (4, 2) by number."""
        return self._expected

    def confirm(self, seen: Mapping[int, Found], time_s: float) -> bool:
        """Return whether poses from this picture may be used."""
        if not self.tags:
            return True
        if self._seen_s == -math.inf:
            self._seen_s = time_s
        shown = {tag: each for tag, each in seen.items() if tag in self.tags}
        if shown:
            self._seen_s = time_s
        away = {tag: float(np.abs(each.centre - self._expected[tag].mean(axis=0)).max()) for tag, each in shown.items()}
        wrong = [tag for tag, px in away.items() if px > TOLERANCE_PX]
        right = len(away) - len(wrong)
        if self._contradicted_s is None and right > len(wrong):
            self._confirmed_s, self.problem, self._stray = time_s, "", wrong
            return True
        if wrong and self._contradicted_s is None:
            self._contradicted_s = time_s
        if self._contradicted_s is not None:
            return self._find_again(shown, time_s, back=right > 0 and not wrong)
        if time_s - self._seen_s > UNSEEN_S:
            self.problem = "no floor tag is visible, so a moved camera would not be noticed: no fixes until one is"
        return False  # they were all visible before: more likely it has moved than that all are hidden

    def unconfirmed_s(self, time_s: float) -> float:
        """Return for how long no floor tag has confirmed the camera's pose."""
        return time_s - self._confirmed_s if self.tags else 0.0

    def _find_again(self, shown: Mapping[int, Found], time_s: float, back: bool) -> bool:
        """Take the pose from the floor tags once the camera hangs still; never true before that."""
        if self._contradicted_s is None:
            return False
        if back and time_s - self._contradicted_s < MOVED_S:  # one bad detection
            self._contradicted_s, self._still = None, None
            return False
        if time_s - self._contradicted_s >= MOVED_S:
            self.problem = "the camera has moved: no fixes until it hangs still and its floor tags are visible"
        if len(shown) < min(LEAST_TAGS, len(self.tags)):
            self._still = None
            return False
        found = solve(self.optics.lens, opencv(), self.tags, {tag: each.corners for tag, each in shown.items()})
        if found is None or found.rms_px > WORST_RMS_PX:
            self._still = None
            return False
        optics = replace(self.optics, rotation=found.rotation, position_m=found.position_m)
        corners = np.vstack(
            [optics.pixels(square(t.x_m, t.y_m, t.heading_rad, t.size_m, 0.0)) for t in self.tags.values()]
        )
        if self._still is None or float(np.abs(corners - self._still[1]).max()) > STILL_PX:
            self._still = time_s, corners
            return False
        if time_s - self._still[0] < STILL_S:
            return False
        shift_m = float(np.linalg.norm(optics.position_m - self.optics.position_m))
        turn = optics.rotation @ self.optics.rotation.T
        turn_deg = math.degrees(math.acos(max(-1.0, min(1.0, (float(np.trace(turn)) - 1.0) / 2.0))))
        self._found_again = f"the camera was moved by {1000 * shift_m:.0f} mm and {turn_deg:.1f} deg, and found again"
        self.optics, self.moved = optics, self.moved + 1
        self._expected, self._contradicted_s, self._still = self._corners(), None, None
        self._confirmed_s, self.problem = time_s, ""
        return True
