"""Covers the occupied cells of a grid with boxes, rows as in ``Reading.obstacles``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fullswarm.kernels import Array, Index


def rectangles(occupied: NDArray[np.bool_]) -> Index:
    """Return rectangles (k, 4) of cells that cover exactly the occupied ones: first row and column, end row and column.

    Runs of cells in a row are joined with equal runs in the rows after it.
    """
    edges = np.diff(np.pad(occupied, ((0, 0), (1, 1))).astype(np.int8), axis=1)
    rows, begins = np.nonzero(edges == 1)
    _, ends = np.nonzero(edges == -1)
    found: list[tuple[int, int, int, int]] = []
    growing: dict[tuple[int, int], tuple[int, int]] = {}  # first row and end row so far, by first and end column
    for row, begin, end in zip(rows.tolist(), begins.tolist(), ends.tolist(), strict=True):
        first, last = growing.get((begin, end), (row, row))
        if last != row:
            found.append((first, begin, last, end))
            first = row
        growing[begin, end] = first, row + 1
    found += [(first, begin, last, end) for (begin, end), (first, last) in growing.items()]
    return np.array(found, np.int64).reshape(-1, 4)


def boxes(occupied: NDArray[np.bool_], x_min: float, y_min: float, cell_m: float) -> Array:
    """Return boxes (k, 6) that cover the occupied cells of a grid whose lower left corner is at (x_min, y_min)."""
    found = rectangles(occupied)
    low_y, low_x, high_y, high_x = found.T * cell_m
    zero = np.zeros(len(found))
    return np.column_stack(
        [x_min + 0.5 * (low_x + high_x), y_min + 0.5 * (low_y + high_y), 0.5 * (high_x - low_x), 0.5 * (high_y - low_y),
         zero, zero]
    )  # fmt: skip
