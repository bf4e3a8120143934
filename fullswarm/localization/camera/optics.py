"""What a calibrated camera knows: pixels to places on planes above the floor, and back. Pure; OpenCV's lens model."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import MissingExtra

Doubles = NDArray[np.float64]
INSTALL = "pip install 'fullswarm[camera]'"


def opencv() -> Any:
    """Return OpenCV with its ArUco part, on one thread.

    Raises
    ------
    MissingExtra
        It is not installed, or a version without it.
    """
    try:
        import cv2
    except ImportError as error:
        raise MissingExtra("cameras need OpenCV", hint=INSTALL) from error
    if not hasattr(cv2, "aruco") or not hasattr(cv2.aruco, "ArucoDetector"):
        raise MissingExtra(f"OpenCV {cv2.__version__} here has no ArUco detector", hint=INSTALL)
    cv2.setNumThreads(1)  # a swarm's computer has other work; and detection of one picture gains little
    return cv2


@dataclass(frozen=True, slots=True)
class Lens:
    """Of a picture of `size_px` (width, height): camera matrix (3, 3) and distortion k1, k2, p1, p2, k3."""

    size_px: tuple[int, int]
    matrix: Doubles
    distortion: Doubles
    rms_px: float = 0.0
    views: int = 0

    def scaled(self, size_px: tuple[int, int]) -> Lens:
        """Return the lens for pictures of another size and the same shape."""
        factor = size_px[0] / self.size_px[0]
        matrix = self.matrix.copy()
        # Pixels are counted from the centre of the first.
        matrix[:2, 2] = (matrix[:2, 2] + 0.5) * factor - 0.5
        matrix[0, 0] *= factor
        matrix[1, 1] *= factor
        return Lens(size_px, matrix, self.distortion, self.rms_px * factor, self.views)


@dataclass(frozen=True, slots=True)
class Optics:
    """A lens at a place.

    Parameters
    ----------
    rotation : (3, 3) world to camera (x right, y down, z ahead)
    position_m : (3,) of the optical centre in the world
    sigma_m : standard deviation of a place on the floor that comes from the calibration
    """

    lens: Lens
    rotation: Doubles
    position_m: Doubles
    sigma_m: float = 0.003
    _cv2: Any = field(default_factory=opencv, repr=False, compare=False)

    def places(self, pixels: Doubles, height_m: float) -> Doubles:
        """Return where rays through pixels, (n, 2), meet the plane at a height: x and y, (n, 2). NaN: they do not."""
        points = np.ascontiguousarray(pixels, float).reshape(-1, 1, 2)
        straight = self._cv2.undistortPoints(points, self.lens.matrix, self.lens.distortion).reshape(-1, 2)
        rays = np.column_stack((straight, np.ones(len(straight)))) @ self.rotation
        with np.errstate(divide="ignore", invalid="ignore"):
            reach = (height_m - self.position_m[2]) / rays[:, 2]
            reach = np.where(reach > 0.0, reach, np.nan)
        found: Doubles = self.position_m[:2] + rays[:, :2] * reach[:, None]
        return found

    def pixels(self, points_m: Doubles) -> Doubles:
        """Return where points of the world, (n, 3), are in the picture, (n, 2)."""
        turn, _ = self._cv2.Rodrigues(self.rotation)
        shift = -self.rotation @ self.position_m
        points = np.ascontiguousarray(points_m, float).reshape(-1, 1, 3)
        found, _ = self._cv2.projectPoints(points, turn, shift, self.lens.matrix, self.lens.distortion)
        result: Doubles = found.reshape(-1, 2)
        return result

    def metres_per_pixel(self, pixel: Doubles, height_m: float) -> Doubles:
        """Return how a place at a height changes with its pixel, (2, 2) m: columns for right and down."""
        around = pixel + np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        right, left, down, up = self.places(around, height_m)
        return np.column_stack((right - left, down - up))


def square(x_m: float, y_m: float, heading_rad: float, size_m: float, height_m: float) -> Doubles:
    """Return the corners of a tag, (4, 3): as detected, from its upper left clockwise on the sheet."""
    half = size_m / 2.0
    ahead, left = half * np.array([1.0, 1.0, -1.0, -1.0]), half * np.array([1.0, -1.0, -1.0, 1.0])
    cos, sin = math.cos(heading_rad), math.sin(heading_rad)
    return np.column_stack((x_m + cos * ahead - sin * left, y_m + sin * ahead + cos * left, np.full(4, height_m)))


@dataclass(frozen=True, slots=True)
class Square:
    """A square fitted to four corners on a plane.

    Attributes
    ----------
    side_m : its measured side
    residual_m : root mean square distance of the corners from it
    """

    x_m: float
    y_m: float
    heading_rad: float
    side_m: float
    residual_m: float


def fit_square(corners_m: Doubles) -> Square:
    """Fit a square to corners, (4, 2), in the order of :func:`square`: least squares with free size."""
    centre = corners_m.mean(axis=0)
    found = (corners_m[:, 0] - centre[0]) + 1j * (corners_m[:, 1] - centre[1])
    ideal = np.array([1 + 1j, 1 - 1j, -1 - 1j, -1 + 1j]) / 2.0  # of side 1
    factor = complex((found @ ideal.conj()) / 2.0)
    residual = float(np.sqrt(np.mean(np.abs(found - factor * ideal) ** 2)))
    return Square(
        float(centre[0]), float(centre[1]), math.atan2(factor.imag, factor.real), abs(factor), residual
    )  # fmt: skip
