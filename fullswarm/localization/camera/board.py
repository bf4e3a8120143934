"""The calibration board (ChArUco): squares of a chessboard with a marker in each white one."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fullswarm.localization.camera.optics import opencv

COLUMNS, ROWS = 7, 5
SQUARE_M = 0.034
"""Fits on A4 and on Letter."""
MARKER_SHARE = 0.75
FAMILY = "DICT_5X5_50"
"""Not that of the tags: a board that lies about is never a robot."""


def board(square_m: float = SQUARE_M) -> Any:
    """Return OpenCV's board with squares of this side."""
    aruco = opencv().aruco
    dictionary = aruco.getPredefinedDictionary(getattr(aruco, FAMILY))
    return aruco.CharucoBoard((COLUMNS, ROWS), square_m, MARKER_SHARE * square_m, dictionary)


def board_picture(pixels_per_square: int) -> NDArray[np.uint8]:
    """Return the board as printed, without margin."""
    size = COLUMNS * pixels_per_square, ROWS * pixels_per_square
    picture: NDArray[np.uint8] = board().generateImage(size, marginSize=0, borderBits=1)
    return picture
