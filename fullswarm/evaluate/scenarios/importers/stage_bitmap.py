"""Bitmaps of floor plans as rectangles: dark pixels (127 of 255 or less) are solid, as in Stage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fullswarm.errors import FullswarmError

MAX_PIXELS = 4_000_000
MAX_RECTANGLES = 4_000
_DARK = 127

Cells = tuple[int, int, int, int]
"""Column and row of the lowest corner, columns, rows; row 0 is the picture's lowest."""


class NotTraced(FullswarmError):
    """Why a bitmap did not become boxes."""


def trace(path: Path) -> tuple[list[Cells], tuple[int, int, int, int]]:
    """Return rectangles of dark pixels, and the first column, first row, columns and rows that they span together.

    Raises
    ------
    NotTraced
        Pillow is not installed, the picture cannot be read, or it is too large or too ragged.
    """
    dark = _dark_pixels(path)
    if not dark.any():
        raise NotTraced("it has no dark pixel")
    rectangles = rectangles_of(dark)
    if len(rectangles) > MAX_RECTANGLES:
        raise NotTraced(f"it would make {len(rectangles)} boxes, {MAX_RECTANGLES} at most")
    rows, columns = np.flatnonzero(dark.any(axis=1)), np.flatnonzero(dark.any(axis=0))
    span = int(columns[0]), int(rows[0]), int(columns[-1] - columns[0]) + 1, int(rows[-1] - rows[0]) + 1
    return rectangles, span


def rectangles_of(solid: NDArray[np.bool_]) -> list[Cells]:
    """Return rectangles that cover exactly the true cells: runs of a row, joined with equal runs above them."""
    open_runs: dict[tuple[int, int], int] = {}
    done: list[Cells] = []
    for row in range(len(solid) + 1):
        edges = np.diff(np.concatenate(([0], solid[row].view(np.int8), [0]))) if row < len(solid) else np.zeros(1)
        runs = list(zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True))
        for run in [each for each in open_runs if each not in runs]:
            start = open_runs.pop(run)
            done.append((run[0], start, run[1] - run[0], row - start))
        for run in runs:
            open_runs.setdefault(run, row)
    return done


def _dark_pixels(path: Path) -> NDArray[np.bool_]:
    """Return the picture, row 0 the lowest, shape (rows, columns)."""
    try:
        from PIL import Image
    except ImportError as error:
        raise NotTraced("reading it needs Pillow: pip install 'fullswarm[experiments]'") from error
    try:
        with Image.open(path) as picture:
            if picture.width * picture.height > MAX_PIXELS:
                raise NotTraced(f"it has more than {MAX_PIXELS // 1_000_000} million pixels")
            # What is transparent is floor.
            canvas = Image.new("RGBA", picture.size, "white")
            canvas.alpha_composite(picture.convert("RGBA"))
            grey = np.asarray(canvas.convert("L"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise NotTraced(f"it cannot be read: {error}") from error
    return np.ascontiguousarray(grey[::-1] <= _DARK)
