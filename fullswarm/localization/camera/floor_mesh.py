"""Tells where a camera's picture lies on the floor: a grid of its points with their places. Pure.

A homography would be exact for a lens without distortion only. The grid contains both the lens and the tilt, so that a
program that draws the picture needs no model of either; between its points it interpolates linearly.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fullswarm.localization.camera.optics import Doubles, Optics
from fullswarm.messages import FloorMesh

COLUMNS, ROWS = 32, 18
"""Cells. With a usual wide lens a place between their points is wrong by less than half a pixel of the picture sent."""
STEEPEST = 4.0
"""Floor that is farther away than this, in heights of the camera, is not drawn: a pixel is too long there."""
TRUE_PX = 1.0
"""Outside of what it was calibrated for a lens model folds back: there a place's pixel is another one."""


def floor_mesh(optics: Optics, tops_m: float) -> FloorMesh:
    """Return where the points of a grid over the picture lie on the floor.

    Parameters
    ----------
    tops_m
        Height of the robots' tags above the floor.
    """
    width, height = optics.lens.size_px
    # From edge to edge; pixels are counted from the centre of the first.
    right, down = np.meshgrid(np.linspace(0.0, width, COLUMNS + 1) - 0.5, np.linspace(0.0, height, ROWS + 1) - 0.5)
    pixels = np.column_stack((right.ravel(), down.ravel()))
    places = optics.places(pixels, 0.0)
    known = _known(optics, pixels, places)
    return FloorMesh(
        columns=COLUMNS,
        rows=ROWS,
        x_m=tuple(float(x) if good else None for x, good in zip(places[:, 0], known, strict=True)),
        y_m=tuple(float(y) if good else None for y, good in zip(places[:, 1], known, strict=True)),
        eye_m=(float(optics.position_m[0]), float(optics.position_m[1]), float(optics.position_m[2])),
        tops_m=tops_m,
    )


def _known(optics: Optics, pixels: Doubles, places: Doubles) -> Sequence[bool]:
    """Return which places are those of their pixels, and near enough to be drawn; (n,)."""
    finite: NDArray[np.bool_] = np.asarray(np.isfinite(places).all(axis=1))
    safe = np.where(finite[:, None], places, 0.0)
    away_m = np.linalg.norm(safe - optics.position_m[:2], axis=1)
    back_px = np.linalg.norm(optics.pixels(np.column_stack((safe, np.zeros(len(safe))))) - pixels, axis=1)
    near = away_m <= STEEPEST * optics.position_m[2]
    known: list[bool] = np.logical_and.reduce((finite, near, back_px <= TRUE_PX)).tolist()
    return known
